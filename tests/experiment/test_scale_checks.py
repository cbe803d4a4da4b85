"""Lengths in other units than millimetres are refused before any work; rigs of all sizes are not."""

from pathlib import Path

import numpy as np
import pytest
import tifffile

from lfpiv.cli.commands import call
from lfpiv.errors import InputError
from lfpiv.experiment.experiment import CameraSetup
from lfpiv.experiment.opening import read_experiment
from lfpiv.experiment.scale_checks import require_scale
from lfpiv.geometry.optics import Optics
from lfpiv.geometry.orientation import Orientation
from lfpiv.settings.rig import NominalBoard
from lfpiv.settings.volume import Volume

PATH = Path("experiment.toml")

RIGS = {  # focal length, magnification, microlens pitch, pixel, sensor, angles, volume, voxel, depth of the board
    "sample": (100.0, -1.0, 0.1, 0.0055, (1280, 1600), (45, -45), (6.0, 6.0, 3.0), 0.1, 4.0),
    "paper": (100.0, -1.0, 0.1004, 0.0055, (4640, 6600), (45, -45), (14.0, 14.0, 7.0), 0.1, 4.0),
    "fine voxels": (100.0, -1.0, 0.1, 0.0055, (4640, 6600), (45, -45), (6.0, 6.0, 3.0), 0.02, 4.0),
    "light sheet": (50.0, -0.5, 0.125, 0.0037, (5120, 5120), (0,), (30.0, 30.0, 1.5), 0.25, 3.0),
    "large tank": (50.0, -0.02, 0.1, 0.0055, (4640, 6600), (30, -30), (800.0, 600.0, 500.0), 4.0, 400.0),
    "wind tunnel": (85.0, -0.1, 0.077, 0.0055, (4384, 6576), (20, -20, 60), (250.0, 200.0, 60.0), 0.8, 60.0),
    "micro-PIV": (10.0, -20.0, 0.125, 0.0065, (2048, 2048), (0,), (0.5, 0.5, 0.1), 0.003, 0.1),
    "oblique cameras": (100.0, -1.0, 0.1, 0.0055, (1280, 1600), (75, -75), (7.0, 7.0, 20.0), 0.1, 6.0),
    "volume wider than the views": (100.0, -1.0, 0.1, 0.0055, (1280, 1600), (45, -45), (25.0, 25.0, 6.0), 0.2, 4.0),
    "any orientation": (100.0, -1.0, 0.1, 0.0055, (1280, 1600), (None, None), (6.0, 6.0, 3.0), 0.1, 4.0),
}


def rig(name):
    """Return volume, board and cameras of a rig."""
    focal, magnification, pitch, pixel, sensor, angles, size, voxel, depth = RIGS[name]
    optics = Optics(
        focal_length_mm=focal,
        magnification=magnification,
        f_number=4.0,
        microlens_pitch_mm=pitch,
        microlens_focal_length_mm=5 * pitch,
        pixel_mm=pixel,
        sensor_shape=sensor,
    )
    cameras = [
        CameraSetup(
            name=f"cam{number}",
            optics=optics,
            orientation=None if angle is None else Orientation(angle),
            image_flip="none",
            white_path=PATH,
            dark_path=None,
        )
        for number, angle in enumerate(angles)
    ]
    planes = tuple(np.linspace(-depth / 2, depth / 2, 5))
    board = NominalBoard(
        dots=(7, 7), spacing_mm=10 * pitch / abs(magnification), dot_diameter_mm=pitch / abs(magnification),
        planes_mm=planes,
    )  # fmt: skip
    return Volume(centre_mm=(0.0, 0.0, 0.0), size_mm=size, voxel_mm=voxel), board, cameras


def scaled(table, *keys, by):
    """Return a table with some lengths in another unit."""
    values = {key: getattr(table, key) for key in keys}
    return table.model_copy(
        update={key: tuple(by * v for v in value) if isinstance(value, tuple) else by * value
                for key, value in values.items()}
    )  # fmt: skip


@pytest.mark.parametrize("name", RIGS)
def test_a_rig_of_any_size_is_accepted(name):
    assert require_scale(PATH, *rig(name)) is None


@pytest.mark.parametrize("name", RIGS)
@pytest.mark.parametrize("by", [1e-3, 1e3])
def test_metres_and_micrometres_are_refused(name, by):
    volume, board, cameras = rig(name)
    with pytest.raises(InputError, match=r"volume\.size_mm: .*Lengths are in millimetres"):
        require_scale(PATH, scaled(volume, "size_mm", by=by), board, cameras)
    with pytest.raises(InputError, match=r"volume\.size_mm: .*Lengths are in millimetres"):
        require_scale(PATH, scaled(volume, "size_mm", "voxel_mm", by=by), board, cameras)


@pytest.mark.parametrize("name", RIGS)
def test_voxels_and_planes_in_metres_are_refused(name):
    volume, board, cameras = rig(name)
    with pytest.raises(InputError, match=r"volume\.voxel_mm: .*Lengths are in millimetres"):
        require_scale(PATH, scaled(volume, "voxel_mm", by=1e-3), board, cameras)
    with pytest.raises(InputError, match=r"board\.planes_mm: .*Lengths are in millimetres"):
        require_scale(PATH, volume, scaled(board, "planes_mm", by=1e-3), cameras)


@pytest.mark.parametrize("name", sorted(set(RIGS) - {"fine voxels", "micro-PIV"}))
def test_voxels_that_are_ten_times_too_large_are_refused(name):
    volume, board, cameras = rig(name)
    assert require_scale(PATH, scaled(volume, "voxel_mm", by=2), board, cameras) is None
    with pytest.raises(InputError, match=r"volume\.voxel_mm: .*of about a microlens"):
        require_scale(PATH, scaled(volume, "voxel_mm", by=10), board, cameras)


def test_one_camera_with_a_wide_view_suffices():
    volume, board, cameras = rig("sample")
    wide = rig("wind tunnel")[2][0]
    volume = scaled(volume, "size_mm", by=10)
    with pytest.raises(InputError, match=r"size that the cameras see, 8\.8 x 7\.04 mm for 'cam0', found 60 x"):
        require_scale(PATH, volume, board, cameras)
    assert require_scale(PATH, volume, board, [*cameras, wide]) is None


@pytest.mark.parametrize("size", ["[0.0016, 0.0012, 0.0008]", "[4000.0, 4000.0, 4000.0]"])
def test_the_command_refuses_before_it_calibrates(tiny_experiment, tmp_path, capsys, size):
    text = tiny_experiment.read_text()
    line = next(line for line in text.splitlines() if line.startswith("size_mm"))
    tiny_experiment.write_text(text.replace(line, f"size_mm = {size}"))
    assert call(["run", str(tiny_experiment), "--out", str(tmp_path / "out")]) == 2
    message = capsys.readouterr().err
    assert message.count("\n") == 1 and "volume.size_mm" in message and "Lengths are in millimetres" in message
    assert not (tmp_path / "out").exists()


def test_units_are_checked_before_board_and_particle_images(tiny_experiment):
    for plane in tiny_experiment.parent.glob("board/*/*.tif"):
        tifffile.imwrite(plane, np.zeros((3, 3), np.uint16))
    text = tiny_experiment.read_text()
    tiny_experiment.write_text(text.replace("voxel_mm = 0.05", "voxel_mm = 0.0001"))
    with pytest.raises(InputError, match=r"volume\.voxel_mm: expected voxels of about a microlens"):
        read_experiment(tiny_experiment)
