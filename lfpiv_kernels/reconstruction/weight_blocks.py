"""Weights of one camera as 8-bit blocks of rays, on the host."""

from dataclasses import dataclass

import numpy as np
from scipy import sparse

from lfpiv_kernels.weights.microimages import Microimages
from lfpiv_kernels.weights.ray_model import LEVELS

LOOKED_AT = 16384
"""Voxels among whose weights the largest one is looked for at once."""


@dataclass(frozen=True, kw_only=True)
class BlockRows:
    """The rows of rays of blocks, set after set, see ``block_rows``."""

    sets: int
    """Sets of rows: row k of the pixels under a lens is in set k modulo `sets`."""
    first: np.ndarray
    """Index of the first row of each voxel, set after set, shape (set * voxel + 1,), int32."""
    ray: np.ndarray
    """Index of each row's first ray, shape (row,), int32."""
    level: np.ndarray
    """Weights in levels, `BLOCK_WIDTH` of each row, zero beyond its block, shape (row * BLOCK_WIDTH,), uint8."""

    @property
    def nbytes(self) -> int:
        """Memory of all arrays [byte]."""
        return self.first.nbytes + self.ray.nbytes + self.level.nbytes


@dataclass(frozen=True, kw_only=True)
class Blocks:
    """Weights of all voxels for one camera: a sparse matrix with 8-bit values and a scale per column.

    A block is `width` rays wide and `height` rows high. In the form "pixels" it has one value per ray, row by row. In
    the form "profiles" it has `width` values A, then `height` values B; the value of column c and row k is A[c] B[k].
    There `width` is `BLOCK_WIDTH` and `height` a multiple of `ROW_GROUP`, and blocks are sorted by it.
    """

    form: str
    """"profiles" or "pixels"."""
    first_block: np.ndarray
    """Index of each voxel's first block, shape (voxel + 1,), int32."""
    first_value: np.ndarray
    """Index of each voxel's first value, shape (voxel + 1,), int64."""
    ray: np.ndarray
    """Index of each block's first ray, shape (block,), int32."""
    height: np.ndarray
    """Rows of rays of each block, shape (block,), uint8."""
    width: np.ndarray
    """Rays in a row of each block, at most `BLOCK_WIDTH`, shape (block,), uint8."""
    value: np.ndarray
    """Weights in levels, shape (value + BLOCK_WIDTH,), uint8. A vector may be read past the last one."""
    scale: np.ndarray
    """Weight of one level, shape (voxel,), float32."""
    microimages: Microimages
    """Where the rays lie in memory."""
    even_blocks: np.ndarray | None = None
    """Number of each voxel's blocks under even lenses, which come first, shape (voxel,), int32; None for all."""
    even_values: np.ndarray | None = None
    """Number of their values, shape (voxel,), int32."""
    rows: BlockRows | None = None
    """The same weights by rows of pixels under every lens; None where these are not taken alone."""

    @property
    def row_scale(self) -> np.ndarray:
        """Weight of one level of `rows`, shape (voxel,), float32."""
        return self.scale * np.float32(LEVELS) if self.form == "profiles" else self.scale

    @property
    def nbytes(self) -> int:
        """Memory of all arrays [byte]."""
        names = ("first_block", "first_value", "ray", "height", "width", "value", "scale", "even_blocks", "even_values")
        arrays = [self.rows, *(getattr(self, name) for name in names)]
        return sum(array.nbytes for array in arrays if array is not None)

    def entries(self, voxel: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the rays of one voxel and their weights, shapes (entry,). A ray may occur twice."""
        value, rays, weights = int(self.first_value[voxel]), [], []
        for block in range(self.first_block[voxel], self.first_block[voxel + 1]):
            width, height = int(self.width[block]), int(self.height[block])
            rays.append(self.ray[block] + np.arange(height)[:, None] * self.microimages.edge + np.arange(width))
            if self.form == "profiles":
                across, down = np.split(self.value[value : value + width + height].astype(np.float64), [width])
                weights.append(down[:, None] * across)
                value += width + height
            else:
                weights.append(self.value[value : value + width * height].astype(np.float64))
                value += width * height
        if not rays:
            return np.zeros(0, np.int64), np.zeros(0)
        return np.concatenate(rays, axis=None), np.concatenate(weights, axis=None) * float(self.scale[voxel])

    def pixel_weights(self) -> sparse.csr_array:
        """Return the weights of some voxels on pixels, shape (voxel, pixel), float64. For few voxels."""
        width, height = self.width.astype(np.int64), self.height.astype(np.int64)
        profiles = self.form == "profiles"
        used = width + height if profiles else width * height
        first, size = np.cumsum(used) - used, width * height
        block = np.repeat(np.arange(len(size)), size)
        step = np.arange(len(block)) - (np.cumsum(size) - size)[block]
        row, column = np.divmod(step, width[block])
        level = self.value.astype(np.float64)
        if profiles:
            weight = level[first[block] + column] * level[first[block] + width[block] + row]
        else:
            weight = level[first[block] + step]
        voxel = np.repeat(np.arange(len(self.scale)), np.diff(self.first_block))[block]
        ray = self.ray[block] + row * self.microimages.edge + column
        weight *= self.microimages.share[ray] * self.scale[voxel].astype(np.float64)
        lit = weight > 0
        shape = len(self.scale), int(np.prod(self.microimages.sensor_shape))
        return sparse.coo_array((weight[lit], (voxel[lit], self.microimages.pixel[ray[lit]])), shape).tocsr()

    def largest_weight(self) -> float:
        """Return the largest weight of a ray. A pixel that a voxel reaches through two lenses has two rays."""
        order = 2 if self.form == "profiles" else 1
        share = self.microimages.share
        bound = self.scale.astype(np.float64) * LEVELS**order * share.max(initial=0.0)
        best = 0.0
        firsts = np.arange(0, len(bound), LOOKED_AT)
        for first in firsts[np.argsort(-np.maximum.reduceat(bound, firsts))] if len(firsts) else ():
            last = min(first + LOOKED_AT, len(bound))
            if bound[first:last].max() <= best:
                break
            bound[first:last] *= self._levels(first, last) / LEVELS**order
            for voxel in first + np.argsort(-bound[first:last]):
                if bound[voxel] <= best:
                    break
                ray, weight = self.entries(int(voxel))
                best = max(best, float((weight * share[ray]).max(initial=0.0)))
        return best

    def _levels(self, first: int, last: int) -> np.ndarray:
        """Return the largest level of each voxel from `first` to `last`; with profiles a product of two levels."""
        some = slice(self.first_block[first], self.first_block[last])
        width, height = (array[some].astype(np.int64) for array in (self.width, self.height))
        largest = np.zeros(last - first)
        if not len(width):
            return largest
        profiles = self.form == "profiles"
        sizes = np.stack([width, height], axis=1).ravel() if profiles else width * height
        level = self.value[self.first_value[first] : self.first_value[last]]
        tops = np.maximum.reduceat(level, np.cumsum(sizes) - sizes).astype(float)
        of_voxel = np.repeat(np.arange(last - first), np.diff(self.first_block[first : last + 1]))
        np.maximum.at(largest, of_voxel, tops[::2] * tops[1::2] if profiles else tops)
        return largest
