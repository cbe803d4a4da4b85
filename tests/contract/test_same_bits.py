"""Volumes, vectors and particles for some thirty settings: the stored bits, by any number of threads."""

import numpy as np
import pytest
from contract.bits import NAMES

LOOPS = 1e-4
"""Difference of loops for a GPU, which add in another order, relative to the norm of an array."""
PARTICLES = 0.05
"""The same for particles: rounds of fitting, removing and adding them amplify it."""


@pytest.mark.slow
@pytest.mark.parametrize("case", NAMES)
def test_bits_are_those_stored(case, computed, stored):
    one, two, gpu = (computed[way][case] for way in ("one thread", "two threads", "loops for a GPU"))
    for name, values in one.items():
        np.testing.assert_array_equal(two[name], values, err_msg=name)
        apart = np.linalg.norm(np.nan_to_num(gpu[name].astype(float) - values))
        limit = PARTICLES if case == "particles" else LOOPS
        assert apart <= limit * np.linalg.norm(np.nan_to_num(values.astype(float))), name
    listed = case == "particles"
    stored.check(case, "cpu", one, listed)
    stored.check(case, "gpu", gpu, listed)
