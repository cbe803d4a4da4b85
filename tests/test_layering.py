"""Rules of the house that a machine can check: import direction, light import, kernels that say what they write."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import lfpiv

ROOT = Path(__file__).resolve().parents[1]
KERNEL_FILES = sorted((ROOT / "lfpiv_kernels").glob("*.py"))
ALL_FILES = KERNEL_FILES + sorted((ROOT / "lfpiv").glob("*.py"))

HEAVY = {"taichi", "warp", "matplotlib", "cv2", "xarray", "scipy", "h5py", "sklearn", "skimage", "pydantic", "tifffile"}
"""What `import lfpiv` must not read."""

ATOMICS = ("atomic_add", "atomic_sub", "atomic_max", "atomic_min", "atomic_exch", "atomic_cas", "tile_store")
"""Calls that write to their first argument."""


def imported(tree):
    """Full names of the modules a file imports, wherever in the file."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.level == 0:
            yield node.module
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def kernels(tree):
    """Functions decorated with ti.kernel or wp.kernel."""
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef):
            names = [ast.unparse(item.func if isinstance(item, ast.Call) else item) for item in node.decorator_list]
            if any(name in ("ti.kernel", "wp.kernel") for name in names):
                yield node


def root_name(node):
    while isinstance(node, (ast.Subscript, ast.Attribute)):
        node = node.value
    return node.id if isinstance(node, ast.Name) else None


def written_arguments(kernel):
    """Arguments of a kernel that it writes to: item assignments, atomics and whole tiles."""
    arguments = {argument.arg for argument in kernel.args.args}
    for node in ast.walk(kernel):
        targets = []
        if isinstance(node, ast.Assign):
            targets = [part for target in node.targets for part in getattr(target, "elts", [target])]
        elif isinstance(node, (ast.AugAssign, ast.AnnAssign)):
            targets = [node.target]
        elif isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr in ATOMICS:
            targets = [node.args[0]]
            if isinstance(targets[0], ast.Name):  # wp.atomic_add(array, index, value)
                yield targets[0].id
        for target in targets:
            if isinstance(target, ast.Subscript) and root_name(target) in arguments:
                yield root_name(target)


@pytest.mark.parametrize("path", KERNEL_FILES, ids=lambda path: path.name)
def test_kernels_never_import_the_package_above(path):
    tree = ast.parse(path.read_text())
    assert not [name for name in imported(tree) if name == "lfpiv" or name.startswith("lfpiv.")]


@pytest.mark.parametrize("path", ALL_FILES, ids=lambda path: f"{path.parent.name}-{path.name}")
def test_taichi_files_have_no_postponed_annotations_and_only_the_runtime_starts_devices(path):
    tree = ast.parse(path.read_text())
    names = set(imported(tree))
    if "taichi" in names and any(kernels(tree)):
        assert "__future__.annotations" not in names
    calls = {ast.unparse(node.func) for node in ast.walk(tree) if isinstance(node, ast.Call)}
    if path.name != "runtime.py":
        assert not calls & {"ti.init", "wp.init", "taichi.init", "warp.init", "ti.reset"}


@pytest.mark.parametrize("path", KERNEL_FILES, ids=lambda path: path.name)
def test_kernels_are_private_and_write_only_what_is_named_so(path):
    source = path.read_text()
    for kernel in kernels(ast.parse(source)):
        assert kernel.name.startswith("_"), f"{kernel.name} is public: give it a host function"
        assert not kernel.args.defaults, f"{kernel.name} has default arguments"
        header = "\n".join(source.splitlines()[kernel.lineno - 1 : kernel.body[0].lineno])
        assert "# in" in header and "# out" in header, f"{kernel.name} lacks its in or out section"
        wrong = [name for name in written_arguments(kernel) if not name.endswith("_out")]
        assert not wrong, f"{kernel.name} writes {wrong}, whose names do not end in _out"


def test_the_lint_sees_each_way_of_writing():
    source = """
@wp.kernel
def _k(a: float, b_out: float):
    a[0] = 1.0
    a[1, 2] += 2.0
    wp.atomic_add(a, 0, 1.0)
    ti.atomic_add(a[3], 1.0)
    a[0].x = 3.0
    local = a[2]
    b_out[0] = local
"""
    (kernel,) = kernels(ast.parse(source))
    assert list(written_arguments(kernel)).count("a") >= 4 and "local" not in written_arguments(kernel)


def test_import_is_light_and_silent():
    script = f"import sys, lfpiv; print(sorted({HEAVY!r} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True, cwd=ROOT)
    assert done.stdout.strip() == "[]" and done.stderr == ""


def test_type_checkers_see_every_public_name_where_it_is():
    block = next(node for node in ast.parse(Path(lfpiv.__file__).read_text()).body if isinstance(node, ast.If))
    assert ast.unparse(block.test) == "TYPE_CHECKING"
    seen = {alias.name: node.module for node in block.body for alias in node.names}
    assert seen == lfpiv._MODULES | dict.fromkeys(lfpiv._SUBMODULES, "lfpiv")
    assert set(lfpiv._MODULES) == set(lfpiv.__all__) and (ROOT / "lfpiv" / "py.typed").exists()


@pytest.mark.parametrize("name", lfpiv.__all__)
def test_public_names_resolve_and_are_documented(name):
    value = getattr(lfpiv, name)
    assert callable(value), f"{name} is shadowed by a module of that name"
    assert value.__doc__ and name in dir(lfpiv)
