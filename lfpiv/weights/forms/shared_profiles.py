"""Profiles that planes of voxels share, for all cameras of a rig or for none.

Profiles are shared exactly where the rows of the array lie along those of the sensor and along an axis of the volume,
and nearly so where the array is turned a little. `SharedProfiles` makes them (`lfpiv.weights.forms.camera_profiles`)
and compares images of particles with those from the voxels' own footprints.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from lfpiv.progress import StepProgress
from lfpiv.weights.counting import draw_seen
from lfpiv.weights.forms.camera_profiles import CameraProfiles, radius_px
from lfpiv.weights.forms.form import Form
from lfpiv.weights.forms.image_errors import (
    PARTICLE_ERROR,
    PARTICLES,
    SEEDS,
    WORST_PARTICLE_ERROR,
    Sample,
    blobs_about,
)
from lfpiv.weights.memory_left import MemoryLeft
from lfpiv.weights.stored_grid import StoredGrid
from lfpiv_kernels.reconstruction.projector_separable import SeparableProjector
from lfpiv_kernels.reconstruction.ray_projector import RayProjector
from lfpiv_kernels.reconstruction.separable_gpu import device_bytes
from lfpiv_kernels.reconstruction.separable_weights import PARTS, SeparableWeights

if TYPE_CHECKING:
    from lfpiv.calibration.camera import CalibratedCamera

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


class SharedProfiles(Form):
    """Profiles that planes of voxels share. They suit all cameras of a rig, or none."""

    projector = SeparableProjector
    parts = (SeparableWeights,)

    @cached_property
    def stored(self) -> StoredGrid:
        """The voxels, with the axis inmost that moves their images most along the columns."""
        return StoredGrid.for_cameras(self.rig.stored.grid, self.rig.cameras.values(), columns_inmost=True)

    @cached_property
    def suits(self) -> Sequence[str]:
        """All cameras where the optics, the size of the volume and the memory allow it, or none."""
        rig = self.rig
        if not (rig.shared and self.names and len(self.names) == len(rig.cameras)):
            return ()
        if any(rig.choice(name).form != "profiles" for name in self.names) or not are_possible(
            self.stored, rig.cameras
        ):
            return ()
        for name, one in self._profiles.items():
            if not one.possible:
                log.debug("%s: a pixel sees too many voxels side by side for profiles of planes", name)
                return ()
        host, device = (sum(map(need, self.names)) for need in (self.host_bytes, self.device_bytes))
        if not rig.memory.holds(host, device):
            log.debug("profiles of planes do not fit the memory")
            return ()
        return self.names

    def host_bytes(self, name: str) -> int:
        """Estimate by some planes."""
        return self._profiles[name].estimated_bytes

    def device_bytes(self, name: str) -> int:
        """Estimate by some planes."""
        return self._profiles[name].device_bytes

    def build(self, step: Callable[[str], StepProgress]) -> dict[str, RayProjector]:
        """Build the profiles of all cameras; of none if images of particles are not accurate in one of them."""
        built, sets = dict[str, RayProjector](), ray_sets(self.rig.cameras)
        for name in self.suits:
            weights = self._profiles[name].weights(step(name))
            if weights is None:
                return {}
            built[name] = SeparableProjector(weights, sets)
            errors = particle_errors(self.stored, self.rig.cameras[name], built[name])
            error = float(np.sqrt(np.mean(np.square(errors)))) if errors else math.inf
            log.debug("%s: profiles of planes: images of particles differ by %.1f %%", name, 100 * error)
            if not (error <= PARTICLE_ERROR and max(errors) <= WORST_PARTICLE_ERROR):
                return {}
        for projector in built.values():
            self.rig.memory.take(projector)
        return built

    @classmethod
    def load(
        cls, name: str, parts: Sequence[Any], cameras: Mapping[str, CalibratedCamera], memory: MemoryLeft
    ) -> RayProjector:
        """Make the projector of a camera from its parts; raise InputError if it does not fit into a GPU."""
        weights: SeparableWeights = parts[0]
        _, planes, columns = weights.shape
        lines, rays = (planes * weights.strips, columns), weights.ray_rows * weights.rays_of_row
        size = device_bytes(weights.nbytes, weights.level.size // PARTS, lines, rays, weights.ray_rows)
        memory.require_device(name, size)
        projector = SeparableProjector(weights, ray_sets(cameras))
        memory.take(projector)
        return projector

    @cached_property
    def _profiles(self) -> dict[str, CameraProfiles]:
        return {name: CameraProfiles(self.stored, self.rig.cameras[name]) for name in self.names}


def are_possible(stored: StoredGrid, cameras: Mapping[str, CalibratedCamera]) -> bool:
    """Return whether profiles of planes may suit the cameras, by their lenses and the size of the volume."""
    square = all(camera.lattice.layout == "square" for camera in cameras.values())
    return square and stored.size >= FEWEST_VOXELS and ray_sets(cameras) >= FEWEST_SETS


def particle_errors(stored: StoredGrid, camera: CalibratedCamera, projector: RayProjector) -> list[float]:
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
