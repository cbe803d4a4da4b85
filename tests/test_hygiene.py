"""Rules for the tests themselves: they use public names, and each of them checks something."""

import ast
from pathlib import Path

import pytest

TESTS = Path(__file__).resolve().parent
FILES = sorted(TESTS.rglob("*.py"))
TEST_FILES = [path for path in FILES if path.name.startswith("test_")]

PUBLIC_WITH_UNDERSCORE = {"_asdict", "_fields", "_make", "_replace"}
"""Public names of named tuples."""
FOREIGN = {"wp", "ti"}
"""Libraries whose private names tests may use, where there are no public ones."""
SETTERS = {"setattr", "getattr", "delattr", "hasattr"}
"""Functions that take the name of an attribute as a text."""


def name_of(path):
    return path.relative_to(TESTS).as_posix()


def is_private(name):
    return name.startswith("_") and not name.endswith("__") and name not in PUBLIC_WITH_UNDERSCORE


def private_names(tree, kernels=False):
    """Yield private names that a file uses of others, and constructors that it bypasses by `__new__`.

    Tests of kernels may import private kernels: these are the units under test.
    """
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute) and ast.unparse(node.value) not in {"self", "cls", "super()"} | FOREIGN:
            of_kernels = kernels and isinstance(node.value, ast.Name)
            if node.attr == "__new__" or (is_private(node.attr) and not of_kernels):
                yield ast.unparse(node)
        elif isinstance(node, ast.ImportFrom) and not kernels:
            yield from (f"{node.module}.{alias.name}" for alias in node.names if is_private(alias.name))
        elif isinstance(node, ast.Call) and ast.unparse(node.func).rpartition(".")[2] in SETTERS:
            texts = [part.value for part in node.args if isinstance(part, ast.Constant) and isinstance(part.value, str)]
            yield from (text for text in texts if is_private(text.rpartition(".")[2]))


def functions(tree):
    return [node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)]


def checks(function, checking):
    """Whether a function asserts, expects an exception or a warning, or calls one of the functions `checking`."""
    for node in ast.walk(function):
        if isinstance(node, ast.Assert):
            return True
        if isinstance(node, ast.Call):
            name = ast.unparse(node.func).rpartition(".")[2]
            if name in checking or name.startswith("assert_") or name in ("raises", "warns", "fail"):
                return True
    return False


def checking_helpers(trees, known=frozenset()):
    """Names of the functions of some files that check something, themselves or by functions that they call.

    `known` are such names in other files.
    """
    every, found, before = [f for tree in trees for f in functions(tree)], set(known), None
    while found != before:
        before = set(found)
        found |= {f.name for f in every if f.name not in found and checks(f, found)}
    return {name for name in found if not name.startswith("test_")}


@pytest.fixture(scope="module")
def support():
    """Names of the functions of `support/` that check something."""
    return checking_helpers([ast.parse(path.read_text("utf-8")) for path in FILES if path not in TEST_FILES])


@pytest.mark.parametrize("path", FILES, ids=name_of)
def test_tests_use_public_names(path):
    found = list(private_names(ast.parse(path.read_text("utf-8")), kernels=path.parent.name == "kernels"))
    assert not found, f"{name_of(path)} uses {', '.join(found)}: test through public names, or make these public"


@pytest.mark.parametrize("path", TEST_FILES, ids=name_of)
def test_every_test_checks_something(path, support):
    tree = ast.parse(path.read_text("utf-8"))
    checking = checking_helpers([tree], support)
    idle = [f.name for f in functions(tree) if f.name.startswith("test_") and not checks(f, checking)]
    assert not idle, f"{name_of(path)} has tests that check nothing: {', '.join(idle)}"


def test_the_rules_see_each_way_of_breaking_them():
    source = """
from lfpiv.weights.blocks import _spans
weights = Weights.__new__(Weights)
weights._projectors = {}
patch.setattr(memory, "_meminfo", None)
patch.setattr("lfpiv.runs.memory._meminfo", None)
"""
    expected = {"lfpiv.weights.blocks._spans", "Weights.__new__", "weights._projectors", "_meminfo"}
    assert set(private_names(ast.parse(source))) == expected | {"lfpiv.runs.memory._meminfo"}
    fine = "class A:\n    def f(self):\n        self._x = point._replace(x=1).__class__"
    assert not list(private_names(ast.parse(fine)))
    assert not list(private_names(ast.parse("from lfpiv_kernels.rays.count import _k\ncount._k()"), kernels=True))
    tests = """
def helper(): assert True
def outer(): helper()
def test_by_helper(): outer()
def test_by_exception():
    with pytest.raises(ValueError): f()
def test_idle(): f()
"""
    tree = ast.parse(tests)
    checking = checking_helpers([tree])
    assert checking == {"helper", "outer"}
    assert [f.name for f in functions(tree) if not checks(f, checking)] == ["test_idle"]
