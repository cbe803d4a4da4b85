"""C++ headers of the Warp kernels, stored in this folder, and the options that compile a module with them.

A kernel module names its header in ``wp.set_module_options(native.options("projector.h"))``. Its kernels then call the
header's functions in one line each, by `kernel` or ``wp.func_native``. Constants that C++ and Python share are written
in the header.
"""

import ast
import inspect
import linecache
import os
import re
from collections.abc import Callable
from pathlib import Path

import warp as wp

FOLDER = Path(__file__).resolve().parent
"""Folder of the headers."""
EMULATED = "LFPIV_EMULATE_GPU" in os.environ
"""Whether kernels for the CPU take the loops written for a GPU, one thread after the other: slow, for tests."""
QUIET = "-w"
"""Option of the CPU's compiler that suppresses warnings, which differ from processor to processor; errors are shown."""


def options(header: str, *, contract: str | None = None, unroll: int = 0, gpu: bool = False) -> dict[str, object]:
    """Return the options of a Warp module whose native functions call a header.

    Parameters
    ----------
    header : str
        Name of the header. The module is compiled again if the header, or one that it includes, has changed.
    contract : {"fast", "off"}, optional
        Whether the CPU's compiler fuses multiplications and additions wherever it can, or never. Default: Warp decides.
    unroll : int
        Warp's limit for loops that it unrolls.
    gpu : bool
        Whether the CPU's compiler, too, takes the loops written for a GPU: for a module that only a GPU runs.

    Raises
    ------
    FileNotFoundError
        If there is no such header.
    """
    include = f'#include "{header}"'
    emulated = f"#define LFPIV_EMULATE_GPU\n{include}"
    chosen: dict[str, object] = {
        "max_unroll": unroll,
        "extra_build_options": wp.ModuleBuildOptions(
            extra_cpu_include_dirs=[FOLDER],
            extra_cuda_include_dirs=[FOLDER],
            extra_cpu_preamble=emulated if EMULATED or gpu else include,
            extra_cuda_preamble=include,
            extra_build_dependencies=_included(header),
        ),
    }
    flags = f"-ffp-contract={contract} {QUIET}" if contract else QUIET
    return chosen | quiet_options(flags)


def kernel(call: str, *threads: str, registers: int = 0) -> Callable[[Callable[..., None]], wp.Kernel]:
    """Declare a kernel each of whose threads makes one call of a function of the header.

    The decorated function has the kernel's arguments and no body. In the call they have their own names. The last one
    below ``# in`` is where a part of a launch begins, and says what a thread's number is: ``first_run`` makes it `run`.
    A kernel for a single thread has no such argument.

    Parameters
    ----------
    call : str
        The call in C++, such as ``lfpiv::multiply(run, size, one.data, factor, other.data, product_out.data);``.
    *threads : str
        Names of the thread's numbers along the axes of a launch of several; one with "_" in front is not in the call.
    registers : int
        Most registers of a GPU that a thread may take; default: the compiler decides.
    """

    def declare(function: Callable[..., None]) -> wp.Kernel:
        name, names = function.__name__, function.__globals__
        text = inspect.getsource(function)
        arguments = ast.parse(text).body[0].args.args  # type: ignore[attr-defined]
        first = [one.arg for one in arguments if not one.arg.endswith("_out")][-1]
        axes = threads or ((first.removeprefix("first_"),) if first.startswith("first_") else ())
        used = [one for one in axes if not one.startswith("_")]
        given = [one for one in arguments if not axes or one.arg != first]
        stub = ", ".join([f"{one}: int" for one in used] + [ast.unparse(one) for one in given])
        numbers = [f"{first} + {used[0]}", *used[1:]] if axes else []
        passed = ", ".join([*numbers, *(one.arg for one in given)])
        limit = f"(cuda_max_registers={registers})" if registers else ""
        source = (
            f"@wp.func_native({call!r})\ndef {name}_call({stub}): ...\n\n\n"
            f"@wp.kernel{limit}\ndef {name}({', '.join(map(ast.unparse, arguments))}):\n"
            + (f"    {', '.join(axes)} = wp.tid()\n" if axes else "")
            + f"    {name}_call({passed})\n"
        )
        place = f"<kernel {function.__module__}.{name}>"
        linecache.cache[place] = len(source), None, source.splitlines(keepends=True), place  # Warp reads its source
        exec(compile(source, place, "exec"), names)
        return names[name]

    return declare


def quiet_options(flags: str = QUIET) -> dict[str, object]:
    """Return the options of every Warp module: no adjoint kernels, and no warnings of the CPU's compiler."""
    return {"enable_backward": False, "cpu_compiler_flags": f"{wp.config.cpu_compiler_flags or ''} {flags}".strip()}


def constant(header: str, name: str) -> int | float:
    """Return the value of ``constexpr int NAME`` or ``constexpr float NAME`` of a header.

    Raises
    ------
    ValueError
        If the header has no such constant, or not as a plain number.
    """
    text = (FOLDER / header).read_text(encoding="utf-8")
    found = re.search(rf"^constexpr (int|float|double) {name} = ([-+.\deE]+)f?;", text, re.MULTILINE)
    if not found:
        raise ValueError(f"{header}: expected 'constexpr int {name} = <number>;' or the same with float, found none.")
    kind, value = found.groups()
    return int(value) if kind == "int" else float(value)


def _included(header: str) -> list[Path]:
    """Paths of a header and of all headers that it includes, directly or not."""
    paths = [FOLDER / header]
    for path in paths:  # which grows
        for name in re.findall(r'^#include "(.+)"', path.read_text(encoding="utf-8"), re.MULTILINE):
            if FOLDER / name not in paths:
                paths.append(FOLDER / name)
    return paths
