"""The table that watches accuracy: what it calls better and worse, and its cases."""

import numpy as np
import table

STORED = {
    "rms": [[0.1, 0.08, 0.5], [0.12, 0.09, 0.6], [0.09, 0.08, 0.55], [0.11, 0.1, 0.52]],
    "valid": 1.0,
    "cpu_s": 2.0,
}


def changed(factors):
    """Return the stored case with errors multiplied by a factor in each pair."""
    return STORED | {"rms": (np.array(STORED["rms"]) * np.array(factors)[:, None]).tolist()}


def test_errors_are_compared_pair_by_pair():
    ratio, half = table.compared(changed([1.3, 1.32, 1.28, 1.3]), STORED)
    np.testing.assert_allclose(ratio, 1.3, rtol=0.01)  # scatter from pair to pair cancels
    assert (half < 0.03).all()
    case = table.CASES[0]
    assert table.row(case, changed([1.3, 1.32, 1.28, 1.3]), STORED).endswith("worse")
    assert table.row(case, changed([0.8, 0.82, 0.8, 0.79]), STORED).endswith("better")
    for same in ([1, 1, 1, 1], [1.2, 0.8, 1.1, 0.95]):
        assert not table.row(case, changed(same), STORED).endswith(("worse", "better"))


def test_the_cases_differ_and_are_valid():
    labels = {case.label for case in table.CASES}
    assert len(labels) == len(table.CASES) == 13
    assert {case.cameras for case in table.CASES} == {1, 2, 3, 4}
    assert len({case.rig for case in table.CASES}) == 5  # one has turned arrays
    for case in table.CASES:
        table.scene(case, 1, {})  # a valid scene
