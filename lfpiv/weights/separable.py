"""Choice of profiles that planes of voxels share, for all cameras of a rig or for none.

Profiles are shared exactly where the rows of the array lie along those of the sensor and along an axis of the volume,
and nearly so where the array is turned a little. `choose_separable` makes them (`lfpiv.weights.separable_planes`) and
compares images of particles with those from the voxels' own footprints.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from lfpiv.progress import StepProgress, part_of
from lfpiv.weights.counting import draw_seen
from lfpiv.weights.depth_planes import (
    PARTICLE_ERROR,
    PARTICLES,
    SEEDS,
    WORST_PARTICLE_ERROR,
    Sample,
    blobs_about,
)
from lfpiv.weights.separable_planes import Planes, radius_px
from lfpiv.weights.stored_grid import StoredGrid
from lfpiv_kernels.reconstruction.projector_separable import SeparableProjector

if TYPE_CHECKING:
    from lfpiv.calibration.camera import CalibratedCamera
    from lfpiv.weights.device_share import DeviceShare

log = logging.getLogger(__name__)

MOST_SETS = 16
"""Most sets of ray rows. Each set makes a step of SMART."""
FEWEST_SETS = 4
"""Fewest rows of pixels across a microimage with which planes share profiles."""
FEWEST_VOXELS = 20_000
"""Fewest voxels of a volume whose planes share profiles."""


def ray_sets(cameras: Mapping[str, CalibratedCamera]) -> int:
    """Return the number of sets of ray rows: the rows of pixels across the smallest microimage, at most `MOST_SETS`."""
    return min(MOST_SETS, *(int(2 * radius_px(camera)) for camera in cameras.values()))


def choose_separable(
    stored: StoredGrid,
    cameras: Mapping[str, CalibratedCamera],
    share: DeviceShare,
    limit_bytes: float,
    progress: StepProgress,
) -> dict[str, SeparableProjector] | None:
    """Make the projectors of all cameras, if profiles of planes suit each of them.

    Parameters
    ----------
    stored : StoredGrid
        The voxels.
    cameras : mapping of str to CalibratedCamera
        The cameras, whose weights can be products of profiles.
    share : DeviceShare
        Free memory of the GPU, of which nothing is taken yet.
    limit_bytes : float
        Memory that the weights may take [byte].
    progress : callable
        Called with the finished fraction.

    Returns
    -------
    dict of str to SeparableProjector, or None
        None if the weights of all voxels, or of nodes, are to be stored.
    """
    each = possible_planes(stored, cameras, share)
    if each is None or sum(planes.estimated_bytes for planes in each.values()) > limit_bytes:
        return None
    projectors = {}
    for number, (name, planes) in enumerate(each.items()):
        weights = planes.weights(part_of(progress, number / len(cameras), (number + 1) / len(cameras)))
        if weights is None:
            return None
        projectors[name] = SeparableProjector(weights, ray_sets(cameras))
        errors = particle_errors(stored, planes.camera, projectors[name])
        error = float(np.sqrt(np.mean(np.square(errors)))) if errors else math.inf
        log.debug("%s: profiles of planes: images of particles differ by %.1f %%", name, 100 * error)
        if not (error <= PARTICLE_ERROR and max(errors) <= WORST_PARTICLE_ERROR):
            return None
    return projectors


def possible_planes(
    stored: StoredGrid, cameras: Mapping[str, CalibratedCamera], share: DeviceShare
) -> dict[str, Planes] | None:
    """Return the planes of all cameras; None where their profiles do not suit the cameras or do not fit a GPU.

    Whether they are accurate is not looked at.
    """
    if not are_possible(stored, cameras):
        return None
    each = {name: Planes(stored, camera) for name, camera in cameras.items()}
    for name, planes in each.items():
        if not planes.possible:
            log.debug("%s: a pixel sees too many voxels side by side for profiles of planes", name)
            return None
    if not share.holds([planes.device_bytes for planes in each.values()]):
        log.debug("profiles of planes do not fit the memory of the GPU")
        return None
    return each


def are_possible(stored: StoredGrid, cameras: Mapping[str, CalibratedCamera]) -> bool:
    """Return whether profiles of planes may suit the cameras, by their lenses and the size of the volume."""
    square = all(camera.lattice.layout == "square" for camera in cameras.values())
    return square and stored.size >= FEWEST_VOXELS and ray_sets(cameras) >= FEWEST_SETS


def particle_errors(stored: StoredGrid, camera: CalibratedCamera, projector: SeparableProjector) -> list[float]:
    """Compare images of particles with those from their voxels' own footprints: the relative L2 differences."""
    seen = np.unique(np.concatenate([draw_seen(stored, camera, seed) for seed in SEEDS]))
    if not len(seen):
        return []
    sample = Sample(camera, *blobs_about(stored, seen[:: len(seen) // PARTICLES + 1]), "profiles")
    exact = [row.toarray().ravel() for part in sample.own_images(stored) for row in part]
    errors = []
    for voxels, light, own in zip(sample.voxels, sample.light, exact, strict=True):
        volume = np.zeros(stored.size, np.float32)
        np.add.at(volume, voxels, light.astype(np.float32))
        image = projector.project(volume, np.zeros(len(own), np.float32))
        norm = float(np.linalg.norm(own))
        if norm > 0:
            errors.append(float(np.linalg.norm(image - own)) / norm)
    return errors
