"""Cameras whose second frames are too bright beside another camera's."""

import numpy as np
import pytest
from support.pair_figures import pair_figures

from lfpiv.runs.unlike_pulses import unlike_pulses
from lfpiv.warn import Code


def pairs(*, count=4, scatter=0.02, pulses=0.8, **factors):
    """Return the figures of some pairs whose second pulse has a relative energy, each camera's times a factor."""
    rng = np.random.default_rng(3)
    first = {name: 1e5 * rng.uniform(0.2, 1) for name in factors}

    def second():
        noise = np.exp(scatter * rng.standard_normal(len(factors)))
        return {name: pulses * first[name] * own * one for (name, own), one in zip(factors.items(), noise, strict=True)}

    return {pair: pair_figures(1.0, light={"a": first, "b": second()}) for pair in range(count)}


@pytest.mark.parametrize("pulses", [0.5, 1.0, 2.0])
def test_a_camera_with_brighter_second_frames_is_named_beside_another(pulses):
    (found,) = unlike_pulses(pairs(pulses=pulses, left=1.3, right=1.0))
    assert found.code is Code.UNLIKE_PULSES and found.subject == "left"
    assert abs(found.figures["ratio"] - 1.3) < 0.05  # the scatter
    assert "as bright, relative to first frames, as those of right" in found.sentence


def test_all_cameras_but_the_dimmest_are_named():
    found = unlike_pulses(pairs(left=1.3, middle=1.4, right=1.0))
    assert [one.subject for one in found] == ["left", "middle"]
    assert {one.figures["other"] for one in found} == {"right"}


def test_a_single_camera_is_not_compared():
    assert not unlike_pulses(pairs(left=1.3))


def test_nothing_is_told_of_alike_cameras_few_pairs_or_pairs_that_disagree():
    assert not unlike_pulses(pairs(left=1.06, right=1.0))
    assert not unlike_pulses(pairs(count=2, left=1.3, right=1.0))
    assert not unlike_pulses(pairs(scatter=0.5, left=1.3, right=1.0))


def test_pairs_without_light_do_not_count():
    known = pairs(left=1.3, right=1.0)
    dark = pair_figures(0.0, light={"a": {"left": 0.0, "right": 0.0}, "b": {"left": 0.0, "right": 1.0}})
    assert unlike_pulses(known) == unlike_pulses(known | {7: pair_figures(1.0), 8: dark})
