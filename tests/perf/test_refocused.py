"""`perf/accuracy/refocused.py`, and the comparison of methods on a tiny volume."""

import json

import method_comparison
import numpy as np
import pytest
import reconstruction_cases
import refocused
from reconstruction_cases import make_rig
from reconstruction_ways import WAYS

from lfpiv.simulation.camera_images import render_camera
from lfpiv_kernels.rendering import render

WITHIN_MM = 0.15  # three lenses of 0.1 mm meet at a point between voxels
DEPTH_MM = 0.5  # one camera at f/4: a particle's rays part by a lens in 0.4 mm


@pytest.fixture(scope="module")
def tiny():
    """Volume of 1.6 x 1.6 x 1.4 mm in place of the small one."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(reconstruction_cases.SIZE_MM, "small", (1.6, 1.6, 1.4))
        patch.setitem(reconstruction_cases.WINDOWS, "small", (12, 8))
        reconstruction_cases.make_rig.cache_clear()
        reconstruction_cases.record.cache_clear()
        yield
    reconstruction_cases.make_rig.cache_clear()
    reconstruction_cases.record.cache_clear()


def light_of(rig, position_mm):
    """Return the images of one particle without noise."""
    rays = render.ray_table(4096, "gaussian", 0)
    return {
        camera.name: render.render_sources(
            render_camera(camera), np.array([position_mm]), np.array([1e5]), 0.05, rays, rng=np.random.default_rng(1)
        )
        for camera in rig.cameras
    }


def brightest_mm(volume, grid):
    return grid.centres_mm()[np.argmax(volume)]


@pytest.mark.parametrize("combine", refocused.COMBINE)
def test_stacks_of_two_cameras_meet_at_the_particle(tiny, combine):
    rig, true = make_rig("small", (45.0, -45.0)), (0.21, -0.33, 0.18)
    volume = refocused.refocused_volume(rig.calibration, light_of(rig, true), rig.grid, combine)
    assert volume.min() >= 0
    assert np.abs(brightest_mm(volume, rig.grid) - true).max() < WITHIN_MM


def test_one_camera_sees_a_particle_long_along_its_axis(tiny):
    rig, true = make_rig("small", (0.0,)), (0.21, -0.33, 0.18)
    stack = refocused.refocus(rig.calibration.cameras["camera1"], light_of(rig, true)["camera1"], rig.grid)
    miss = np.abs(brightest_mm(stack, rig.grid) - true)
    assert miss[:2].max() < WITHIN_MM and miss[2] < DEPTH_MM
    z, y, x = np.unravel_index(stack.argmax(), stack.shape)
    half = stack.max() / 2
    assert (stack[:, y, x] > half).sum() > (stack[z, :, x] > half).sum()


def test_unknown_combination_is_refused(tiny):
    rig = make_rig("small", (0.0,))
    with pytest.raises(ValueError, match="product"):
        refocused.refocused_volume(rig.calibration, light_of(rig, (0, 0, 0)), rig.grid, "sum")


@pytest.mark.slow
def test_comparison_writes_every_method_with_its_standard_error(tiny, tmp_path, monkeypatch):
    monkeypatch.setattr(method_comparison, "METHODS", (("mlos", 2), ("ours", 2), ("truth", 2)))
    monkeypatch.setattr(method_comparison, "FLOWS", ("uniform",))
    monkeypatch.setattr(method_comparison, "PPM", (0.6,))
    monkeypatch.setitem(method_comparison.ROUNDS, "small", 1)
    out = tmp_path / "figures.json"
    assert method_comparison.main(["--out", str(out), "--seeds", "1,2", "--cache", str(tmp_path)]) == 0
    stored = json.loads(out.read_text("utf-8"))
    guess, own, truth = stored["seeding"]
    assert guess["figures"]["q"][0] < own["figures"]["q"][0] < truth["figures"]["q"][0]
    assert own["beyond_ours"]["error"] == [0.0, 0.0] and truth["beyond_ours"]["q"][1] > 0
    times = {row["way"]: row["passes"][0] for row in stored["time"]}
    assert times["mlos"] < times["ours"]


def test_ways_of_the_comparison_exist():
    assert {name for name, _ in method_comparison.METHODS} <= WAYS.keys()
