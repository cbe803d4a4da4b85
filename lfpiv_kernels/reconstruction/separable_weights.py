"""Weights of one camera as profiles that planes of voxels share, on the host."""

from dataclasses import dataclass, fields

import numpy as np

from lfpiv_kernels import native

STRIP: int = native.constant("separable_layout.h", "STRIP")
"""Rows of lenses side by side."""
PARTS: int = native.constant("separable_layout.h", "PARTS")
"""Parts of a strip with profiles across of their own; their rows of lenses take turns."""
COLUMN_BLOCK: int = native.constant("separable_layout.h", "COLUMN_BLOCK")
"""Columns of a plane whose profiles down begin at the same row of voxels."""
MOST_TAPS: int = native.constant("separable_layout.h", "MOST_TAPS")
"""Most columns of a plane that a pixel sees."""


@dataclass(frozen=True, kw_only=True)
class SeparableWeights:
    """Weights of all voxels of a grid for one camera, as products of two profiles each.

    The volume is cut into planes of rows and columns. Lenses are taken in strips of `STRIP` rows. A ray row is one row
    of pixels under all lenses. A ray lies at ``[ray row, strip, lens, pixel column, lens row of the strip]``.

    The weight of voxel (row b, plane p, column a) on the ray in pixel column c under lens (i, j), in ray row r, is the
    profile down ``D[p, r, j, a][b]`` times the profile across ``A[p, strip, i, c][a]``: rank 1 for each plane, ray row
    and lens row. Profiles across depend on the strip only. Within a strip the light moves along the columns from one
    lens row to the next, by `turn`. The pupil's edge cuts some pixels. The part of such a pixel inside the pupil has
    its middle nearer to the pupil's centre: `rim` times the difference of the neighbouring rays is added to its ray.
    """

    voxels: tuple[int, int, int]
    """Voxels along the axes in memory."""
    axes: tuple[int, int, int]
    """Axes in memory that count rows, planes and columns."""
    sensor_shape: tuple[int, int]
    """Rows and columns of the sensor [pixel]."""
    ray_rows: int
    """Rows of pixels under a lens."""
    strips: int
    """Strips of lenses."""
    lenses: int
    """Lenses in a row."""
    pixels: int
    """Columns of pixels under a lens."""
    middle: np.ndarray
    """Ray row of the microimages' centres, a fraction, lane by lane, shape (STRIP * strip,), float32."""
    down_first: np.ndarray
    """First row of voxels of each profile down, shape (plane, ray row, strip, block, STRIP), int16; -1 for none."""
    down: np.ndarray
    """Levels of the profiles down, in this order, for each `down_taps` x COLUMN_BLOCK, flat, uint8."""
    down_start: np.ndarray
    """Where those of a plane begin, shape (plane,), int64."""
    down_taps: np.ndarray
    """Rows of voxels in a profile down, shape (plane,), int32."""
    down_scale: np.ndarray
    """Weight of one level down times one level across, shape (plane,), float32."""
    lens: np.ndarray
    """First lens of each plane and strip, shape (plane, strip), int32."""
    lens_count: np.ndarray
    """Number of lenses, shape (plane, strip), int32."""
    taps: np.ndarray
    """Columns in a profile across, shape (plane, strip), int32."""
    first_start: np.ndarray
    """Where the first columns begin, shape (plane, strip), int64."""
    level_start: np.ndarray
    """Where the levels of profiles across begin, shape (plane, strip), int64."""
    first: np.ndarray
    """First column of a plane that each pixel column of a lens sees, flat, int16."""
    level: np.ndarray
    """Levels of the profiles across, `taps` x PARTS for each pixel column, flat, uint8; a vector more at the end."""
    turn: np.ndarray
    """Columns by which the light of a plane moves from one row of lenses, and one row of pixels, to the next, shape
    (plane, strip, 2), float32."""
    rim: np.ndarray
    """How much a ray takes of the difference of its neighbours, in levels, shape (ray,), int8."""
    pixel: np.ndarray
    """Sensor pixel of each ray, shape (ray,), int32: -1 outside the sensor."""
    share: np.ndarray
    """Fraction of the pixel's cell inside the pupil, shape (ray,), float32."""

    form = "profiles"

    @property
    def shape(self) -> tuple[int, int, int]:
        """Rows, planes and columns of voxels."""
        rows, planes, columns = (self.voxels[axis] for axis in self.axes)
        return rows, planes, columns

    @property
    def strides(self) -> tuple[int, int, int]:
        """Voxels in memory from one row, plane and column to the next."""
        of_axes = self.voxels[1] * self.voxels[2], self.voxels[2], 1
        rows, planes, columns = (of_axes[axis] for axis in self.axes)
        return rows, planes, columns

    @property
    def blocks(self) -> int:
        """Blocks of columns of a plane."""
        return -(-self.shape[2] // COLUMN_BLOCK)

    @property
    def rays_of_row(self) -> int:
        """Number of rays of a ray row."""
        return self.strips * self.lenses * self.pixels * STRIP

    @property
    def nbytes(self) -> int:
        """Memory of all arrays but those of the rays themselves [byte]."""
        arrays = (getattr(self, one.name) for one in fields(self) if one.name not in ("pixel", "share"))
        return sum(array.nbytes for array in arrays if isinstance(array, np.ndarray))

    @property
    def largest(self) -> float:
        """Largest product of two profiles of a plane."""
        best = 0.0
        for plane, scale in enumerate(self.down_scale.tolist()):
            here = slice(plane, plane + 2)
            down, level = (
                array[starts[0] : starts[1] if len(starts) > 1 else None].max(initial=0)
                for array, starts in ((self.down, self.down_start[here]), (self.level, self.level_start[here, 0]))
            )
            best = max(best, scale * float(down) * float(level))
        return best


def line_elements(lines: int, columns: int) -> int:
    """Return the number of elements of some lines of planes with so many columns, margins that stay dark included."""
    return lines * (-(-columns // COLUMN_BLOCK) * COLUMN_BLOCK + MOST_TAPS) * STRIP
