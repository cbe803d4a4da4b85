"""Spread of the lines of sight through a point, by which a rig resolves depth, and whether a part of the rays has it.

A ray tells where light lies across it, not along it. With the directions d of the rays through a point, the mean of
1 - d d^T states how well the point's place is known along each axis. Its least eigenvalue is the mean square sine of
the angles to the direction that is known worst: depth. Cameras at +-45 degrees have 0.5, a pupil of f/4 has 0.0025.

Ordered subsets take a row of the pupil each, of all cameras. Where depth comes from the angles between cameras, a row
of each camera resolves it as all rays do. Where it comes from the pupil alone, a row resolves less, and a row at the
edge hardly any. Steps by such rows move light along the lines of sight, and the volume follows single rows.
"""

from __future__ import annotations

import numpy as np

from lfpiv.weights.forms.node_grid import line_of_sight
from lfpiv.weights.operator import Weights

LEAST_SHARE = 0.5
"""Least spread in a row of the pupil, as a share of that of all rays, with which rows are subsets."""
PUPIL_POINTS = (-0.9, -0.45, 0.0, 0.45, 0.9)
"""Rows, and places along a row, relative to its ends and to the pupil's radius."""


def depth_spread(directions: np.ndarray) -> float:
    """Return the mean square sine of the angles to the direction that rays of directions (..., 3) know worst."""
    flat = directions.reshape(-1, 3)
    return float(1 - np.linalg.eigvalsh(flat.T @ flat / len(flat))[-1])


def rows_resolve_depth(weights: Weights) -> bool:
    """Return whether a row of the pupil of all cameras resolves depth in the middle of the grid as all rays do."""
    middle, rows = weights.grid.centre_mm, []
    for v in PUPIL_POINTS:
        sights = []
        for camera in weights.cameras.values():
            half = np.sqrt(1 - v**2)
            pupil = camera.optics.pupil_radius_mm * np.array([(u * half, v) for u in PUPIL_POINTS])
            sights.append([line_of_sight(camera, middle, point) for point in pupil])
        rows.append(np.array(sights))
    return min(map(depth_spread, rows)) >= LEAST_SHARE * depth_spread(np.array(rows))
