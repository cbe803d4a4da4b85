"""Taichi: trace rays from points in voxels through the pupil and the microlens array, count them per pixel (Eq. 10).

The mapping of each point is a third-order polynomial of the pupil point, fitted to the calibrated mapping. The mapping
is so smooth that evaluating it per ray would not be more accurate. Twin: ``reference.count``.
"""

import numpy as np

from lfpiv_kernels import runtime
from lfpiv_kernels.libraries import ti
from lfpiv_kernels.rays.lattice import Lattice, lens_centre, nearest_lens
from lfpiv_kernels.weights.ray_model import Camera

POWERS = ((0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2), (3, 0), (2, 1), (1, 2), (0, 3))
"""Exponents of u and v in the polynomial's terms."""


@ti.func
def _count_ray(
    rays: ti.template(),
    point,
    u,
    v,
    w,
    first_pixel: ti.template(),
    camera,
    lattice,
    hexagonal: ti.template(),
    count_out: ti.template(),
):
    """Trace the ray of a point through the pupil point (u, v) [mm], and count it in its pixel of window w."""
    st = ti.Vector([0.0, 0.0])
    for k in ti.static(range(2)):
        st[k] = (
            rays[point, k, 0]
            + u * (rays[point, k, 1] + u * (rays[point, k, 3] + u * rays[point, k, 6]))
            + v * (rays[point, k, 2] + v * (rays[point, k, 5] + v * rays[point, k, 9]))
            + u * v * (rays[point, k, 4] + u * rays[point, k, 7] + v * rays[point, k, 8])
        )
    lens = nearest_lens(lattice, st[0], st[1], hexagonal)
    centre = lens_centre(lattice, lens[0], lens[1])
    x = (centre[0] + camera[0] * (st[0] - u)) / camera[1] + camera[2]
    y = (centre[1] + camera[0] * (st[1] - v)) / camera[1] + camera[3]
    column = ti.cast(ti.floor(x), ti.i32) - first_pixel[w, 0]
    row = ti.cast(ti.floor(y), ti.i32) - first_pixel[w, 1]
    if 0 <= column < count_out.shape[2] and 0 <= row < count_out.shape[1]:
        count_out[w, row, column] += 1


@ti.kernel
def _count_rays(
    # in
    rays: ti.types.ndarray(dtype=ti.f32, ndim=3),
    shift: ti.types.ndarray(dtype=ti.f32, ndim=2),
    window: ti.types.ndarray(dtype=ti.i32, ndim=1),
    first_pixel: ti.types.ndarray(dtype=ti.i32, ndim=2),
    camera: Camera,
    lattice: Lattice,
    hexagonal: ti.template(),
    samples: ti.i32,
    per_ray: ti.template(),  # whether each ray is a task of its own, as a GPU wants it, or each point
    # out
    count_out: ti.types.ndarray(dtype=ti.i32, ndim=3),
    total_out: ti.types.ndarray(dtype=ti.i32, ndim=1),
):
    """Count rays; see `count_rays`. Taichi takes arrays only as arguments of their own, hence their number."""
    step = 2.0 * camera[4] / samples
    if ti.static(per_ray):
        for point, a, b in ti.ndrange(rays.shape[0], samples, samples):
            u = (a + shift[point, 0]) * step - camera[4]
            v = (b + shift[point, 1]) * step - camera[4]
            if u * u + v * v <= camera[4] * camera[4]:
                _count_ray(rays, point, u, v, window[point], first_pixel, camera, lattice, hexagonal, count_out)
                ti.atomic_add(total_out[window[point]], 1)
    else:
        for point in range(rays.shape[0]):
            traced = 0
            for a in range(samples):
                for b in range(samples):
                    u = (a + shift[point, 0]) * step - camera[4]
                    v = (b + shift[point, 1]) * step - camera[4]
                    if u * u + v * v <= camera[4] * camera[4]:
                        traced += 1
                        _count_ray(rays, point, u, v, window[point], first_pixel, camera, lattice, hexagonal, count_out)
            ti.atomic_add(total_out[window[point]], traced)


def count_rays(rays, shift, window, first_pixel, camera, lattice, *, hexagonal, samples, shape):
    """Trace rays from every object point through samples x samples pupil points and count them per pixel.

    It has nine parameters because each is one array or number of the launch.

    Parameters
    ----------
    rays : ndarray, shape (point, 2, 10), float32
        Polynomial of s and of t [mm] in the pupil point [mm], terms as in `POWERS`.
    shift : ndarray, shape (point, 2), float32
        Offset of each point's pupil grid, in [0, 1) of its step.
    window : ndarray, shape (point,), int32
        Window (voxel) in which a point's rays are counted.
    first_pixel : ndarray, shape (window, 2), int32
        (column, row) of each window's first pixel on the sensor. Rays outside a window are traced but not counted.
    camera, lattice
        From ``ray_model.pack_optics`` and `lattice.pack_lattice`.
    hexagonal : bool
        Layout of the array.
    samples : int
        Pupil points per axis. Those outside the pupil's disc are not traced.
    shape : tuple of int
        Rows and columns of a window.

    Returns
    -------
    count : ndarray, shape (window, *shape), int32
        Rays per pixel.
    total : ndarray, shape (window,), int32
        Rays traced.
    """
    per_ray = runtime.device_of_taichi().form == "gpu"
    count = np.zeros((len(first_pixel), *shape), np.int32)
    total = np.zeros(len(first_pixel), np.int32)
    arguments = (rays, shift, window, first_pixel, camera, lattice, bool(hexagonal), int(samples), per_ray)
    _count_rays(*arguments, count, total)
    ti.sync()
    return count, total
