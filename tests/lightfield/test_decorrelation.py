"""Time after which images of a series are independent: found where particles move on, not where they hardly move."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from lfpiv.lightfield.decorrelation import FEWEST_LAGS, independent_after, overlap

SHAPE, WIDTH_PX = (160, 160), 2.0


def images(count, speed_px, *, standing=0.0, seed=0):
    """Return images of particles that move by `speed_px` from one to the next, some light standing still."""
    rng = np.random.default_rng(seed)
    places, turn = rng.uniform(0, 160, (120, 2)), rng.uniform(0, 2 * np.pi, 120)
    step = speed_px * np.stack([np.cos(turn), np.sin(turn)], 1)
    still = np.zeros(SHAPE)
    still[60:70] = standing
    result = []
    for number in range(count):
        image = np.zeros(SHAPE)
        row, column = np.floor((places + number * step) % 160).astype(int).T
        np.add.at(image, (row, column), 1.0)
        image = 400 * gaussian_filter(image, WIDTH_PX, mode="wrap") + still
        result.append(image + rng.normal(0, 0.2, SHAPE))
    return result


def overlaps(series):
    return range(1, len(series)), [overlap(series[0], other) for other in series[1:]]


def test_overlap_of_an_image_with_itself_is_whole_and_does_not_depend_on_its_brightness():
    one, other = images(2, 40.0)
    assert overlap(one, one) == pytest.approx(1) and overlap(one, 3 * one) == pytest.approx(1)
    assert overlap(one, np.zeros(SHAPE)) == 0 and 0 < overlap(one, other) < 0.5
    assert overlap(one, other) == pytest.approx(overlap(other, one))


@pytest.mark.parametrize("standing", [0.0, 20.0])
@pytest.mark.parametrize("seed", range(5))
def test_fast_particles_are_independent_after_their_width(standing, seed):
    """Light that stands still takes part in every overlap and does not hide that particles move on."""
    lags, found = overlaps(images(20, 1.0, standing=standing, seed=seed))
    after = independent_after(lags, found)
    assert after is not None and 2 * WIDTH_PX <= after <= 6 * WIDTH_PX
    assert independent_after(*overlaps(images(20, 30.0, standing=standing, seed=seed))) == 1


@pytest.mark.parametrize("seed", range(5))
def test_slow_particles_leave_it_open(seed):
    assert independent_after(*overlaps(images(20, 0.2, seed=seed))) is None


def test_a_few_images_leave_it_open():
    lags, found = overlaps(images(FEWEST_LAGS, 30.0))
    assert len(lags) == FEWEST_LAGS - 1 and independent_after(lags, found) is None
