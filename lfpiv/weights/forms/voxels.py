"""Weights of each voxel, as blocks of rays."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any, ClassVar

from lfpiv.progress import StepProgress
from lfpiv.weights.blocks import (
    BLOCK_BYTES,
    CHUNK_VOXELS,
    VOXEL_BYTES,
    PackedCamera,
    Places,
    footprint_blocks,
    sample_blocks,
)
from lfpiv.weights.choice import Choice
from lfpiv.weights.counting import CountedVoxels
from lfpiv.weights.forms.form import Form
from lfpiv.weights.memory_left import MemoryLeft, rays_bytes
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
        """Estimate by the blocks of some voxels."""
        blocks, values = self._sampled(name)
        size = (BLOCK_BYTES * blocks + values + VOXEL_BYTES) * self._places(name).size
        return int(size + 4 * MODEL_SIZE * CHUNK_VOXELS + rays_bytes(self.rig.cameras[name]))

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
        return (footprint_blocks(places, self.rig.cameras[name], choice.form, progress, allow, choice.cuts),)

    def _sampled(self, name: str) -> tuple[float, float]:
        """Return the mean numbers of blocks and of values of some places."""
        packed, choice = PackedCamera.of(self.rig.cameras[name]), self.rig.choice(name)
        return sample_blocks(packed, self._places(name), choice.form, choice.cuts)
