"""The rig in space: cameras with their pyramids of view, board planes, the volume, solids, and who sees each voxel."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import pyvista as pv
from numpy.typing import ArrayLike

from lfpiv.geometry.optics import Optics
from lfpiv.geometry.orientation import Orientation

SEEN_VOXELS = 32
"""Places along the longest axis at which it is counted how many cameras see them."""
REACH = 2.0
"""Length of the pyramids that are drawn towards the cameras, in diagonals of the volume."""
UNKNOWN_PIXELS = (2048, 2048)
"""Sensor of a camera whose white image is not there yet, (rows, columns)."""

View = tuple[np.ndarray, np.ndarray, np.ndarray]


def view_of(camera: Mapping[str, Any], shape: tuple[int, int]) -> View:
    """Return where a nominal camera stands and the rectangle that it sees in its plane of focus.

    Parameters
    ----------
    camera : mapping
        Values of its table in the experiment file.
    shape : (int, int)
        Rows and columns of its sensor.

    Returns
    -------
    pupil, corners, towards : ndarray, shapes (3,), (4, 3) and (3,)
        Middle of the main lens, corners of the rectangle, and the unit vector from the origin to the camera [mm].
    """
    rows, columns = shape
    names = ("focal_length_mm", "magnification", "f_number", "microlens_pitch_mm", "microlens_focal_length_mm")
    numbers: dict[str, Any] = {name: float(camera[name]) for name in names}
    optics = Optics(**numbers, pixel_mm=float(camera["pixel_um"]) / 1000, sensor_shape=shape)
    roll, direction = float(camera.get("nominal_roll_deg", 0.0)), camera.get("nominal_direction")
    if direction is None:
        orientation = Orientation(float(camera.get("nominal_angle_deg", 0.0)), 0.0, roll)
    else:
        orientation = Orientation.from_direction(direction, roll)
    right, up, towards = orientation.rotation
    half_x, half_y = (0.5 * n * optics.pixel_mm / abs(optics.magnification) for n in (columns, rows))
    corners = np.array([a * half_x * right + b * half_y * up for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))])
    return optics.object_distance_mm * towards, corners, towards


def pyramid(pupil: np.ndarray, corners: np.ndarray, length: float) -> pv.PolyData:
    """Return the lines from a camera's lens through the corners of what it sees, cut at a length from the origin."""
    distance = float(np.linalg.norm(pupil))
    share = min(1.0, length / distance)
    near = corners + share * (pupil - corners)
    far = corners - 0.35 * share * (pupil - corners)
    points = np.vstack([near, far, corners])
    lines = [[2, a, a + 4] for a in range(4)]
    lines += [[2, base + a, base + (a + 1) % 4] for base in (0, 4, 8) for a in range(4)]
    return pv.PolyData(points, lines=np.concatenate(lines))


def body(pupil: np.ndarray, length: float, size: float) -> pv.PolyData:
    """Return a cone where a camera stands, or on the way to it where that is far; it points at the volume."""
    towards = pupil / np.linalg.norm(pupil)
    place = towards * min(length, float(np.linalg.norm(pupil)))
    return pv.Cone(center=place, direction=-towards, height=size, radius=size / 2)


def inside(pupil: np.ndarray, corners: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return which points lie in the pyramid of view of a camera, bool."""
    towards = pupil / np.linalg.norm(pupil)
    depth = (pupil - points) @ towards
    plane = pupil + (points - pupil) * (np.linalg.norm(pupil) / np.maximum(depth, 1e-9))[:, None]
    across, up = (corners[1] - corners[0]) / 2, (corners[3] - corners[0]) / 2
    seen = (np.abs(plane @ across) <= across @ across) & (np.abs(plane @ up) <= up @ up) & (depth > 0)
    return np.asarray(seen)


def count_seen(views: list[View], centre: np.ndarray, size: np.ndarray) -> pv.ImageData:
    """Return how many cameras see each place of the volume, as cells of a coarse grid."""
    counts = np.maximum(2, np.round(SEEN_VOXELS * size / size.max())).astype(int)
    grid = pv.ImageData(dimensions=counts + 1, spacing=size / counts, origin=centre - size / 2)
    points = np.asarray(grid.cell_centers().points, float)
    seen = [inside(pupil, corners, points) for pupil, corners, _ in views]
    grid.cell_data["cameras"] = np.sum(seen, axis=0).astype(np.float32)
    return grid


def board_plane(board: Mapping[str, Any], z_mm: float) -> pv.PolyData:
    """Return the dots of a plane of the board as points."""
    nx, ny = board["dots"]
    x, y = ((np.arange(n) - (n - 1) / 2) * float(board["spacing_mm"]) for n in (nx, ny))
    points = np.stack(np.meshgrid(x, y, [z_mm]), axis=-1).reshape(-1, 3)
    return pv.PolyData(points)


def solid_shape(solid: Mapping[str, Any], centre: np.ndarray, size: np.ndarray) -> pv.DataSet:
    """Return the part of a solid that lies in the volume."""
    if solid["kind"] == "half_space":
        box = pv.Box(bounds_of(centre, size))
        return box.clip_closed_surface(normal=-np.asarray(solid["normal"], float), origin=solid["point_mm"])
    return pv.Box(bounds_of(solid["centre_mm"], solid["size_mm"]))


def bounds_of(centre: ArrayLike, size: ArrayLike) -> np.ndarray:
    """Return the least and largest x, y and z of a box, shape (6,)."""
    half = np.asarray(size, float) / 2
    return np.column_stack([np.asarray(centre) - half, np.asarray(centre) + half]).ravel()
