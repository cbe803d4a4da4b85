"""Compare the lengths of volume, voxels and board with what the cameras resolve and see, to refuse wrong units.

A length typed in metres is a thousandth of what is meant, one in micrometres a thousand times as much. The optics state
two lengths at the volume: what a microlens covers, the finest detail of a refocused image, and the field of view.
Volumes have some ten to a thousand microlenses across and are about as large as the field, voxels have 0.1 to 3
microlenses. The limits are outside of that: a factor of a thousand exceeds them, and no rig that can measure does.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from lfpiv.errors import InputError
from lfpiv.experiment.experiment import CameraSetup
from lfpiv.experiment.nominal_checks import field_mm
from lfpiv.geometry.optics import Optics
from lfpiv.settings.rig import NominalBoard
from lfpiv.settings.volume import Volume

FEWEST_LENSES_ACROSS = 2.0
"""Least length of a volume's longest edge [microlens]. Less holds no window of a correlation."""
FINEST_VOXEL = 0.1
"""Least edge of a voxel [pixel]. A tenth of what a pixel covers of the volume is finer than any image can show."""
COARSEST_VOXEL = 5.0
"""Largest edge of a voxel [microlens]. Particles and the flow between them are lost in larger voxels."""
LARGEST_VOLUME = 5.0
"""Largest extents of a volume across a camera's view, relative to its field of view; a camera sees 4 % of more."""
LEAST_DEPTH = 0.5
"""Least distance of the board's first and last plane [microlens]. Planes that are nearer show no depth."""

UNIT = "Lengths are in millimetres: is it in another unit?"


def require_scale(path: Path, volume: Volume, board: NominalBoard, cameras: Sequence[CameraSetup]) -> None:
    """Refuse a volume, voxels or planes of a board that are far too small or too large for all cameras.

    Parameters
    ----------
    path : Path
        The experiment file, for messages.
    cameras : sequence of CameraSetup
        All cameras. The finest of them decides what is too small, the widest what is too large.

    Raises
    ------
    InputError
        If the volume has less than `FEWEST_LENSES_ACROSS` microlenses, a voxel less than `FINEST_VOXEL` pixels or more
        than `COARSEST_VOXEL` microlenses, or the board's planes are nearer than `LEAST_DEPTH` microlenses; if the
        volume reaches to the main lenses, or is more than `LARGEST_VOLUME` times as large as the field of view, of all
        cameras.
    """
    size = " x ".join(f"{length:g}" for length in volume.size_mm) + " mm"
    finest = min(cameras, key=lambda camera: lens_mm(camera.optics))
    lens, pixel = lens_mm(finest.optics), min(pixel_mm(camera.optics) for camera in cameras)
    if max(volume.size_mm) < FEWEST_LENSES_ACROSS * lens:
        raise InputError(
            f"{path}: volume.size_mm: expected a volume of many microlenses, each of which covers {lens:.3g} mm of it "
            f"for camera {finest.name!r}, found {size}. {UNIT}"
        )
    if volume.voxel_mm < FINEST_VOXEL * pixel:
        raise InputError(
            f"{path}: volume.voxel_mm: expected voxels of about a microlens, which covers {lens:.3g} mm of the volume "
            f"for camera {finest.name!r}, a pixel {pixel:.2g} mm; found {volume.voxel_mm:g} mm. {UNIT}"
        )
    apart = max(board.planes_mm) - min(board.planes_mm)
    if apart < LEAST_DEPTH * lens:
        raise InputError(
            f"{path}: board.planes_mm: expected planes over about the depth of the volume, {volume.size_mm[2]:g} mm, "
            f"found all within {apart:.3g} mm, where a microlens covers {lens:.3g} mm. {UNIT}"
        )
    too_large = [_too_large(volume, camera) for camera in cameras]
    if all(too_large):
        raise InputError(f"{path}: volume.size_mm: expected {too_large[0]}, found {size}. {UNIT}")
    coarsest = max(lens_mm(camera.optics) for camera in cameras)
    if volume.voxel_mm > COARSEST_VOXEL * coarsest:
        raise InputError(
            f"{path}: volume.voxel_mm: expected voxels of about a microlens, which covers {coarsest:.3g} mm of the "
            f"volume, found {volume.voxel_mm:g} mm, larger than any particle's image. {UNIT}"
        )


def lens_mm(optics: Optics) -> float:
    """Return what a microlens covers of the focal plane [mm]."""
    return optics.microlens_pitch_mm / abs(optics.magnification)


def pixel_mm(optics: Optics) -> float:
    """Return what a pixel would cover of the focal plane without microlenses [mm]."""
    return optics.pixel_mm / abs(optics.magnification)


def _too_large(volume: Volume, camera: CameraSetup) -> str:
    """Return what was expected if the volume is too large for a camera, empty text if not."""
    optics, (wide, tall) = camera.optics, field_mm(camera.optics)
    across, along = _extents(volume, camera)
    reach = optics.object_distance_mm
    if along / 2 >= reach:
        return f"a volume in front of camera {camera.name!r}, whose main lens is {reach:g} mm from the origin"
    field = np.sort(field_mm(optics)) * (1 + along / (2 * reach))  # the view is wider behind the focal plane
    if (np.sort(across) > LARGEST_VOLUME * field).all():
        return f"a volume of about the size that the cameras see, {wide:.3g} x {tall:.3g} mm for {camera.name!r}"
    return ""


def _extents(volume: Volume, camera: CameraSetup) -> tuple[np.ndarray, float]:
    """Return the extents of the volume across a camera's view, shape (2,), and along it [mm].

    Of a camera without a nominal orientation they are the least ones that it can have.
    """
    if camera.orientation is None:
        shortest, middle, _ = sorted(volume.size_mm)
        return np.array([shortest, middle]), shortest
    x, y, z = np.abs(camera.orientation.rotation) @ np.array(volume.size_mm)
    return np.array([x, y]), float(z)
