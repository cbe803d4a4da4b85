"""Warp: forward projection, its adjoint and SMART's pointwise steps on weights stored as 8-bit blocks of pixels.

A block is LANES pixels wide and some rows high; its row is one vector load from the padded image, read as overlapping
vectors. The backward pass gathers per voxel. The forward pass scatters: on the CPU every chunk of voxels adds into an
image of its own and the images are summed in a fixed order, so results do not depend on the number of threads; on CUDA
it adds atomically. Twins: ``reference.project`` and ``reference.back_project``.
"""

import sys
from dataclasses import dataclass

import numpy as np
import warp as wp

from lfpiv_kernels import runtime
from lfpiv_kernels.footprint import LANES

# The default compiler flags stay: without SLP vectorisation a row of a block becomes scalar code.
wp.set_module_options({"enable_backward": False, "max_unroll": 8})

Row = wp.types.vector(length=LANES, dtype=float)
LevelRow = wp.types.vector(length=LANES, dtype=wp.uint8)


@dataclass(frozen=True, kw_only=True)
class Blocks:
    """Weights of all voxels for one camera; twin of a sparse matrix with 8-bit values and a scale per column."""

    first_block: np.ndarray
    """Index of each voxel's first block, shape (voxel + 1,), int32."""
    first_row: np.ndarray
    """Index of each voxel's first row of values, shape (voxel + 1,), int64."""
    pixel: np.ndarray
    """Index of each block's first pixel in the padded image, shape (block,), int32."""
    height: np.ndarray
    """Rows of each block, shape (block,), int32."""
    value: np.ndarray
    """Weights in levels, shape (row, LANES), uint8."""
    scale: np.ndarray
    """Weight of one level, shape (voxel,), float32."""
    shape: tuple[int, int]
    """Rows and columns of the padded image: the sensor's columns and at least LANES more."""

    @property
    def nbytes(self) -> int:
        """Memory of all arrays [byte]."""
        return sum(
            getattr(self, name).nbytes for name in ("first_block", "first_row", "pixel", "height", "value", "scale")
        )


@wp.func
def _levels(value: LevelRow):
    return Row(
        float(value[0]), float(value[1]), float(value[2]), float(value[3]),
        float(value[4]), float(value[5]), float(value[6]), float(value[7]),
    )  # fmt: skip


@wp.kernel
def _back_project(
    # in
    first_voxel: int,
    first_block: wp.array(dtype=int),
    first_row: wp.array(dtype=wp.int64),
    pixel: wp.array(dtype=int),
    height: wp.array(dtype=int),
    value: wp.array(dtype=LevelRow),
    scale: wp.array(dtype=float),
    stride: int,
    image: wp.array(dtype=Row),
    # out
    volume_out: wp.array(dtype=float),
):
    voxel = first_voxel + wp.tid()
    row = int(first_row[voxel])
    even = Row()
    odd = Row()
    for block in range(first_block[voxel], first_block[voxel + 1]):
        at = pixel[block]
        left = height[block]
        while left > 1:
            even += wp.cw_mul(image[at], _levels(value[row]))
            odd += wp.cw_mul(image[at + stride], _levels(value[row + 1]))
            at += 2 * stride
            row += 2
            left -= 2
        if left > 0:
            even += wp.cw_mul(image[at], _levels(value[row]))
            row += 1
    even += odd
    total = ((even[0] + even[4]) + (even[1] + even[5])) + ((even[2] + even[6]) + (even[3] + even[7]))
    volume_out[voxel] = volume_out[voxel] + scale[voxel] * total


@wp.kernel
def _project(
    # in
    first_voxel: int,
    first_block: wp.array(dtype=int),
    first_row: wp.array(dtype=wp.int64),
    pixel: wp.array(dtype=int),
    height: wp.array(dtype=int),
    value: wp.array(dtype=LevelRow),
    scale: wp.array(dtype=float),
    stride: int,
    volume: wp.array(dtype=float),
    # out
    image_out: wp.array(dtype=Row),
):
    voxel = first_voxel + wp.tid()
    intensity = volume[voxel] * scale[voxel]
    if intensity == 0.0:
        return
    row = int(first_row[voxel])
    for block in range(first_block[voxel], first_block[voxel + 1]):
        at = pixel[block]
        left = height[block]
        while left > 1:  # load two rows, then store two: twice as fast as adding in place
            even = image_out[at] + intensity * _levels(value[row])
            odd = image_out[at + stride] + intensity * _levels(value[row + 1])
            image_out[at] = even
            image_out[at + stride] = odd
            at += 2 * stride
            row += 2
            left -= 2
        if left > 0:
            last = image_out[at] + intensity * _levels(value[row])
            image_out[at] = last
            row += 1


@wp.kernel
def _project_atomic(
    # in
    first_block: wp.array(dtype=int),
    first_row: wp.array(dtype=wp.int64),
    pixel: wp.array(dtype=int),
    height: wp.array(dtype=int),
    value: wp.array(dtype=LevelRow),
    scale: wp.array(dtype=float),
    stride: int,
    volume: wp.array(dtype=float),
    # out
    image_out: wp.array(dtype=float),
):
    voxel = wp.tid()
    intensity = volume[voxel] * scale[voxel]
    if intensity == 0.0:
        return
    row = int(first_row[voxel])
    for block in range(first_block[voxel], first_block[voxel + 1]):
        for y in range(height[block]):
            levels = _levels(value[row])
            for lane in range(LANES):
                if levels[lane] > 0.0:
                    wp.atomic_add(image_out, pixel[block] + y * stride + lane, intensity * levels[lane])
            row += 1


@wp.kernel
def _log_ratio(
    # in
    first_pixel: int,
    image: wp.array(dtype=float),
    gain: wp.array(dtype=float),
    floor: float,
    projected: wp.array(dtype=float),
    # out
    ratio_out: wp.array(dtype=float),
):
    pixel = first_pixel + wp.tid()
    light = gain[pixel]
    ratio = float(0.0)
    if light > 0.0:
        ratio = light * wp.log((image[pixel] + floor) / (light * projected[pixel] + floor))
    ratio_out[pixel] = ratio


@wp.kernel
def _update(
    # in
    first_voxel: int,
    exponent: wp.array(dtype=float),
    step: wp.array(dtype=float),
    # out
    volume_out: wp.array(dtype=float),
):
    voxel = first_voxel + wp.tid()
    volume_out[voxel] = volume_out[voxel] * wp.exp(step[voxel] * exponent[voxel])


class Projector:
    """The linear map of one camera's weights on the running device: voxels to pixels of the padded image, and back.

    Arrays in and out are float32, C-contiguous and flat; on the CPU they are used in place.
    """

    def __init__(self, blocks: Blocks):
        self.blocks = blocks
        self._device = runtime.device()
        self._stride = blocks.shape[1]
        self._pixels = blocks.shape[0] * blocks.shape[1]
        self._matrix = [
            self._put(blocks.first_block, int),
            self._put(blocks.first_row, wp.int64),
            self._put(blocks.pixel, int),
            self._put(blocks.height, int),
            self._put(blocks.value, LevelRow),
            self._put(blocks.scale, float),
        ]
        wp.load_module(sys.modules[__name__], device=self._device.warp)  # before threads use it
        self._spans = [self._span(part) for part in range(runtime.CHUNKS)] if self._device.kind == "cpu" else []
        self._parts: list[np.ndarray] = []

    def _put(self, array, dtype):
        return wp.array(array, dtype=dtype, device=self._device.warp, copy=False)

    def _rows(self, flat):
        """View a flat padded image as overlapping rows of LANES pixels."""
        return wp.array(
            ptr=flat.ptr,
            dtype=Row,
            shape=(self._pixels - LANES + 1,),
            strides=(4,),
            device=self._device.warp,
            copy=False,
        )

    def _span(self, part):
        """First and last pixel that a chunk of voxels touches."""
        voxels = len(self.blocks.scale)
        a, b = (self.blocks.first_block[voxels * k // runtime.CHUNKS] for k in (part, part + 1))
        if a == b:
            return 0, 0
        pixel = self.blocks.pixel[a:b]
        return int(pixel.min()), int((pixel + (self.blocks.height[a:b] - 1) * self._stride).max()) + LANES

    def back_project(self, image: np.ndarray, out: np.ndarray) -> np.ndarray:
        """Add the weighted sum of `image` over each voxel's pixels to `out`, shape (voxel,); returns `out`."""
        flat, volume = self._put(image, float), self._put(out, float)
        rows = self._rows(flat)

        def launch(_, first, last):
            wp.launch(
                _back_project,
                dim=last - first,
                inputs=[first, *self._matrix, self._stride, rows],
                outputs=[volume],
                device=self._device.warp,
            )

        runtime.run_chunks(len(out), launch)
        if self._device.kind == "cuda":
            out[:] = volume.numpy()
        return out

    def project(self, volume: np.ndarray, out: np.ndarray) -> np.ndarray:
        """Write the image of `volume`, shape (voxel,), into `out`, shape (padded pixels,); returns `out`."""
        voxels = self._put(volume, float)
        out[:] = 0.0
        if self._device.kind == "cuda":
            image = self._put(out, float)
            wp.launch(
                _project_atomic,
                dim=len(volume),
                inputs=[*self._matrix, self._stride, voxels],
                outputs=[image],
                device=self._device.warp,
            )
            out[:] = image.numpy()
            return out
        if not self._parts:
            self._parts = [np.empty(last - first, np.float32) for first, last in self._spans]

        def launch(part, first, last):
            start, stop = self._spans[part]
            if start == stop:
                return
            scratch = self._parts[part]
            scratch[:] = 0.0
            rows = wp.array(
                ptr=scratch.ctypes.data - 4 * start, dtype=Row, shape=(stop,), strides=(4,), device="cpu", copy=False
            )
            wp.launch(
                _project,
                dim=last - first,
                inputs=[first, *self._matrix, self._stride, voxels],
                outputs=[rows],
                device="cpu",
            )

        runtime.run_chunks(len(volume), launch)
        for (start, stop), scratch in zip(self._spans, self._parts, strict=True):
            out[start:stop] += scratch
        return out


def log_ratio(image, gain, floor, projected, out):
    """SMART's log ratio gain * log((image + floor) / (gain * projected + floor)); zero where gain is zero.

    All arrays float32, shape (pixel,); returns `out`.
    """
    where = runtime.device().warp
    arrays = [wp.array(array, dtype=float, device=where, copy=False) for array in (image, gain, projected, out)]
    wp.load_module(sys.modules[__name__], device=where)

    def launch(_, first, last):
        wp.launch(
            _log_ratio,
            dim=last - first,
            inputs=[first, arrays[0], arrays[1], float(floor), arrays[2]],
            outputs=[arrays[3]],
            device=where,
        )

    runtime.run_chunks(len(out), launch)
    if where != "cpu":
        out[:] = arrays[3].numpy()
    return out


def update(volume, exponent, step):
    """SMART's step volume *= exp(step * exponent), in place; float32, shape (voxel,); returns `volume`."""
    where = runtime.device().warp
    arrays = [wp.array(array, dtype=float, device=where, copy=False) for array in (volume, exponent, step)]
    wp.load_module(sys.modules[__name__], device=where)

    def launch(_, first, last):
        wp.launch(_update, dim=last - first, inputs=[first, arrays[1], arrays[2]], outputs=[arrays[0]], device=where)

    runtime.run_chunks(len(volume), launch)
    if where != "cpu":
        volume[:] = arrays[0].numpy()
    return volume
