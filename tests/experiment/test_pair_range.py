"""Pairs that a caller chooses are two numbers, everywhere."""

import pytest

import lfpiv
from lfpiv.experiment.pair_range import pair_range


@pytest.mark.parametrize(
    ("pairs", "chosen"), [(None, (0, None)), ((2, 5), (2, 5)), ([2, None], (2, None)), ((0, None), (0, None))]
)
def test_two_numbers_are_taken(pairs, chosen):
    assert pair_range(pairs) == chosen


@pytest.mark.parametrize("pairs", [[0], 3, "0:3", (0, 1, 2), (0.5, 2), (None, 3), range(3), "03"])
def test_anything_else_is_refused_by_name(pairs):
    with pytest.raises(lfpiv.InputError, match=r"pairs: expected two whole numbers, .*\(0, 10\), .* found "):
        pair_range(pairs)


def test_a_run_and_its_results_take_the_same_pairs(small_run, tmp_path):
    for call in (
        lambda: lfpiv.run(small_run.experiment, tmp_path / "out", pairs=[0]),
        lambda: lfpiv.open_results(small_run.out, pairs=[0]),
    ):
        with pytest.raises(lfpiv.InputError, match=r"pairs: expected two whole numbers"):
            call()
    assert not (tmp_path / "out").exists()
