"""What the rules of `style` see of the packages, their public names, and that importing them is light."""

import ast
import importlib
import subprocess
import sys

import pytest
import style
from support.public_names import public_modules, public_names

import lfpiv

HEAVY = {"taichi", "warp", "matplotlib", "cv2", "xarray", "scipy", "h5py", "sklearn", "skimage", "pydantic", "tifffile"}
"""What `import lfpiv` must not read."""


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
    rooms = set(style.MAY_IMPORT) | style.FACES
    assert style.wrong_arrows("weights", ast.parse(source), "lfpiv.weights", rooms)
    fine = "from lfpiv.calibration import camera\nfrom . import blocks\nfrom ..geometry.grid import Grid"
    assert not style.wrong_arrows("weights", ast.parse(fine), "lfpiv.weights", rooms)


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
    (kernel,) = style.kernels(ast.parse(source))
    assert list(style.written_arguments(kernel)).count("a") >= 4 and "local" not in style.written_arguments(kernel)


def test_import_is_light_and_silent():
    script = f"import sys, lfpiv; print(sorted({HEAVY!r} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True, cwd=style.ROOT)
    assert done.stdout.strip() == "[]" and done.stderr == ""


def test_type_checkers_see_every_public_name_where_it_is():
    seen = public_names()
    assert set(lfpiv.__all__) <= set(seen) <= set(dir(lfpiv)) and (style.ROOT / "lfpiv" / "py.typed").exists()
    for name in lfpiv.__all__:
        assert getattr(lfpiv, name) is getattr(importlib.import_module(seen[name]), name), name
    for name in public_modules():
        assert seen[name] == "lfpiv" and getattr(lfpiv, name) is importlib.import_module(f"lfpiv.{name}"), name


def test_public_names_resolve_and_are_documented():
    for name in lfpiv.__all__:
        value = getattr(lfpiv, name)
        assert callable(value), f"{name} is shadowed by a module of that name"
        assert value.__doc__ and name in dir(lfpiv), name
