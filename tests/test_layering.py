"""Rules of the house that a machine can check: import direction, light import, kernels that say what they write.

`docs/contribute.md` shows the house. `MAY_IMPORT` is its table of arrows.
"""

import ast
import importlib
import subprocess
import sys
from pathlib import Path

import pytest
from support.public_names import public_modules, public_names

import lfpiv

ROOT = Path(__file__).resolve().parents[1]
KERNEL_FILES = sorted((ROOT / "lfpiv_kernels").rglob("*.py"))
PACKAGE_FILES = sorted((ROOT / "lfpiv").rglob("*.py"))
ALL_FILES = KERNEL_FILES + PACKAGE_FILES

GROUND = {
    "geometry",
    "files",
    "errors",
    "hdf5",
    "records",
    "warn",
    "version",
    "progress",
    "prompt",
    "quantities",
    "settings",
}
"""Rooms that every room may import, beside `lfpiv_kernels`."""
FACES = {"__init__", "__main__", "derived", "statistics"}
"""Files that hand public names on: they may import every room, and no room imports them."""

MAY_IMPORT = {
    "errors": set(),
    "version": set(),
    "progress": set(),
    "prompt": {"quantities"},
    "quantities": set(),
    "hdf5": {"errors", "records"},
    "records": set(),
    "warn": {"records"},
    "files": {"errors", "version"},
    "geometry": set(),
    "settings": {"geometry"},
    "experiment": set(),
    "lightfield": set(),
    "velocity": set(),
    "metrics": set(),
    "calibration": {"lightfield", "experiment"},
    "simulation": {"experiment"},
    "results": {"experiment", "velocity"},
    "weights": {"calibration", "lightfield"},
    "reconstruction": {"weights", "calibration", "lightfield", "velocity"},
    "tracking": {"reconstruction", "weights", "calibration", "metrics"},
    "selfcalibration": {"reconstruction", "weights", "calibration"},
    "report": {"results", "calibration", "lightfield", "velocity", "experiment"},
}
MAY_IMPORT["runs"] = set(MAY_IMPORT) - GROUND - {"metrics", "simulation"}
MAY_IMPORT["planning"] = set(MAY_IMPORT) - GROUND - {"metrics", "simulation"}
MAY_IMPORT["reproduce"] = set(MAY_IMPORT) - GROUND
MAY_IMPORT["benchmark"] = {"simulation", "metrics", "results", "report", "experiment"}
MAY_IMPORT["cli"] = set(MAY_IMPORT) - GROUND
"""What each room of `lfpiv` may import beside itself and `GROUND`. Rooms of the ground import only what stands here."""

HEAVY = {"taichi", "warp", "matplotlib", "cv2", "xarray", "scipy", "h5py", "sklearn", "skimage", "pydantic", "tifffile"}
"""What `import lfpiv` must not read."""

ATOMICS = ("atomic_add", "atomic_sub", "atomic_max", "atomic_min", "atomic_exch", "atomic_cas", "tile_store")
"""Calls that write to their first argument."""


def imported(tree, package=""):
    """Full names of the modules a file of a package imports, wherever in the file, relative imports resolved."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            above = package.split(".")[: len(package.split(".")) - node.level + 1] if node.level else []
            module = ".".join([*above, *([node.module] if node.module else [])])
            yield module
            yield from (f"{module}.{alias.name}" for alias in node.names)


def room_of(path):
    """Room of a file of `lfpiv`: its folder, or its own name where it lies beside the folders."""
    return path.relative_to(ROOT / "lfpiv").parts[0].removesuffix(".py")


def rooms_imported(tree, package, rooms):
    """Rooms of `lfpiv` that a file imports; "lfpiv" itself where it imports a public name from the top."""
    for name in imported(tree, package):
        parts = name.split(".")
        if parts[0] == "lfpiv":
            yield parts[1] if len(parts) > 1 and parts[1] in rooms else "lfpiv"


def wrong_arrows(room, tree, package, rooms):
    """Rooms that a file imports and may not. Importing a submodule names "lfpiv" too: that counts only by itself."""
    found = set(rooms_imported(tree, package, rooms))
    if "lfpiv" not in plain_imports(tree) and not any(top_names(tree, rooms)):
        found.discard("lfpiv")
    allowed = MAY_IMPORT[room] | {room} | (GROUND if room not in GROUND else set())
    return sorted(found - allowed)


def plain_imports(tree):
    """Names in `import ...` statements."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)


def top_names(tree, rooms):
    """Names that `from lfpiv import ...` takes and that are no rooms: public names of the top."""
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.module == "lfpiv" and node.level == 0:
            yield from (alias.name for alias in node.names if alias.name not in rooms)


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


def package_of(path):
    return ".".join(path.relative_to(ROOT).parts[:-1])


def name_of(path):
    return str(path.relative_to(ROOT)).removesuffix(".py")


@pytest.mark.parametrize("path", KERNEL_FILES, ids=name_of)
def test_kernels_never_import_the_package_above(path):
    tree = ast.parse(path.read_text())
    found = imported(tree, package_of(path))
    assert not [name for name in found if name == "lfpiv" or name.startswith("lfpiv.")]


def test_every_room_stands_in_the_table():
    assert {room_of(path) for path in PACKAGE_FILES} == set(MAY_IMPORT) | FACES


@pytest.mark.parametrize("path", [path for path in PACKAGE_FILES if room_of(path) not in FACES], ids=name_of)
def test_files_import_only_what_the_table_allows(path):
    wrong = wrong_arrows(room_of(path), ast.parse(path.read_text()), package_of(path), set(MAY_IMPORT) | FACES)
    assert not wrong, f"{name_of(path)} may not import {', '.join(wrong)}: see MAY_IMPORT"


def test_the_table_has_no_circle():
    left = {
        room: (allowed | (GROUND if room not in GROUND else set())) - {room} for room, allowed in MAY_IMPORT.items()
    }
    while left:
        ground = [room for room, allowed in left.items() if not allowed & set(left)]
        assert ground, f"a circle among {sorted(left)}"
        for room in ground:
            del left[room]


@pytest.mark.parametrize(
    "source",
    [
        "import lfpiv",
        "from lfpiv import reconstruct",
        "from lfpiv.runs.pair import PairWork",
        "from lfpiv import runs",
        "from ..runs import pair",
        "from .. import runs",
        "def late():\n    from lfpiv.runs import pair",
        "if TYPE_CHECKING:\n    import lfpiv.runs.pair",
    ],
)
def test_the_table_sees_each_way_of_importing(source):
    assert wrong_arrows("weights", ast.parse(source), "lfpiv.weights", set(MAY_IMPORT) | FACES)
    fine = "from lfpiv.calibration import camera\nfrom . import blocks\nfrom ..geometry.grid import Grid"
    assert not wrong_arrows("weights", ast.parse(fine), "lfpiv.weights", set(MAY_IMPORT) | FACES)


def test_modules_form_no_circle():
    """Modules of both packages, imports inside functions and for type checkers included."""
    modules = {name_of(path).replace("/", ".").removesuffix(".__init__"): path for path in ALL_FILES}
    left = {}
    for module, path in modules.items():
        names = set(imported(ast.parse(path.read_text()), package_of(path)))
        left[module] = {name for name in names & set(modules) if name != module and modules[name].name != "__init__.py"}
    while left:
        ground = [module for module, names in left.items() if not names & set(left)]
        assert ground, f"a circle among {sorted(left)}"
        for module in ground:
            del left[module]


@pytest.mark.parametrize("path", ALL_FILES, ids=name_of)
def test_taichi_files_have_no_postponed_annotations_and_only_the_runtime_starts_devices(path):
    tree = ast.parse(path.read_text())
    names = set(imported(tree))
    if "taichi" in names and any(kernels(tree)):
        assert "__future__.annotations" not in names
    calls = {ast.unparse(node.func) for node in ast.walk(tree) if isinstance(node, ast.Call)}
    if path.name != "runtime.py":
        assert not calls & {"ti.init", "wp.init", "taichi.init", "warp.init", "ti.reset"}


@pytest.mark.parametrize("path", KERNEL_FILES, ids=name_of)
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
    seen = public_names()
    assert set(lfpiv.__all__) <= set(seen) <= set(dir(lfpiv)) and (ROOT / "lfpiv" / "py.typed").exists()
    for name in lfpiv.__all__:
        assert getattr(lfpiv, name) is getattr(importlib.import_module(seen[name]), name), name
    for name in public_modules():
        assert seen[name] == "lfpiv" and getattr(lfpiv, name) is importlib.import_module(f"lfpiv.{name}"), name


@pytest.mark.parametrize("name", lfpiv.__all__)
def test_public_names_resolve_and_are_documented(name):
    value = getattr(lfpiv, name)
    assert callable(value), f"{name} is shadowed by a module of that name"
    assert value.__doc__ and name in dir(lfpiv)
