"""The rules of `style` are kept, and those for the tests see each way of breaking them."""

import ast

import pytest
import style


@pytest.mark.slow
def test_the_rules_are_kept():
    """As ``python tests/style.py`` shows it."""
    assert style.broken() == []


def test_the_rules_see_each_way_of_breaking_them():
    source = """
from lfpiv.weights.blocks import _spans
weights = Weights.__new__(Weights)
weights._projectors = {}
patch.setattr(memory, "_meminfo", None)
patch.setattr("lfpiv.runs.memory._meminfo", None)
"""
    expected = {"lfpiv.weights.blocks._spans", "Weights.__new__", "weights._projectors", "_meminfo"}
    assert set(style.private_names(ast.parse(source))) == expected | {"lfpiv.runs.memory._meminfo"}
    fine = "class A:\n    def f(self):\n        self._x = point._replace(x=1).__class__"
    assert not list(style.private_names(ast.parse(fine)))
    assert not list(style.private_names(ast.parse("from lfpiv_kernels.rays.count import _k\ncount._k()"), kernels=True))
    tests = """
def helper(): assert True
def outer(): helper()
def test_by_helper(): outer()
def test_by_exception():
    with pytest.raises(ValueError): f()
def test_idle(): f()
"""
    tree = ast.parse(tests)
    checking = style.checking_helpers([tree])
    assert checking == {"helper", "outer"}
    assert [f.name for f in style.functions(tree) if not style.checks(f, checking)] == ["test_idle"]
