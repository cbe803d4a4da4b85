"""Warp: images of Gaussian particles and their derivatives by the position, as lists of pixels.

A pixel at X under the lens centred at c looks through the lens's centre at the pupil point P, and a particle's ray
through P misses the lens's centre by g = (I - K)^-1 ((s, t)(P) - c), see ``footprint``. The particle and the pixel
smear g. The weight is the amplitude of the pixel's cell on the pupil times the probability that g lies in the lens's
cell: differences of error functions along the cell's axes. A shift of the particle shifts g, so its derivative is a
difference of normal densities. Unlike the weights of voxels these are not rounded to levels. The loop over the pixels
of a lens is C++.

Twin: ``reference.gaussian_image``.
"""

from dataclasses import dataclass

import numpy as np
import warp as wp

from lfpiv_kernels import native
from lfpiv_kernels.launch import Call, launch
from lfpiv_kernels.transfer import to_device, to_host
from lfpiv_kernels.weights.microimages import LAYERS, Microimages

wp.set_module_options(native.options("gaussian.h", contract="fast"))

REACH: float = native.constant("gaussian.h", "REACH")
"""Distance from a cell at which a Gaussian is cut off [standard deviation]."""
VALUES: int = native.constant("gaussian.h", "VALUES")
"""Numbers of a pixel: derivatives by x, y, z, and the weight."""
PARTS = 16
"""Parts of a launch on the CPU: the work differs from particle to particle."""


@wp.struct
class Inputs:
    """What the kernels read: ray models of the particles and the camera."""

    model: wp.array2d(dtype=float)
    """Ray models, (particle, MODEL_SIZE)."""
    scale: float
    """Standard deviation of the particles over the length of the models' edges."""
    ratio: float
    """r = f_m / s_i."""
    pixel_mm: float
    half: wp.vec2f
    """Half the sensor (columns, rows) [pixel]."""
    radius: float
    """Of the pupil [mm]."""
    origin: wp.vec2f
    basis: wp.mat22f
    """Columns: (s, t) from a lens to the next along i and along j [mm]."""
    inverse: wp.mat22f
    """From (s, t) to lattice indices [1/mm]."""
    frame: wp.mat22f
    """From (s, t) to the axes (a, b) of a lens's cell [pitch]."""
    lenses: wp.vec4i
    """First i and j, lenses along i and j."""
    corners: wp.array(dtype=int)
    rectangles: wp.array2d(dtype=float)
    """Rectangles of a lens's cell, (a_low, a_high, b_low, b_high) [pitch]."""
    extent: wp.vec2f
    """Half extents of the cell along a and b [pitch]."""
    edge: int
    """Side of a microimage's block [pixel]."""
    pixel: wp.array(dtype=int)
    share: wp.array(dtype=float)
    gain: wp.array(dtype=float)


@wp.struct
class View:
    """How a camera sees one particle: about the same for all of its pixels, because K is small and hardly varies."""

    to_cell: wp.mat22f
    """From (s, t) to the axes of a lens's cell, F (I - K)^-1 [pitch / mm]."""
    at: wp.vec2f
    """(s, t) of the ray through the pupil's centre [mm]."""
    fan: wp.vec2f
    """Largest change of a and b over the pupil [pitch]."""
    sigma: wp.vec2f
    """Standard deviation of the particle's image along a and b [pitch]."""
    amplitude: float
    """Share of the light that reaches a pixel if all of it passes the lens."""
    bounds: wp.vec4i
    """First i and j, last i and j of the lenses that the light can reach, counted from the first lens."""


@wp.func
def _position(inputs: Inputs, particle: int, p: wp.vec2f):
    """Return (s, t) of the particle's ray through a pupil point [mm]."""
    m = inputs.model[particle]
    u, v = p[0], p[1]
    s = m[0] + u * (m[1] + u * (m[3] + u * m[30] + v * m[31]) + v * m[4])
    s += v * (m[2] + v * (m[5] + u * m[32] + v * m[33]))
    t = m[6] + u * (m[7] + u * (m[9] + u * m[34] + v * m[35]) + v * m[10])
    t += v * (m[8] + v * (m[11] + u * m[36] + v * m[37]))
    return wp.vec2f(s, t)


@wp.func
def _slope(inputs: Inputs, particle: int, p: wp.vec2f):
    """Return K = d(s, t)/d(u, v)."""
    m = inputs.model[particle]
    u, v = p[0], p[1]
    return wp.mat22f(
        m[1] + 2.0 * (m[3] + 1.5 * m[30] * u + m[31] * v) * u + (m[4] + m[32] * v) * v,
        m[2] + (m[4] + m[31] * u) * u + 2.0 * (m[5] + m[32] * u + 1.5 * m[33] * v) * v,
        m[7] + 2.0 * (m[9] + 1.5 * m[34] * u + m[35] * v) * u + (m[10] + m[36] * v) * v,
        m[8] + (m[10] + m[35] * u) * u + 2.0 * (m[11] + m[36] * u + 1.5 * m[37] * v) * v,
    )


@wp.func
def _edge(inputs: Inputs, particle: int, axis: int, p: wp.vec2f):
    """Return the change of (s, t) over a voxel along an axis [mm]."""
    m = inputs.model[particle]
    k, c = 12 + 2 * axis, 18 + 4 * axis
    return wp.vec2f(m[k] + m[c] * p[0] + m[c + 1] * p[1], m[k + 1] + m[c + 2] * p[0] + m[c + 3] * p[1])


@wp.func
def _view(inputs: Inputs, particle: int):
    """Return how the camera sees a particle."""
    view = View()
    middle = wp.vec2f(0.0, 0.0)
    k = _slope(inputs, particle, middle)
    turned = wp.inverse(wp.mat22f(1.0, 0.0, 0.0, 1.0) - k)
    cell = inputs.pixel_mm / inputs.ratio
    view.to_cell = inputs.frame @ turned
    view.at = _position(inputs, particle, middle)
    view.amplitude = wp.abs(wp.determinant(turned)) * cell * cell / (3.14159265 * inputs.radius * inputs.radius)
    m = inputs.model[particle]
    bend = wp.vec2f(wp.abs(m[3]) + wp.abs(m[4]) + wp.abs(m[5]), wp.abs(m[9]) + wp.abs(m[10]) + wp.abs(m[11]))
    for n in range(4):
        bend += 3.0 * inputs.radius * wp.vec2f(wp.abs(m[30 + n]), wp.abs(m[34 + n]))
    outer = inputs.radius + cell
    along = view.to_cell @ k
    back = inputs.inverse
    centre = back @ (view.at - inputs.origin)
    for axis in range(2):
        smear = wp.vec2f(along[axis, 0], along[axis, 1])
        variance = wp.dot(smear, smear) * cell * cell / 12.0
        for direction in range(3):
            edge = view.to_cell @ _edge(inputs, particle, direction, middle)
            variance += edge[axis] * edge[axis] * inputs.scale * inputs.scale
        row = wp.vec2f(wp.abs(view.to_cell[axis, 0]), wp.abs(view.to_cell[axis, 1]))
        view.sigma[axis] = wp.sqrt(variance)
        view.fan[axis] = wp.length(smear) * outer + wp.dot(row, bend) * outer * outer
    reach = inputs.extent + view.fan + REACH * view.sigma
    farthest = wp.length(reach) / wp.min(wp.length(view.to_cell[0]), wp.length(view.to_cell[1]))
    for axis in range(2):
        half = farthest * wp.length(back[axis])
        view.bounds[axis] = wp.max(int(wp.ceil(centre[axis] - half)) - inputs.lenses[axis], 0)
        view.bounds[2 + axis] = wp.min(
            int(wp.floor(centre[axis] + half)) - inputs.lenses[axis], inputs.lenses[2 + axis] - 1
        )
    return view


@wp.func
def _lens_centre(inputs: Inputs, i: int, j: int):
    """Return the centre of a lens, counted from the first one [mm]."""
    return inputs.origin + inputs.basis @ wp.vec2f(float(i + inputs.lenses[0]), float(j + inputs.lenses[1]))


@wp.func
def _reaches(inputs: Inputs, view: View, centre: wp.vec2f):
    """Return whether light of the particle can reach a lens."""
    at = view.to_cell @ (view.at - centre)
    reach = inputs.extent + view.fan + REACH * view.sigma
    return wp.abs(at[0]) < reach[0] and wp.abs(at[1]) < reach[1]


@wp.func_native("""
    return lfpiv::write_lens(
        inputs, view, particle, lens, ray, centre[0], centre[1],
        pixel_out.data + first, (float*)(values_out.data + first)
    );
""")
def _write_lens(
    inputs: Inputs,
    view: View,
    particle: int,
    lens: int,
    ray: int,
    centre: wp.vec2f,
    first: wp.int64,
    pixel_out: wp.array(dtype=int),
    values_out: wp.array(dtype=wp.vec4f),
) -> int: ...


@wp.kernel
def _bound_pixels(
    # in
    inputs: Inputs,
    first_particle: int,
    # out
    most_out: wp.array(dtype=int),
    box_out: wp.array(dtype=wp.vec4i),
):
    particle = first_particle + wp.tid()
    view = _view(inputs, particle)
    box_out[particle] = view.bounds
    lenses = wp.int32(0)
    for j in range(view.bounds[1], view.bounds[3] + 1):
        for i in range(view.bounds[0], view.bounds[2] + 1):
            if _reaches(inputs, view, _lens_centre(inputs, i, j)):
                lenses += 1
    most_out[particle] = lenses * inputs.edge * inputs.edge


@wp.kernel
def _write_pixels(
    # in
    inputs: Inputs,
    room: wp.array(dtype=wp.int64),  # first entry that each particle may write
    first_particle: int,
    # out
    count_out: wp.array(dtype=int),
    pixel_out: wp.array(dtype=int),
    values_out: wp.array(dtype=wp.vec4f),
):
    particle = first_particle + wp.tid()
    view = _view(inputs, particle)
    count = wp.int32(0)
    for j in range(view.bounds[1], view.bounds[3] + 1):
        for i in range(view.bounds[0], view.bounds[2] + 1):
            centre = _lens_centre(inputs, i, j)
            if _reaches(inputs, view, centre):
                lens = j * inputs.lenses[2] + i
                ray = ((j * LAYERS + 1) * inputs.lenses[2] + i) * inputs.edge * inputs.edge
                first = room[particle] + wp.int64(count)
                count += _write_lens(inputs, view, particle, lens, ray, centre, first, pixel_out, values_out)
    count_out[particle] = count


@native.kernel("""
    for (int64_t from = room.data[particle], to = first.data[particle]; to < first.data[particle + 1]; ++from, ++to) {
        pixel_out.data[to] = pixel.data[from];
        values_out.data[to] = values.data[from];
    }
""")
def _close_gaps(
    # in
    room: wp.array(dtype=wp.int64),
    first: wp.array(dtype=wp.int64),
    pixel: wp.array(dtype=int),
    values: wp.array(dtype=wp.vec4f),
    first_particle: int,
    # out
    pixel_out: wp.array(dtype=int),
    values_out: wp.array(dtype=wp.vec4f),
): ...


@dataclass(frozen=True, kw_only=True)
class ImageLists:
    """Pixels of some particles in one camera."""

    first: np.ndarray
    """First entry of each particle, and the end of the last, shape (particle + 1,), int64."""
    pixel: np.ndarray
    """Pixels, shape (entry,), int32. A pixel that a particle lights through two lenses occurs twice."""
    values: np.ndarray
    """Derivatives of the weight by x, y, z [1 / voxel] and the weight, shape (entry, 4), float32."""
    box: np.ndarray
    """First i and j, last i and j of the lenses that each particle can light, shape (particle, 4), int32."""


class GaussianImages:
    """Images of Gaussian particles in one camera.

    Parameters
    ----------
    camera, lattice
        From ``ray_model.pack_optics`` and ``lattice.pack_lattice``.
    microimages : Microimages
        Where the pixels of a lens lie in memory.
    frame : ndarray, shape (2, 2)
        From ``lattice.cell_frame``.
    rectangles : ndarray, shape (rectangle, 4)
        From ``lattice.cell_rectangles``.
    gain : ndarray, shape (pixel,)
        White-image gain. Pixels without gain are left out.
    """

    def __init__(self, camera, lattice, microimages: Microimages, *, frame, rectangles, gain):
        optics, lens = camera.to_numpy(), lattice.to_numpy()
        rows, columns = microimages.corner.shape[:2]
        inputs = Inputs()
        inputs.ratio, inputs.pixel_mm = float(optics[0]), float(optics[1])
        inputs.half, inputs.radius = wp.vec2f(*map(float, optics[2:4])), float(optics[4])
        inputs.origin = wp.vec2f(*map(float, lens[:2]))
        inputs.basis = wp.mat22f(*map(float, lens[2:6].reshape(2, 2).T.ravel()))
        inputs.inverse = wp.mat22f(*map(float, lens[6:10]))
        inputs.frame = wp.mat22f(*map(float, np.ravel(frame)))
        inputs.lenses = wp.vec4i(*map(int, microimages.first_lens), columns, rows)
        inputs.corners = to_device(np.ascontiguousarray(microimages.corner.ravel()))
        inputs.rectangles = to_device(np.ascontiguousarray(rectangles, np.float32))
        inputs.extent = wp.vec2f(float(rectangles[:, 1].max()), float(rectangles[:, 3].max()))
        inputs.edge = int(microimages.edge)
        inputs.pixel, inputs.share = to_device(microimages.pixel), to_device(microimages.share)
        inputs.gain = to_device(np.ascontiguousarray(gain, np.float32).reshape(-1))
        self._inputs = inputs

    def __call__(self, model: np.ndarray, sigma: float) -> ImageLists:
        """Compute the images of particles.

        Parameters
        ----------
        model : ndarray, shape (particle, MODEL_SIZE), float32
            Ray models at the particles, see ``ray_model.MODEL_SIZE``.
        sigma : float
            Standard deviation of the particles [edge of the models].
        """
        inputs, count = self._inputs, len(model)
        inputs.model = to_device(np.ascontiguousarray(model, np.float32))
        inputs.scale = float(sigma)
        most = to_device(np.zeros(count, np.int32))
        box = to_device(np.zeros((count, 4), np.int32), wp.vec4i)
        launch(Call(_bound_pixels, count, [inputs], [most, box]), parts=PARTS)
        room = np.concatenate([[0], np.cumsum(to_host(most), dtype=np.int64)])
        used = to_device(np.zeros(count, np.int32))
        pixel = to_device(np.empty(room[-1], np.int32))
        values = to_device(np.empty((room[-1], VALUES), np.float32), wp.vec4f)
        launch(Call(_write_pixels, count, [inputs, to_device(room)], [used, pixel, values]), parts=PARTS)
        first = np.concatenate([[0], np.cumsum(to_host(used), dtype=np.int64)])
        closed = np.empty(first[-1], np.int32), np.empty((first[-1], VALUES), np.float32)
        outputs = [to_device(closed[0]), to_device(closed[1], wp.vec4f)]
        launch(Call(_close_gaps, count, [to_device(room), to_device(first), pixel, values], outputs), parts=PARTS)
        return ImageLists(first=first, pixel=to_host(outputs[0]), values=to_host(outputs[1]), box=to_host(box))
