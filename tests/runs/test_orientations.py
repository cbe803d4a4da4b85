"""A run with cameras that differ in everything: one from above with another lens, hexagonal microlenses, and rolled."""

import numpy as np
import pytest
import xarray as xr
from support import scenes

import lfpiv
from lfpiv.simulation.simulator import simulate

DISPLACEMENT_VOXEL = (0.8, -0.6, 0.4)
MEAN_ERROR_VOXEL = 0.3  # the project's limit for the mean displacement error
WEIGHTS_ERROR = 0.02  # the project's aim for the relative L2 error of weights
FROM_ABOVE = {
    "nominal_direction": (0.0, 0.7, 0.7),
    "nominal_roll_deg": 90.0,
    "true_pitch_deg": -0.9,
    "microlens_layout": "hexagonal",
    "focal_length_mm": 75.0,
    "magnification": -0.8,
    "f_number": 4.5,
    "microlens_pitch_mm": 0.08,
    "microlens_focal_length_mm": 0.64,
}


@pytest.mark.slow
@pytest.mark.whole_run
def test_a_camera_from_above_with_another_lens_and_a_hexagonal_array_needs_no_trick(tmp_path, device, whole_count):
    above = scenes.camera("above", None, (360, 340), **FROM_ABOVE)
    del above["nominal_angle_deg"]
    scene = scenes.scene(
        "above",
        [scenes.camera("left", 40.0, (340, 320)), scenes.camera("right", -40.0, (340, 320)), above],
        planes_mm=(-0.7, 0.0, 0.7),
        particles={"count": 120, "sigma_mm": 0.05},
        displacement_mm=tuple(0.1 * np.array(DISPLACEMENT_VOXEL)),
        correlation={"windows": [(12, 16, 16), (12, 12, 12)]},
        smart={"iterations": 8, "refinement": 1.0},
        network={"hidden": (8,), "epochs": 60},
    )
    summary = lfpiv.run(simulate(scene, tmp_path / "data"), tmp_path / "out", device=device.kind)
    assert summary["weights"]["form"] == dict.fromkeys(("left", "right", "above"), "pixels")
    assert np.mean(summary["weights"]["count_check_l2"]) < WEIGHTS_ERROR
    vectors = xr.load_dataset(tmp_path / "out" / "vectors" / "pair_0000.nc", engine="h5netcdf")
    error = np.stack(
        [vectors[f"displacement_{axis}"].values - d for axis, d in zip("xyz", DISPLACEMENT_VOXEL, strict=True)]
    )
    assert vectors.valid.values.mean() > 0.9
    assert np.linalg.norm(error, axis=0)[vectors.valid.values].mean() < MEAN_ERROR_VOXEL
    report = (tmp_path / "out" / "report.html").read_text("utf-8")
    assert "in the direction (0, 0.707, 0.707), rolled by 90°" in report
