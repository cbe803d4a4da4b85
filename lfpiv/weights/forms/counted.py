"""Weights of each voxel by counting rays (Eq. 10), as blocks of 8-bit levels.

Every voxel is counted by ``lfpiv_kernels.rays.counted_blocks`` in batches of planes, whose blocks are joined.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from itertools import islice
from typing import TYPE_CHECKING, Any

import numpy as np
from threadpoolctl import threadpool_limits

from lfpiv.lightfield.microimage_layout import whole_microimages
from lfpiv.progress import StepProgress
from lfpiv.weights.blocks import BLOCK_BYTES, SAMPLED_VOXELS, VOXEL_BYTES, Growing, PackedCamera, require_numbers
from lfpiv.weights.forms.voxels import Voxels
from lfpiv.weights.ray_fit import ray_models
from lfpiv.weights.stored_grid import StoredGrid
from lfpiv_kernels.rays.counted_blocks import CountedBlocks
from lfpiv_kernels.reconstruction.projector import Blocks
from lfpiv_kernels.weights.microimages import Microimages
from lfpiv_kernels.weights.ray_model import BLOCK_WIDTH, pack_optics

if TYPE_CHECKING:
    from lfpiv.calibration.camera import CalibratedCamera

BATCH_VOXELS = 16384
"""Number of voxels in a batch, at least a plane of them."""
NAMES = ("blocks", "values", "even_blocks", "even_values", "scale", "ray", "height", "width", "value")
"""Arrays of a batch, as `CountedBlocks.compute` yields them."""

Batch = dict[str, np.ndarray]


class Counted(Voxels):
    """Weights of each voxel by counted rays. They suit all cameras where rays are to be counted."""

    @property
    def suits(self) -> Sequence[str]:
        """All cameras or none."""
        return self.names if self.rig.rays else ()

    def _build_parts(self, name: str, progress: StepProgress, allow: Callable[[int], None]) -> tuple[Any, ...]:
        """Count the weights of a camera."""
        return (count_blocks(self.stored, self.rig.cameras[name], self.rig.rays, progress, allow),)


def counter_of(camera: CalibratedCamera, rays: int) -> tuple[CountedBlocks, Microimages]:
    """Return the kernel's launcher for a camera, and where its rays lie in memory."""
    packed, optics = PackedCamera.from_camera(camera), camera.optics
    microimages = whole_microimages(optics, camera.lattice)
    constants = pack_optics(
        sensor_per_pupil=optics.sensor_per_pupil,
        pixel_mm=optics.pixel_mm,
        sensor_shape=optics.sensor_shape,
        pupil_radius_mm=optics.pupil_radius_mm,
        edge=microimages.edge,
    )
    hexagonal = camera.lattice.layout == "hexagonal"
    return CountedBlocks(constants, packed.lattice, microimages, hexagonal=hexagonal, rays=rays), microimages


def count_blocks(
    stored: StoredGrid,
    camera: CalibratedCamera,
    rays: int,
    progress: StepProgress,
    allow: Callable[[int], None],
) -> Blocks:
    """Count the rays of every voxel of a grid on one camera.

    Parameters
    ----------
    rays : int
        Rays per voxel: a power of 2, at most ``counted_blocks.MOST_RAYS``.
    progress : callable
        Called with the finished fraction after each batch.
    allow : callable
        Called with the estimated memory of the blocks [byte] before they are counted; may raise.

    Raises
    ------
    InputError
        If there are more blocks than 32-bit indices can number, before they are counted.
    """
    counter, microimages = counter_of(camera, rays)
    blocks, values = _sample(counter, stored, camera)
    require_numbers(stored.size * blocks, stored.volume_shape)
    allow(int(stored.size * (BLOCK_BYTES * blocks + values + VOXEL_BYTES)))
    room = {name: int(1.02 * stored.size * blocks) for name in ("ray", "height", "width")}
    room["value"] = int(1.02 * stored.size * values) + BLOCK_WIDTH
    dtypes = {"ray": np.int32, "height": np.uint8, "width": np.uint8, "value": np.uint8}
    joined = {name: Growing(dtypes[name], size) for name, size in room.items()}
    per_voxel: list[Batch] = []
    first = 0
    for model in _model_batches(stored, camera):
        batch = _joined(counter.compute(model, first))
        for name, array in joined.items():
            part = batch.pop(name)
            array.take(len(part))[:] = part
        per_voxel.append(batch)
        first += len(model)
        progress(first / stored.size)
    joined["value"].take(BLOCK_WIDTH)[:] = 0
    counts = {name: np.concatenate([batch[name] for batch in per_voxel]) for name in per_voxel[0]}
    first_block, first_value = (_starts(counts[name]) for name in ("blocks", "values"))
    require_numbers(first_block[-1], stored.volume_shape)
    return Blocks(
        form="pixels",
        first_block=first_block.astype(np.int32),
        first_value=first_value,
        scale=counts["scale"],
        even_blocks=counts["even_blocks"],
        even_values=counts["even_values"],
        microimages=microimages,
        rows=None,
        **{name: array.done() for name, array in joined.items()},
    )


def _starts(counts: np.ndarray) -> np.ndarray:
    """Return where each voxel's part begins, and the end of the last, shape (voxel + 1,), int64."""
    return np.concatenate([[0], np.cumsum(counts, dtype=np.int64)])


def _sample(counter: CountedBlocks, stored: StoredGrid, camera: CalibratedCamera) -> tuple[float, float]:
    """Return the mean number of blocks and of values per voxel in a sample of a grid's voxels."""
    sample = np.unique(np.linspace(0, stored.size - 1, SAMPLED_VOXELS).astype(np.int64))
    models = ray_models(camera, stored.centres_mm(sample), stored.voxel_mm, "count")
    batch = _joined(counter.compute(models))
    return float(batch["blocks"].mean()), float(batch["values"].mean())


def _model_batches(stored: StoredGrid, camera: CalibratedCamera) -> Iterator[np.ndarray]:
    """Yield the ray models of whole planes of voxels, some planes at a time."""
    planes = stored.models(camera, "count")
    step = max(1, BATCH_VOXELS * stored.shape[0] // stored.size)
    with threadpool_limits(1, "blas"):  # one product per plane is too small for BLAS's own threads
        while some := list(islice(planes, step)):
            yield np.concatenate(some)


def _joined(parts: Iterator[tuple[np.ndarray, ...]]) -> Batch:
    return {name: np.concatenate(arrays) for name, arrays in zip(NAMES, zip(*parts, strict=True), strict=True)}
