"""Pairs in which one camera's counts stand on another scale than in the other pairs."""

import pytest
from support.pair_figures import pair_figures

from lfpiv.runs.other_scales import other_scales
from lfpiv.warn import Code


def figures(**gains):
    """Return the figures of a pair whose cameras have these brightnesses in both frames, scaled as a run does."""
    brightest = max(gains.values())
    gain = {name: value / brightest for name, value in gains.items()}
    return pair_figures(1.0, camera_gain={"a": gain, "b": gain}, structure={"a": dict.fromkeys(gain, 0.5)})


@pytest.mark.parametrize(("ratio", "how"), [(16.0, "high"), (1 / 16, "low")])
def test_the_camera_is_named_with_its_pairs_and_the_ratio(ratio, how):
    usual = {"left": 1.0, "middle": 0.4, "right": 0.7}
    pairs = dict.fromkeys(range(5), figures(**usual)) | {3: figures(**usual | {"middle": ratio * 0.4})}
    (found,) = other_scales(pairs)
    assert found.code is Code.OTHER_SCALE and found.subject == "middle" and found.pairs == (3,)
    assert f"left and right are about 16 times as {how}" in found.sentence


def test_of_two_cameras_the_first_is_told_beside_the_other():
    usual = {"left": 1.0, "right": 0.7}
    pairs = dict.fromkeys(range(4), figures(**usual)) | {0: figures(left=1.0, right=16 * 0.7)}
    (found,) = other_scales(pairs)
    assert found.subject == "left" and "relative to right are about 16 times as low" in found.sentence


def test_nothing_is_told_of_usual_changes_few_pairs_or_a_pair_without_particles():
    usual = figures(left=1.0, right=0.2)
    assert not other_scales({0: usual, 1: figures(left=1.0, right=0.7), 2: usual})
    assert not other_scales({0: usual, 1: figures(left=0.01, right=1.0)})
    unmeasured = pair_figures(
        0.0,
        camera_gain={key: {"left": 1.0, "right": 1.0} for key in "ab"},
        structure={"a": {"left": 0.0, "right": 0.5}},
    )
    dim = figures(left=1.0, right=0.05)
    assert not other_scales({0: dim, 1: unmeasured, 2: dim, 3: pair_figures(1.0)})
