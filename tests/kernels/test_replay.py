"""Launches that are recorded and replayed on a GPU."""

import numpy as np
import pytest

from lfpiv_kernels.reconstruction.sums import Totals
from lfpiv_kernels.reconstruction.voxels import multiply
from lfpiv_kernels.replay import Replay
from lfpiv_kernels.transfer import to_device, to_host

SIZE = 5000
ROUNDING = 1e-5  # relative: sums of 5,000 squares in float64, of numbers in float32


@pytest.fixture
def numbers(device):
    return np.random.default_rng(5).uniform(0.5, 1.5, (4, SIZE)).astype(np.float32)


def test_each_call_works_on_its_own_input(numbers):
    factor = to_device(numbers[0], float)
    replay, works = (
        Replay(),
        {
            "once": lambda given, found: multiply(given, factor, found),
            "twice": lambda given, found: multiply(given, factor, found, factor=2.0),
        },
    )
    for given in (*numbers, *numbers):
        for times, (name, work) in enumerate(works.items(), start=1):
            found = to_host(replay(name, work, to_device(given.copy(), float)))
            assert (found == given * numbers[0] * np.float32(times)).all()


def test_sums_outside_go_on_from_call_to_call(numbers):
    """A replay adds to the same totals, and memory that the work takes for itself can be taken again."""
    one, totals = to_device(np.ones(SIZE, np.float32), float), Totals(1)

    def work(given, found):
        multiply(given, one, found)
        totals.add_squares(0, one, found)

    replay = Replay()
    for _ in range(2):
        totals.clear()
        for given in numbers:
            replay("squares", work, to_device(given.copy(), float))
        assert totals.read()[0] == pytest.approx((numbers.astype(float) ** 2).sum(), rel=ROUNDING)
