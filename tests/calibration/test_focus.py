"""The focus of the dots shows planes whose images are exchanged, without knowing which dot is which."""

import itertools
import re
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from lfpiv import InputError
from lfpiv.calibration.plane_focus import check_depths, check_order, mistaken_depths, reversed_order
from lfpiv.geometry.orientation import Orientation

DEPTHS = [-0.8, -0.4, 0.0, 0.4, 0.8]
SETUP = SimpleNamespace(name="left", orientation=None)
OBJECT_MM, MAGNIFICATION = 140.0, 0.75


def rig(shown_mm, planes_mm=DEPTHS, *, angle_deg=40.0, seen=25, noise=1e-5, seed=0):
    """Return experiment and measured dots of images that show planes at `shown_mm`, stated to be at `planes_mm`."""
    rng = np.random.default_rng(seed)
    numbers, chief, slope = [], [], []
    for plane, depth in enumerate(shown_mm):
        for dot in np.sort(rng.permutation(25)[:seen]):
            x, y = (np.divmod(dot, 5)[::-1] - np.array([2, 2])) * 0.7
            sine, cosine = np.sin(np.radians(angle_deg)), np.cos(np.radians(angle_deg))
            numbers.append(25 * plane + dot)
            chief.append((-0.8 * (x * cosine - depth * sine), -0.8 * y))
            towards = depth * cosine + x * sine
            defocus = MAGNIFICATION * towards / (OBJECT_MM - towards) + 2e-5 * (x**2 + y**2)
            slope.append(np.eye(2) * defocus + noise * rng.standard_normal((2, 2)))
    board = SimpleNamespace(dots=(5, 5), planes_mm=planes_mm)
    experiment = SimpleNamespace(
        board=board, path="experiment.toml", board_path=lambda name, plane: Path(f"board/{name}/{plane}.tif")
    )
    dots = SimpleNamespace(measured_dot=np.array(numbers), chief_mm=np.array(chief), slope=np.array(slope))
    return experiment, dots


@pytest.mark.parametrize("angle_deg", [-65.0, -30.0, 0.0, 50.0, 150.0])
@pytest.mark.parametrize("planes_mm", [DEPTHS, DEPTHS[::-1], [0.4, -0.4, 0.8, 0.0, -0.8]], ids=str)
@pytest.mark.parametrize("seen", [8, 25])
def test_planes_in_their_order_are_not_doubted(angle_deg, planes_mm, seen):
    for seed in range(5):
        assert check_order(*_with(rig(planes_mm, planes_mm, angle_deg=angle_deg, seen=seen, seed=seed))) is None


@pytest.mark.parametrize("angle_deg", [-65.0, -30.0, 0.0, 50.0])
@pytest.mark.parametrize(
    ("shown", "displaced"),
    [([0, 3, 2, 1, 4], "1, 3"), ([1, 0, 2, 3, 4], "0, 1"), ([0, 2, 3, 1, 4], "1, 2, 3"), ([4, 1, 2, 3, 0], None)],
    ids=str,
)
def test_exchanged_planes_are_named(angle_deg, shown, displaced):
    experiment, dots = rig(np.take(DEPTHS, shown), angle_deg=angle_deg)
    with pytest.raises(InputError, match="in another order") as caught:
        check_order(experiment, SETUP, dots)
    if displaced is not None:
        found = re.search(r"found planes ([0-9, ]*) in", str(caught.value)).group(1)
        assert found == displaced
        assert all(f"board/left/{plane}.tif" in str(caught.value) for plane in displaced.split(", "))


def test_planes_that_noise_may_exchange_are_not_doubted():
    assert check_order(*_with(rig([-0.01, 0.01, 0.0], [-0.01, 0.0, 0.01], noise=1e-4))) is None


@pytest.mark.parametrize("shown", [[0.4, -0.4], [-0.4, 0.4]], ids=str)
def test_two_planes_have_no_order_of_their_own(shown):
    assert check_order(*_with(rig(shown, [-0.4, 0.4]))) is None


def test_planes_of_few_dots_are_left_out():
    assert check_order(*_with(rig(np.take(DEPTHS, [0, 3, 2, 1, 4]), seen=6))) is None


DEPTH_ERROR = 0.1  # relative; ten times what simulated boards have
UNEVEN = (-0.8, -0.2, 0.4, 0.9)  # mm


def setup(angle_deg):
    optics = SimpleNamespace(magnification=-MAGNIFICATION, object_distance_mm=OBJECT_MM)
    return SimpleNamespace(name="left", optics=optics, orientation=Orientation(yaw_deg=angle_deg))


def said(shown_mm, planes_mm, angle_deg=40.0, **how):
    experiment, dots = rig(shown_mm, planes_mm, angle_deg=angle_deg, **how)
    return mistaken_depths(experiment, setup(angle_deg), dots)


@pytest.mark.parametrize("angle_deg", [-65.0, -30.0, 0.0, 50.0, 150.0])
@pytest.mark.parametrize("planes_mm", [UNEVEN, (-0.7, 0.0, 0.7), DEPTHS[::-1], (0.4, -0.4, 0.8, 0.0, -0.8)], ids=str)
@pytest.mark.parametrize("scale", [0.5, 1 / 1.33, 1.0, 1.1])
def test_planes_where_they_are_stated_are_not_doubted_in_water_either(angle_deg, planes_mm, scale):
    """A stage with errors of a twelfth of the distance of the planes is corrected elsewhere."""
    for seed in range(5):
        stage = 0.05 * np.random.default_rng(seed).standard_normal(len(planes_mm))
        experiment, dots = rig(scale * (planes_mm + stage), planes_mm, angle_deg=angle_deg, seed=seed)
        assert mistaken_depths(experiment, setup(angle_deg), dots) is None


@pytest.mark.parametrize("angle_deg", [-65.0, 0.0, 50.0])
@pytest.mark.parametrize("planes_mm", [UNEVEN, (-0.7, 0.0, 0.7), tuple(DEPTHS)], ids=str)
def test_each_two_planes_in_each_others_place_are_named(angle_deg, planes_mm):
    for one, other in itertools.combinations(range(len(planes_mm)), 2):
        if {one, other} == {0, len(planes_mm) - 1} and len(planes_mm) == 3:
            continue  # the reverse order
        shown = np.array(planes_mm)
        shown[[one, other]] = shown[[other, one]]
        experiment, dots = rig(shown, planes_mm, angle_deg=angle_deg)
        with pytest.raises(InputError, match=f"planes {one} and {other} come into focus in each other's place"):
            check_depths(experiment, setup(angle_deg), dots)


@pytest.mark.parametrize("angle_deg", [-65.0, 0.0, 50.0])
@pytest.mark.parametrize(("plane", "stated"), [(0, 0.8), (1, 0.2), (3, 0.09), (3, 9.0), (2, -0.4)])
def test_a_mistyped_depth_is_named_with_the_depth_that_fits(angle_deg, plane, stated):
    planes_mm = list(UNEVEN)
    planes_mm[plane] = stated
    text = said(UNEVEN, planes_mm, angle_deg)
    found = re.search(r"plane (\d) comes into focus as if it stood at about z = (\S+) mm, not at (\S+) mm", text)
    assert (int(found[1]), float(found[3])) == (plane, stated)
    assert float(found[2]) == pytest.approx(UNEVEN[plane], rel=DEPTH_ERROR)
    assert text.startswith(f"board/left/{plane}.tif: ")
    experiment, dots = rig(UNEVEN, planes_mm, angle_deg=angle_deg)
    assert check_depths(experiment, setup(angle_deg), dots) is None  # its dots will be left out


@pytest.mark.parametrize("unit", [0.0254, 10.0, 25.4])
def test_depths_in_another_unit_are_named_with_those_that_fit(unit):
    text = said(UNEVEN, tuple(np.array(UNEVEN) / unit))
    assert f"as if the planes were {unit:g} times as far apart" in text
    assert "planes_mm = [-0.8, -0.2, 0.4, 0.9] would fit" in text


def test_planes_in_the_reverse_order_are_left_to_the_search_for_mistakes():
    experiment, dots = rig(UNEVEN[::-1], UNEVEN)
    assert mistaken_depths(experiment, setup(40.0), dots) is None
    assert "planes 0, 1, 2 and 3 come into focus in the reverse order" in reversed_order(experiment, setup(40.0), dots)
    experiment, dots = rig(UNEVEN, UNEVEN)
    assert reversed_order(experiment, setup(40.0), dots) is None


def _with(given):
    experiment, dots = given
    return experiment, SETUP, dots
