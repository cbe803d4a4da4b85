"""Light that each camera records of an evenly lit volume: the basis for comparing the brightness of cameras.

Only pixels count that are lit by voxels that all cameras see. They show the same particles in every camera.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from lfpiv_kernels.reconstruction.ray_projector import RayProjector

log = logging.getLogger(__name__)

WHOLLY_SEEN = 0.5
"""Least sum of a voxel's weights in a camera that sees the whole voxel, as a share of the largest sum in the volume."""
SHARED_LIGHT = 0.95
"""Least share of a pixel's light from voxels that all cameras see, for the pixel to count."""
LEAST_SHARED = 0.25
"""Least share of a camera's light in pixels that count, for its brightness to be compared."""


@dataclass(frozen=True)
class EvenLight:
    """Record of one camera of a volume with one unit of light per voxel."""

    light: float
    """Sum over the pixels that count."""
    shared: np.ndarray | None
    """Pixels that count, shape (pixel,), bool; None for all."""


def project_even_light(
    projectors: Mapping[str, RayProjector], gains: Mapping[str, np.ndarray], camera_sums: np.ndarray
) -> dict[str, EvenLight]:
    """Project an evenly lit volume onto all cameras.

    Parameters
    ----------
    projectors : mapping of str to RayProjector
        Weights of each camera.
    gains : mapping of str to ndarray, shape (pixel,), float32
        White-image gain of each camera.
    camera_sums : ndarray, shape (camera, voxel), float32
        Sum of each voxel's weights in each camera.

    Returns
    -------
    dict of str to EvenLight
        Empty if too few pixels of a camera count.
    """
    partly = np.zeros(camera_sums.shape[1], bool)
    for sums in camera_sums:
        partly |= sums < WHOLLY_SEEN * sums.max()
    even = {}
    for name, projector in projectors.items():
        shared = None
        image = projector.project(np.ones(len(partly), np.float32), np.empty_like(gains[name]))
        if partly.any():
            other = projector.project(partly.astype(np.float32), np.empty_like(gains[name]))
            shared = (image > 0) & (other <= (1 - SHARED_LIGHT) * image)
        image *= gains[name]
        light = float(image.sum(dtype=np.float64, where=True if shared is None else shared))
        if not light > LEAST_SHARED * float(image.sum(dtype=np.float64)):
            log.info("%s: too little of the volume is seen by all cameras to compare their brightness", name)
            return {}
        even[name] = EvenLight(light, shared)
    return even
