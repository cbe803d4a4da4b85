"""Weights of one camera as blocks of 8-bit levels, integrated in closed form.

The input is a camera and the ray models of voxels (`lfpiv.weights.ray_fit`). The kernels of
`lfpiv_kernels.weights.footprint` integrate a voxel's projection over microlens and pupil pixel, the limit of Eq. 10 for
many rays. The output is `Blocks`, one per camera.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from itertools import islice
from typing import TYPE_CHECKING, TypeAlias

import numpy as np
from threadpoolctl import threadpool_limits

from lfpiv.errors import InputError
from lfpiv.lightfield.microimage_layout import microimage_edge
from lfpiv.progress import StepProgress
from lfpiv.weights.ray_fit import ray_models
from lfpiv_kernels.rays.lattice import Lattice, cell_frame, cell_steps, pack_lattice
from lfpiv_kernels.reconstruction.projector import Blocks
from lfpiv_kernels.weights import footprint
from lfpiv_kernels.weights.ray_model import BLOCK_WIDTH, Camera, pack_optics

if TYPE_CHECKING:
    from lfpiv.calibration.camera import CalibratedCamera
    from lfpiv.weights.forms.node_grid import NodeGrid
    from lfpiv.weights.stored_grid import StoredGrid

Places: TypeAlias = "StoredGrid | NodeGrid"
"""Voxels, or nodes between them, whose weights are stored."""
Cuts = tuple[int, int, int]
"""Number of equal parts of a voxel along x, y, z. The footprints of the parts are integrated separately and added."""

WHOLE: Cuts = (1, 1, 1)
"""Voxel that is not cut."""
CHUNK_VOXELS = 16384
"""Number of voxels whose ray models are in memory at once."""
SAMPLED_VOXELS = 1024
"""Number of voxels from which the memory of all voxels is estimated."""
MOST_BLOCKS = np.iinfo(np.int32).max
"""Largest number of blocks of a camera: block indices have 32 bits."""
BLOCK_BYTES, VOXEL_BYTES = 6, 24
"""Memory of a block without its values, and of a voxel without its blocks [byte]."""


@dataclass(frozen=True, kw_only=True)
class PackedCamera:
    """Constants of one camera in the form that the kernels take."""

    calibrated: CalibratedCamera
    camera: Camera
    lattice: Lattice
    cell_mm: float
    """Half extent of a lens's cell along s and t [mm]."""
    frame: np.ndarray
    """From millimetres on the array to the frame of a lens's cell, see `lattice.cell_frame`, shape (2, 2)."""
    outline: np.ndarray
    """Outline of the cell in this frame, see `lattice.cell_steps`, shape (step, 2) [pitch]."""

    @classmethod
    def from_camera(cls, camera: CalibratedCamera) -> PackedCamera:
        """Pack a camera."""
        optics, lattice = camera.optics, camera.lattice
        basis = np.asarray(lattice.basis_mm)
        if lattice.layout == "square":
            cell = 0.5 * np.abs(basis).sum(0).max()
        else:
            cell = lattice.pitch_mm / math.sqrt(3)
        return cls(
            calibrated=camera,
            camera=pack_optics(
                sensor_per_pupil=optics.sensor_per_pupil,
                pixel_mm=optics.pixel_mm,
                sensor_shape=optics.sensor_shape,
                pupil_radius_mm=optics.pupil_radius_mm,
                edge=microimage_edge(optics),
            ),
            lattice=pack_lattice(np.asarray(lattice.origin_mm), basis),
            cell_mm=float(cell),
            frame=cell_frame(basis, lattice.layout),
            outline=cell_steps(lattice.layout),
        )

    def footprints(self, form: str, cuts: Cuts) -> footprint.Footprints:
        """Return the kernel's launcher for this camera's blocks of a form."""
        return footprint.Footprints(
            self.camera,
            self.lattice,
            self.cell_mm,
            self.calibrated.microimages,
            frame=self.frame,
            outline=self.outline,
            form=form,
            cuts=cuts,
        )


class Growing:
    """Array of unknown length that is filled piece by piece. Memory that is reserved but not written costs nothing."""

    def __init__(self, dtype: type, expected: int):
        self._array: np.ndarray = np.empty(max(expected, 1), dtype)
        self._used = 0

    def take(self, count: int) -> np.ndarray:
        """Return the next `count` entries. Write them before the next call."""
        first, self._used = self._used, self._used + count
        if self._used > len(self._array):
            self._array.resize(self._used + self._used // 8, refcheck=False)  # moves pages where the system can
        return self._array[first : self._used]

    def done(self) -> np.ndarray:
        """Return all entries taken."""
        self._array.resize(self._used, refcheck=False)
        return self._array


def footprint_blocks(
    places: Places,
    camera: CalibratedCamera,
    form: str,
    progress: StepProgress,
    allow: Callable[[int], None],
    cuts: Cuts,
) -> Blocks:
    """Integrate the blocks of all voxels of a grid, or of nodes, for one camera.

    `allow` is called with the estimated memory of the blocks [byte] before they are computed, and may raise.

    Raises
    ------
    InputError
        If there are more blocks than 32-bit indices can number, before they are computed.
    """
    shape, size = places.shape, places.size
    packed = PackedCamera.from_camera(camera)
    blocks, values = sample_blocks(packed, places, form, cuts)
    require_numbers(size * blocks, places.volume_shape)
    allow(int(size * (BLOCK_BYTES * blocks + values + VOXEL_BYTES)))
    planes = places.models(camera, form)

    def batches() -> Iterator[np.ndarray]:
        step = max(1, CHUNK_VOXELS * shape[0] // size)
        with threadpool_limits(1, "blas"):  # one product per plane is too small for BLAS's own threads
            for first in range(0, shape[0], step):
                yield np.concatenate(list(islice(planes, step)))
                progress(min(first + step, shape[0]) / shape[0])

    return blocks_of(packed, batches(), form, expected=(int(size * blocks), int(size * values)), cuts=cuts)


def require_numbers(blocks: float, shape: tuple[int, ...]) -> None:
    """Refuse more blocks than 32-bit indices can number."""
    if blocks > MOST_BLOCKS:
        voxels = " x ".join(map(str, shape))
        raise InputError(
            f"volume: the weights of {voxels} voxels on one camera need {blocks:.2g} blocks, but "
            f"{MOST_BLOCKS:.2g} can be numbered. Raise volume.voxel_mm, or shrink volume.size_mm."
        )


def sample_blocks(packed: PackedCamera, places: Places, form: str, cuts: Cuts) -> tuple[float, float]:
    """Return the mean number of blocks and of values per voxel in a sample of a grid's voxels, or of nodes."""
    model = _sampled_models(packed, places, form)
    blocks, values = (
        np.concatenate(counts) for counts in zip(*packed.footprints(form, cuts).compute(model), strict=True)
    )
    return float(blocks.mean()), float(values.mean())


def sample_rows(packed: PackedCamera, places: Places, form: str, cuts: Cuts) -> float:
    """Return the mean number of rows of rays per voxel in a sample of a grid's voxels, or of nodes."""
    blocks = blocks_of(packed, [_sampled_models(packed, places, form)], form, cuts=cuts)
    return float(blocks.height.sum(dtype=np.int64) / len(blocks.scale))


def _sampled_models(packed: PackedCamera, places: Places, form: str) -> np.ndarray:
    """Return the ray models of a sample of a grid's voxels, or of nodes."""
    sample = np.unique(np.linspace(0, places.size - 1, SAMPLED_VOXELS).astype(np.int64))
    return ray_models(packed.calibrated, places.centres_mm(sample), places.voxel_mm, form)


def blocks_of(
    packed: PackedCamera,
    models: Iterable[np.ndarray],
    form: str,
    *,
    expected: tuple[int, int] = (0, 0),
    cuts: Cuts = WHOLE,
) -> Blocks:
    """Integrate the blocks of voxels from their ray models, batch by batch.

    Parameters
    ----------
    models : iterable of ndarray, shape (voxel, 38), float32
        Ray models, one batch after the other.
    form : {"profiles", "pixels"}
        Form of the blocks.
    expected : tuple of int
        Expected numbers of blocks and values, for which memory is reserved.
    cuts : tuple of int
        Parts of a voxel along x, y, z, with the form "pixels".
    """
    footprints = packed.footprints(form, cuts)
    blocks, values = (int(1.02 * count) + BLOCK_WIDTH for count in expected)
    ray, height, width = (Growing(dtype, blocks) for dtype in (np.int32, np.uint8, np.uint8))
    value = Growing(np.uint8, values)
    counts, per_voxel = [], []
    for model in models:
        for count in footprints.compute(model):
            some = int(count[0].sum(dtype=np.int64))
            own = tuple(np.empty(len(count[0]), dtype) for dtype in (np.float32, np.int32, np.int32))
            room = value.take(int(count[1].sum(dtype=np.int64)))
            footprints.write(ray.take(some), height.take(some), width.take(some), room, own)
            counts.append(count)
            per_voxel.append(own)
    value.take(BLOCK_WIDTH)[:] = 0
    first_block, first_value = (
        np.concatenate([[0], *(count[k] for count in counts)]).cumsum(dtype=np.int64) for k in range(2)
    )
    require_numbers(first_block[-1], (len(first_block) - 1,))
    scale, even_blocks, even_values = (np.concatenate(parts) for parts in zip(*per_voxel, strict=True))
    return Blocks(
        form=form,
        first_block=first_block.astype(np.int32),
        first_value=first_value,
        ray=ray.done(),
        height=height.done(),
        width=width.done(),
        value=value.done(),
        scale=scale,
        even_blocks=even_blocks,
        even_values=even_values,
        microimages=packed.calibrated.microimages,
    )
