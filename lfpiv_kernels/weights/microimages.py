"""Warp: the light of a sensor's pixels as rays, block by block of microimages; ``raymap`` maps the two to each other.

The layout is C++: NumPy took ten times as long. Twin of the shares: ``lfpiv.lightfield.decoder.disc_fraction``.
"""

import sys
from dataclasses import dataclass

import numpy as np
import warp as wp

from lfpiv_kernels import native, runtime
from lfpiv_kernels.weights.ray_model import BLOCK_WIDTH

wp.set_module_options(native.options("microimages.h", contract="off"))  # rounds as NumPy does

LAYERS = native.constant("microimages.h", "LAYERS")
"""Versions of each microimage."""


@dataclass(frozen=True, kw_only=True)
class Microimages:
    """How the rays of a camera's lenses lie in memory: blocks of edge x edge pixels, row by row.

    Every row of lenses comes in layers, of which each holds a block per lens, see ``footprint_source.LAYERS``.
    """

    first_lens: tuple[int, int]
    """Lattice indices (i, j) of the first lens; i runs fastest."""
    corner: np.ndarray
    """First pixel (column, row) of each lens's block, shape (lenses along j, lenses along i, 2), int32."""
    edge: int
    """Pixels along each side of a block."""
    pixel: np.ndarray
    """Sensor pixel of each ray, row by row; -1 outside the sensor. Shape (ray,), int32, some rays more than blocks."""
    share: np.ndarray
    """Fraction of the pixel's cell inside the pupil, shape (ray,), float32."""
    sensor_shape: tuple[int, int]
    """Rows and columns of the sensor [pixel]."""

    @property
    def size(self) -> int:
        """Number of rays, padding included."""
        return len(self.pixel)


@wp.func_native("""
    lfpiv::write_lens_rays(
        {centre.data, corner.data, lenses, edge, columns, rows, radius, curvature}, lens, pixel_out.data, share_out.data
    );
""")
def _write_lens_rays(
    lens: int,
    centre: wp.array(dtype=wp.float64),
    corner: wp.array(dtype=int),
    lenses: int,
    edge: int,
    columns: int,
    rows: int,
    radius: float,
    curvature: float,
    pixel_out: wp.array(dtype=int),
    share_out: wp.array(dtype=float),
): ...


@wp.kernel
def _lay_out(
    # in
    first_lens: int,
    centre: wp.array(dtype=wp.float64),  # (lens, 2), flat
    corner: wp.array(dtype=int),
    lenses: int,  # in a row
    edge: int,
    columns: int,
    rows: int,
    radius: float,  # [pixel]
    curvature: float,  # how far the edge's mean curvature moves it [pixel]
    # out
    pixel_out: wp.array(dtype=int),
    share_out: wp.array(dtype=float),
):
    lens = first_lens + wp.tid()
    _write_lens_rays(lens, centre, corner, lenses, edge, columns, rows, radius, curvature, pixel_out, share_out)


def lay_out(first_lens, centre, radius, edge, sensor_shape):
    """Lay a sensor's pixels out as the rays of its lenses.

    A pixel at a microimage's edge shows the part of its cell inside the pupil, whose middle lies inwards of its own: so
    a lens has more versions of its block, with shares for weights that fall or rise outwards.

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

    Returns
    -------
    Microimages
    """
    runtime.device()
    wp.load_module(sys.modules[__name__], device="cpu")  # before threads use it
    corner = np.floor(centre - radius).astype(np.int32)
    count = LAYERS * centre[..., 0].size * edge**2
    pixel, share = np.empty(count + BLOCK_WIDTH, np.int32), np.empty(count + BLOCK_WIDTH, np.float32)
    pixel[count:], share[count:] = -1, 0.0
    rows, columns = sensor_shape
    inputs = [
        *(wp.array(np.ravel(array), device="cpu", copy=False) for array in (centre, corner)),
        *(centre.shape[1], edge, columns, rows, radius, 1 / (24 * max(radius, 1.0))),
    ]
    outputs = [wp.array(array, device="cpu", copy=False) for array in (pixel, share)]

    def launch(_, first, last):
        wp.launch(_lay_out, dim=last - first, inputs=[first, *inputs], outputs=outputs, device="cpu")

    runtime.run_chunks(corner[..., 0].size, launch)
    return Microimages(
        first_lens=first_lens, corner=corner, edge=edge, pixel=pixel, share=share, sensor_shape=(rows, columns)
    )
