"""The focus of the dots shows planes whose images are exchanged, without knowing which dot is which."""

import re
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from lfpiv import InputError
from lfpiv.calibration.checks import check_focus

DEPTHS = [-0.8, -0.4, 0.0, 0.4, 0.8]
SETUP = SimpleNamespace(name="left")


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
            defocus = 0.006 * (depth * cosine + x * sine) + 2e-5 * (x**2 + y**2)
            slope.append(np.eye(2) * defocus + noise * rng.standard_normal((2, 2)))
    board = SimpleNamespace(dots=(5, 5), planes_mm=planes_mm)
    experiment = SimpleNamespace(board=board, board_path=lambda name, plane: Path(f"board/{name}/{plane}.tif"))
    dots = SimpleNamespace(measured_dot=np.array(numbers), chief_mm=np.array(chief), slope=np.array(slope))
    return experiment, dots


@pytest.mark.parametrize("angle_deg", [-65.0, -30.0, 0.0, 50.0, 150.0])
@pytest.mark.parametrize("planes_mm", [DEPTHS, DEPTHS[::-1], [0.4, -0.4, 0.8, 0.0, -0.8]], ids=str)
@pytest.mark.parametrize("seen", [8, 25])
def test_planes_in_their_order_are_not_doubted(angle_deg, planes_mm, seen):
    for seed in range(5):
        assert check_focus(*_with(rig(planes_mm, planes_mm, angle_deg=angle_deg, seen=seen, seed=seed))) is None


@pytest.mark.parametrize("angle_deg", [-65.0, -30.0, 0.0, 50.0])
@pytest.mark.parametrize(
    ("shown", "displaced"),
    [([0, 3, 2, 1, 4], "1, 3"), ([1, 0, 2, 3, 4], "0, 1"), ([0, 2, 3, 1, 4], "1, 2, 3"), ([4, 1, 2, 3, 0], None)],
    ids=str,
)
def test_exchanged_planes_are_named(angle_deg, shown, displaced):
    experiment, dots = rig(np.take(DEPTHS, shown), angle_deg=angle_deg)
    with pytest.raises(InputError, match="in another order") as caught:
        check_focus(experiment, SETUP, dots)
    if displaced is not None:
        found = re.search(r"found planes (.*) in", str(caught.value)).group(1)
        assert found == displaced
        assert all(f"board/left/{plane}.tif" in str(caught.value) for plane in displaced.split(", "))


def test_planes_that_noise_may_exchange_are_not_doubted():
    assert check_focus(*_with(rig([-0.01, 0.01, 0.0], [-0.01, 0.0, 0.01], noise=1e-4))) is None


@pytest.mark.parametrize("shown", [[0.4, -0.4], [-0.4, 0.4]], ids=str)
def test_two_planes_have_no_order_of_their_own(shown):
    assert check_focus(*_with(rig(shown, [-0.4, 0.4]))) is None


def test_planes_of_few_dots_are_left_out():
    assert check_focus(*_with(rig(np.take(DEPTHS, [0, 3, 2, 1, 4]), seen=6))) is None


def _with(given):
    experiment, dots = given
    return experiment, SETUP, dots
