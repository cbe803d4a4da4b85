"""The C++ headers of the kernels: format, warnings of the compiler, constants, and when a module is compiled anew."""

import importlib
import pkgutil
import re
import shutil
import subprocess
from pathlib import Path

import pytest
import warp as wp

import lfpiv_kernels
from lfpiv_kernels import native, runtime

HEADERS = sorted(native.FOLDER.glob("*.h"))
CPU_ONLY = {  # a GPU has ``neighbours_gpu``, ``projector_gpu`` and ``separable_gpu`` instead
    "lfpiv_kernels.correlation.neighbours",
    "lfpiv_kernels.reconstruction.block_rows",
    "lfpiv_kernels.reconstruction.projector",
    "lfpiv_kernels.reconstruction.projector_separable",
}
CHECKOUT = Path(__file__).resolve().parents[2] / "lfpiv_kernels" / "native"  # the format's file is not installed


def warp_modules() -> list[str]:
    """Names of the kernel modules that include a header."""
    names = [found.name for found in pkgutil.walk_packages(lfpiv_kernels.__path__, "lfpiv_kernels.")]
    modules = {name: importlib.import_module(name) for name in names}
    return [name for name, module in modules.items() if "wp" in vars(module) and included(name)]


def included(module: str) -> str:
    """Return the C++ that a module puts before its kernels."""
    build = wp.get_module(module).options["extra_build_options"]
    return build.extra_cpu_preamble if build else ""


@pytest.fixture
def changed_options():
    """Change a module's options for one test."""
    changed = []

    def change(module, options):
        before = dict(wp.get_module(module).options)
        changed.append((module, {name: before[name] for name in options}))
        wp.set_module_options(options, importlib.import_module(module))

    yield change
    for module, options in reversed(changed):
        wp.set_module_options(options, importlib.import_module(module))


@pytest.mark.skipif(shutil.which("clang-format") is None, reason="clang-format is not installed")
def test_headers_are_formatted():
    headers = sorted(CHECKOUT.glob("*.h"))
    done = subprocess.run(["clang-format", "--dry-run", "--Werror", *headers], stderr=subprocess.PIPE, text=True)
    assert done.returncode == 0, done.stderr


def test_every_header_is_compiled_by_a_module():
    compiled = {path.name for name in warp_modules() for path in build_dependencies(name)}
    assert compiled == {path.name for path in HEADERS}


def build_dependencies(module):
    return wp.get_module(module).options["extra_build_options"].extra_build_dependencies


@pytest.mark.slow
@pytest.mark.parametrize("module", warp_modules())
def test_compiler_has_no_warnings(module, changed_options, capfd, tmp_path):
    """Those that Warp's own compiler gives by default, anywhere, and all others in the headers."""
    runtime.start("cpu")
    flags = wp.get_module(module).options["cpu_compiler_flags"].removesuffix(native.QUIET)
    headers = "".join(path.read_text("utf-8") for path in build_dependencies(module))
    asking = re.search("#pragma (unroll|clang loop)", headers)  # only of such loops does the optimiser warn
    changed_options(module, {"cpu_compiler_flags": flags} | ({} if asking else {"optimization_level": 0}))
    wp.compile_aot_module(importlib.import_module(module), device="cpu", module_dir=tmp_path / "plain")
    assert capfd.readouterr().err == ""
    changed_options(module, {"cpu_compiler_flags": f"{flags} -Wall -Wextra", "optimization_level": 0})
    wp.compile_aot_module(importlib.import_module(module), device="cpu", module_dir=tmp_path / "strict")
    found = re.findall(rf"^{native.FOLDER}.*warning: .*$", capfd.readouterr().err, re.MULTILINE)
    assert found == []


def test_no_module_shows_warnings_of_the_compiler():
    names = [found.name for found in pkgutil.walk_packages(lfpiv_kernels.__path__, "lfpiv_kernels.")]
    modules = [wp.get_module(name) for name in names if "wp" in vars(importlib.import_module(name))]
    flags = {module.name: module.options["cpu_compiler_flags"] for module in modules if module.kernels}
    assert flags and all(one.split()[-1] == native.QUIET for one in flags.values()), flags


@pytest.mark.slow
def test_warnings_are_silent_and_errors_are_not(changed_options, capfd, tmp_path):
    runtime.start("cpu")
    module = "lfpiv_kernels.filters.blur"
    options = wp.get_module(module).options
    header = included(module)
    for line, wrong in (("#warning noise", False), ("#error broken", True)):
        build = wp.ModuleBuildOptions(extra_cpu_include_dirs=[native.FOLDER], extra_cpu_preamble=f"{header}\n{line}")
        changed_options(module, {"extra_build_options": build})
        assert options["cpu_compiler_flags"].endswith(native.QUIET)
        if wrong:
            with pytest.raises(Exception, match="build failed"):
                wp.compile_aot_module(importlib.import_module(module), device="cpu", module_dir=tmp_path / "wrong")
            assert "broken" in capfd.readouterr().err
        else:
            wp.compile_aot_module(importlib.import_module(module), device="cpu", module_dir=tmp_path / "right")
            assert capfd.readouterr().err == ""


def test_a_changed_header_changes_the_module(changed_options, tmp_path, monkeypatch):
    """The change may be in a header that the module's own header includes."""
    module = "lfpiv_kernels.reconstruction.projector"
    shutil.copytree(native.FOLDER, tmp_path / "native")
    monkeypatch.setattr(native, "FOLDER", tmp_path / "native")

    def hashed():
        changed_options(module, native.options("projector.h"))
        return wp.get_module(module).hash_module()

    first = hashed()
    assert hashed() == first
    simd = tmp_path / "native" / "simd.h"
    simd.write_text(simd.read_text() + "// changed\n")
    assert hashed() != first


def test_constants_are_read_from_headers():
    assert native.constant("projector.h", "BLOCK_WIDTH") == 8
    with pytest.raises(ValueError, match=r"projector.h: expected 'constexpr int NO_SUCH = <number>;'"):
        native.constant("projector.h", "NO_SUCH")


@pytest.mark.slow
@pytest.mark.skipif(not wp.get_cuda_supported_archs(), reason="Warp was built without CUDA")
@pytest.mark.parametrize("module", [name for name in warp_modules() if name not in CPU_ONLY])
def test_kernels_compile_for_a_gpu_where_there_is_none(module, tmp_path):
    runtime.device()
    (compiled,) = wp.compile_aot_module(importlib.import_module(module), arch=80, module_dir=tmp_path, use_ptx=True)
    entries = compiled.read_text().count(".visible .entry")
    assert entries == len(wp.get_module(module).kernels)
