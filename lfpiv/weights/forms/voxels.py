"""Weights of each voxel, as blocks of rays."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any, ClassVar

from lfpiv.progress import StepProgress
from lfpiv.weights.blocks import (
    BLOCK_BYTES,
    CHUNK_VOXELS,
    MOST_BLOCKS,
    VOXEL_BYTES,
    PackedCamera,
    Places,
    footprint_blocks,
    sample_blocks,
    sample_rows,
)
from lfpiv.weights.choice import Choice
from lfpiv.weights.counting import CountedVoxels
from lfpiv.weights.forms import shared_profiles
from lfpiv.weights.forms.form import Form
from lfpiv.weights.memory_left import MemoryLeft, rays_bytes
from lfpiv_kernels.reconstruction.block_rows import ROW_BYTES, have_loops, with_rows
from lfpiv_kernels.reconstruction.projector import Projector
from lfpiv_kernels.reconstruction.projector_gpu import MOST_BYTES, device_bytes
from lfpiv_kernels.reconstruction.ray_projector import RayProjector
from lfpiv_kernels.reconstruction.weight_blocks import Blocks
from lfpiv_kernels.weights.ray_model import MODEL_SIZE

if TYPE_CHECKING:
    from lfpiv.calibration.camera import CalibratedCamera


class Voxels(Form):
    """Weights of each voxel. They suit all cameras."""

    projector: ClassVar[type[Projector]] = Projector
    parts: ClassVar[tuple[type, ...]] = (Blocks,)

    @property
    def suits(self) -> Sequence[str]:
        """All cameras."""
        return self.names

    def host_bytes(self, name: str) -> int:
        """Estimate by the blocks of some voxels, without rows, which are left out where memory is short."""
        blocks, values = self._sampled(name)
        size = (BLOCK_BYTES * blocks + values + VOXEL_BYTES) * self._places(name).size
        return int(size + 4 * MODEL_SIZE * CHUNK_VOXELS + rays_bytes(self.rig.cameras[name]))

    def _row_bytes(self, name: str) -> int:
        """Estimate the memory of the rows of a camera's blocks [byte]."""
        sets = shared_profiles.ray_sets(self.rig.cameras)
        return int((ROW_BYTES * self._sampled_rows(name) + 4 * sets) * self._places(name).size)

    @cached_property
    def _row_sets(self) -> int:
        """Sets of rows of pixels that SMART can take alone; 1 where the sets are of lenses.

        All cameras have rows, or none. Small volumes have no rows, because their pairs take seconds. A single camera
        has none, because rows of one pupil do not resolve depth. A GPU has none, because its loops read whole blocks.
        Rows that do not fit into the memory are left out.
        """
        rig, sets = self.rig, shared_profiles.ray_sets(self.rig.cameras)
        several = len(rig.cameras) > 1
        many = rig.stored.size >= shared_profiles.FEWEST_VOXELS and sets >= shared_profiles.FEWEST_SETS
        if not (rig.shared and not rig.rays and several and many and have_loops()):
            return 1
        if max(self._sampled_rows(name) * self._places(name).size for name in self.suits) > MOST_BLOCKS:
            return 1
        needed = sum(self.host_bytes(name) + self._row_bytes(name) for name in self.suits)
        return sets if rig.memory.holds(needed, 0) else 1

    def device_bytes(self, name: str) -> int:
        """Estimate by the blocks of some voxels."""
        (blocks, values), size = self._sampled(name), self._places(name).size
        edge = self.rig.cameras[name].microimages.edge
        return device_bytes(self.rig.choice(name).form, size, int(blocks * size), int(values * size), edge=edge)

    def build(self, step: Callable[[str], StepProgress]) -> dict[str, RayProjector]:
        """Integrate the weights camera by camera."""
        rig, built = self.rig, dict[str, RayProjector]()
        for name in self.suits:
            allow = partial(rig.memory.require, name, rig.choice(name))
            parts = self._build_parts(name, step(name), allow)
            built[name] = self.load(name, parts, rig.cameras, rig.memory)
        return built

    @classmethod
    def load(
        cls, name: str, parts: Sequence[Any], cameras: Mapping[str, CalibratedCamera], memory: MemoryLeft
    ) -> RayProjector:
        """Make the projector of a camera from its parts; raise InputError if it does not fit into a GPU."""
        blocks: Blocks = parts[0]
        counts, edge = (len(blocks.scale), len(blocks.ray), len(blocks.value)), blocks.microimages.edge
        memory.require_device(name, device_bytes(blocks.form, *counts, edge=edge), MOST_BYTES)
        projector = cls.projector(*parts)
        memory.take(projector)
        return projector

    @staticmethod
    def count_errors(counted: CountedVoxels, projector: RayProjector, choice: Choice) -> list[float]:
        """Return the relative L2 differences of the weights themselves."""
        return counted.errors(projector)

    def _places(self, name: str) -> Places:
        """Return the places whose weights are stored."""
        return self.stored

    def _build_parts(self, name: str, progress: StepProgress, allow: Callable[[int], None]) -> tuple[Any, ...]:
        """Return the parts of a camera's weights."""
        choice, places = self.rig.choice(name), self._places(name)
        blocks = footprint_blocks(places, self.rig.cameras[name], choice.form, progress, allow, choice.cuts)
        return (with_rows(blocks, self._row_sets) if self._row_sets > 1 else blocks,)

    def _sampled(self, name: str) -> tuple[float, float]:
        """Return the mean numbers of blocks and of values of some places."""
        packed, choice = PackedCamera.from_camera(self.rig.cameras[name]), self.rig.choice(name)
        return sample_blocks(packed, self._places(name), choice.form, choice.cuts)

    def _sampled_rows(self, name: str) -> float:
        """Return the mean number of rows of rays of some places."""
        packed, choice = PackedCamera.from_camera(self.rig.cameras[name]), self.rig.choice(name)
        return sample_rows(packed, self._places(name), choice.form, choice.cuts)
