"""Warp: the pixels of a sensor as rays of its lenses, microimage by microimage.

A pixel under two microimages has a ray for each. A ray has a share: the fraction of the pixel's cell inside the pupil.
The loops are C++, see ``microimages.h``. Twin of the shares: ``lfpiv.lightfield.decoder.disc_fraction``.
"""

from dataclasses import dataclass

import numpy as np
import warp as wp

from lfpiv_kernels import native
from lfpiv_kernels.launch import Call, launch
from lfpiv_kernels.transfer import to_device
from lfpiv_kernels.weights.ray_model import BLOCK_WIDTH, ROW_GROUP

wp.set_module_options(native.options("microimages.h", contract="off"))  # rounds as NumPy does

LAYERS: int = native.constant("microimages.h", "LAYERS")
"""Versions of each microimage."""


@dataclass(frozen=True, kw_only=True)
class Microimages:
    """Where the rays of a camera's lenses lie in memory: blocks of edge x edge pixels, row by row.

    Every row of lenses has `LAYERS` layers. Each layer holds a block per lens.
    """

    first_lens: tuple[int, int]
    """Lattice indices (i, j) of the first lens; i runs fastest."""
    corner: np.ndarray
    """First pixel (column, row) of each lens's block, shape (lenses along j, lenses along i, 2), int32."""
    edge: int
    """Pixels along each side of a block."""
    pixel: np.ndarray
    """Sensor pixel of each ray, shape (ray,), int32: -1 outside the sensor. Some rays more than the blocks have."""
    share: np.ndarray
    """Fraction of the pixel's cell inside the pupil, shape (ray,), float32."""
    sensor_shape: tuple[int, int]
    """Rows and columns of the sensor [pixel]."""

    @property
    def lenses(self) -> int:
        """Number of lenses along i."""
        return int(self.corner.shape[1])

    @property
    def size(self) -> int:
        """Number of rays, padding included."""
        return len(self.pixel)


@wp.struct
class Layout:
    """The lenses and the sensor, see ``MicroimageLayout`` in ``microimages.h``."""

    centre: wp.array(dtype=wp.float64)
    corner: wp.array(dtype=int)
    lenses: int
    edge: int
    columns: int
    rows: int
    radius: float
    curvature: float


@native.kernel("""
    lfpiv::write_lens_rays(
        lfpiv::microimage_layout(layout), lens, pixel_out.data, share_out.data
    );
""")
def _write_lens_rays(
    # in
    layout: Layout,
    first_lens: int,
    # out
    pixel_out: wp.array(dtype=int),
    share_out: wp.array(dtype=float),
): ...


def lens_rays(first_lens, centre, radius, edge, sensor_shape):
    """Return a sensor's pixels as the rays of its lenses.

    Of a pixel at a microimage's edge, only a part lies inside the pupil. The middle of that part lies inwards of the
    pixel's middle. So each lens has several layers of its block, whose shares suit weights that fall or rise outwards.

    Parameters
    ----------
    first_lens : tuple of int
        Lattice indices (i, j) of the first lens.
    centre : ndarray, shape (lenses along j, lenses along i, 2), float64
        Centres (column, row) of the microimages; pixel n spans n to n + 1.
    radius : float
        Radius of a microimage [pixel].
    edge : int
        Pixels along each side of a block.
    sensor_shape : tuple of int
        Rows and columns of the sensor.
    """
    corner = np.floor(centre - radius).astype(np.int32)
    count = LAYERS * centre[..., 0].size * edge**2
    beyond = (ROW_GROUP - 1) * edge + BLOCK_WIDTH  # what a filled-up block may reach
    pixel, share = np.empty(count + beyond, np.int32), np.empty(count + beyond, np.float32)
    pixel[count:], share[count:] = -1, 0.0
    layout = Layout()
    layout.centre, layout.corner = (to_device(np.ravel(array), device="cpu") for array in (centre, corner))
    layout.lenses, layout.edge, layout.radius = centre.shape[1], edge, radius
    layout.rows, layout.columns = sensor_shape
    layout.curvature = 1 / (24 * max(radius, 1.0))  # how far the edge's mean curvature moves it within a pixel
    outputs = [to_device(array, device="cpu") for array in (pixel, share)]
    launch(Call(_write_lens_rays, corner[..., 0].size, [layout], outputs), device="cpu")
    return Microimages(
        first_lens=first_lens, corner=corner, edge=edge, pixel=pixel, share=share, sensor_shape=tuple(sensor_shape)
    )
