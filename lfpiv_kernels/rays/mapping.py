"""Taichi: evaluate the calibrated mapping, a network (Eqs. 6-7) plus a thin lens, at many points in single precision.

Twins in float64: ``lfpiv.calibration.network.Network`` and ``lfpiv.calibration.thin_lens_model.ThinLensModel``.
"""

import functools
from collections.abc import Mapping
from itertools import pairwise

import numpy as np

from lfpiv_kernels import runtime
from lfpiv_kernels.libraries import ti

BATCH = 8
"""Points that a CPU thread evaluates side by side, so that the compiler can use vector registers."""
CHUNK_RAYS = 1 << 24
"""Rays per launch, far below the limit of Taichi's 32-bit indices."""

_EXP2 = np.polynomial.Chebyshev.interpolate(np.exp2, 6, domain=[-0.5, 0.5]).convert(kind=np.polynomial.Polynomial)
_EXP2_TERMS = tuple(float(term) for term in _EXP2.convert(domain=[-1, 1]).coef[::-1])
"""Polynomial of 2^x on [-1/2, 1/2], highest power first; relative error 4e-9."""


@ti.func
def _tanh(x):
    """Return 1 - 2 / (1 + exp(2x)), with an exponential that the compiler can vectorise, unlike a library call."""
    power = ti.min(ti.max(x * 2.8853900817779268, -30.0), 30.0)  # exp(2x) = 2^power
    whole = ti.floor(power + 0.5)
    part = power - whole
    exponential = ti.f32(0.0)
    for term in ti.static(_EXP2_TERMS):
        exponential = exponential * part + term
    exponential *= ti.bit_cast((ti.cast(whole, ti.i32) + 127) << 23, ti.f32)
    return 1.0 - 2.0 / (1.0 + exponential)


@ti.func
def _read_inputs(
    raw: ti.template(),
    c,
    ray,
    points: ti.template(),
    pupil: ti.template(),
    inputs: ti.template(),
    fan: ti.template(),
):
    """Write the inputs of a ray into column c of `raw`; with a fan the last two are the pupil point."""
    if ti.static(fan):
        for i in ti.static(range(inputs - 2)):
            raw[i, c] = points[ray // pupil.shape[0], i]
        for i in ti.static(range(2)):
            raw[inputs - 2 + i, c] = pupil[ray % pupil.shape[0], i]
    else:
        for i in ti.static(range(inputs)):
            raw[i, c] = points[ray, i]


@ti.func
def _add_thin_lens(value: ti.template(), raw: ti.template(), c, lens: ti.template()):
    """Add (s, t) behind the thin lens `lens`, see `_pack_lens`, to column c of `value`."""
    x, y, z = raw[0, c] - lens[0], raw[1, c] - lens[1], raw[2, c] - lens[2]
    camera_z = lens[9] * x + lens[10] * y + lens[11] * z
    magnification = lens[13] / (lens[12] - camera_z)
    gain = lens[15] * (lens[14] + magnification * camera_z / lens[12])
    for o in ti.static(range(2)):
        camera = lens[3 + 3 * o] * x + lens[4 + 3 * o] * y + lens[5 + 3 * o] * z
        value[o, c] += lens[16 + o] + gain * raw[3 + o, c] - magnification * camera


def _layer_starts(sizes):
    """Return where each layer begins in the array of all layers, which holds the weights and the bias of each node."""
    first = [0]
    for fan_in, nodes in pairwise(sizes):
        first.append(first[-1] + (fan_in + 1) * nodes)
    return first


def _width(sizes):
    """Return the number of nodes that are stored: those of the last hidden layer are added to the outputs at once."""
    return max(sizes[:-2])


@ti.func
def _feed(value: ti.template(), held: ti.template(), layers: ti.template(), sizes: ti.template(), batch: ti.template()):
    """Feed the scaled inputs in `held` through the layers; add the last hidden layer's nodes to the outputs `value`."""
    first, hidden_layers, outputs = ti.static(_layer_starts(sizes), len(sizes) - 2, sizes[-1])
    width = ti.static(_width(sizes))
    for k in ti.static(range(hidden_layers)):
        fed = ti.static((k % 2) * width)
        for j in range(sizes[k + 1]):
            row = first[k] + (sizes[k] + 1) * j
            total = ti.Vector.zero(ti.f32, batch)
            for c in range(batch):
                total[c] = layers[row + sizes[k]]
            if ti.static(k == 0):
                for c in range(batch):
                    for i in ti.static(range(sizes[0])):
                        total[c] += layers[row + i] * held[i, c]
            else:
                for i in range(sizes[k]):
                    for c in range(batch):
                        total[c] += layers[row + i] * held[fed + i, c]
            if ti.static(k < hidden_layers - 1):
                for c in range(batch):
                    held[width - fed + j, c] = _tanh(total[c])
            else:
                for c in range(batch):
                    node = _tanh(total[c])
                    for o in ti.static(range(outputs)):
                        value[o, c] += layers[first[hidden_layers] + (sizes[-2] + 1) * o + j] * node


@functools.cache
def _kernel(sizes, batch, fan, has_lens):
    """Return the kernel of one architecture: `sizes` are inputs, nodes of each hidden layer, outputs.

    Taichi compiles it at its first call. Only the loops over inputs, outputs and layers are unrolled. Unrolled nodes
    would take a minute to compile for fifteen layers.
    """
    inputs, outputs, hidden_layers = sizes[0], sizes[-1], len(sizes) - 2
    first, width = _layer_starts(sizes), _width(sizes)

    @ti.kernel
    def _evaluate(
        # in
        points: ti.types.ndarray(dtype=ti.f32, ndim=2),  # (point, inputs), or (point, inputs - 2) with a fan
        pupil: ti.types.ndarray(dtype=ti.f32, ndim=2),  # (fan, 2): the last two inputs, for every point
        scaling: ti.types.ndarray(dtype=ti.f32, ndim=2),  # (2, inputs): centre, 1 / scale
        layers: ti.types.ndarray(dtype=ti.f32, ndim=1),
        lens: ti.types.ndarray(dtype=ti.f32, ndim=1),  # see _pack_lens
        # out
        values_out: ti.types.ndarray(dtype=ti.f32, ndim=2),  # (ray, outputs)
    ):
        rays = values_out.shape[0]
        for b in range((rays + batch - 1) // batch):
            raw = ti.Matrix.zero(ti.f32, inputs, batch)
            held = ti.Matrix.zero(ti.f32, 2 * width, batch)  # inputs and outputs of a layer in turn
            value = ti.Matrix.zero(ti.f32, outputs, batch)
            for c in range(batch):
                ray = ti.min(b * batch + c, rays - 1)
                _read_inputs(raw, c, ray, points, pupil, inputs, fan)
            for c in range(batch):
                for i in ti.static(range(inputs)):
                    held[i, c] = (raw[i, c] - scaling[0, i]) * scaling[1, i]
                for o in ti.static(range(outputs)):
                    value[o, c] = layers[first[hidden_layers] + (sizes[-2] + 1) * o + sizes[-2]]
            _feed(value, held, layers, sizes, batch)
            for c in range(batch):
                ray = b * batch + c
                if ray < rays:
                    if ti.static(has_lens):
                        _add_thin_lens(value, raw, c, lens)
                    for o in ti.static(range(outputs)):
                        values_out[ray, o] = value[o, c]

    return _evaluate


def evaluate(
    arrays: Mapping[str, np.ndarray],
    points: np.ndarray,
    pupil: np.ndarray | None = None,
    *,
    out: np.ndarray | None = None,
) -> np.ndarray:
    """Evaluate a mapping at many points on the running device.

    Parameters
    ----------
    arrays : mapping of str to ndarray
        ``Network.to_arrays()``; with ``| ThinLensModel.to_arrays()`` the thin lens is added to the network's outputs.
    points : ndarray, shape (n, d), float32
        Inputs, C-contiguous and finite; for a camera (x, y, z, u, v) [mm].
    pupil : ndarray, shape (k, 2), float32, optional
        Pupil points (u, v) [mm] of the rays from every point. Then `points` has the shape (n, d - 2), without u and v,
        and n k rays are evaluated without an array of all their inputs.
    out : ndarray, shape (n, m) or (n, k, m), float32, optional
        Array for the result.

    Returns
    -------
    ndarray, shape (n, m), or (n, k, m) with `pupil`; float32
        Outputs; for a camera (s, t) [mm].

    Raises
    ------
    ValueError
        If an array is missing, has another shape or dtype, or is not C-contiguous.
    """
    sizes, scaling, layers, lens = pack_mapping(arrays)
    fan = pupil is not None
    _check("points", points, (None, sizes[0] - 2 if fan else sizes[0]))
    if fan:
        _check("pupil", pupil, (None, 2))
    shape = (len(points), len(pupil), sizes[-1]) if fan else (len(points), sizes[-1])
    if out is None:
        out = np.empty(shape, np.float32)
    else:
        _check("out", out, shape)
    rays_per_point = len(pupil) if fan else 1
    if len(points) == 0 or rays_per_point == 0:
        return out
    device = runtime.device_of_taichi()
    kernel = _kernel(sizes, BATCH if device.form == "cpu" else 1, fan, lens is not None)
    pupil = pupil if fan else np.zeros((1, 2), np.float32)
    lens = np.zeros(1, np.float32) if lens is None else lens
    step = max(1, CHUNK_RAYS // rays_per_point)
    for start in range(0, len(points), step):
        part = slice(start, start + step)
        kernel(points[part], pupil, scaling, layers, lens, out[part].reshape(-1, sizes[-1]))
    ti.sync()
    return out


def pack_mapping(
    arrays: Mapping[str, np.ndarray],
) -> tuple[tuple[int, ...], np.ndarray, np.ndarray, np.ndarray | None]:
    """Return a mapping as the kernel takes it: sizes, input scaling, layers with output scaling, thin lens or None.

    Raises
    ------
    ValueError
        If an array is missing, or if there is a thin lens and the network does not map 5 inputs to 2 outputs.
    """
    try:
        depth = sum(name.startswith("weight_") for name in arrays)
        weights = [np.asarray(arrays[f"weight_{number}"], float) for number in range(depth)]
        biases = [np.asarray(arrays[f"bias_{number}"], float) for number in range(depth)]
        centre, scale, output_centre, output_scale = (
            np.asarray(arrays[name], float) for name in ("input_centre", "input_scale", "output_centre", "output_scale")
        )
        weights[-1], biases[-1] = weights[-1] * output_scale, biases[-1] * output_scale + output_centre
        lens = _pack_lens(arrays) if "thin_lens_rotation" in arrays else None
    except (KeyError, IndexError) as error:
        raise ValueError(f"arrays: expected the arrays of Network.to_arrays; {error} is missing.") from None
    sizes = (weights[0].shape[0], *(weight.shape[1] for weight in weights))
    if lens is not None and (sizes[0], sizes[-1]) != (5, 2):
        raise ValueError(
            f"arrays: a thin lens needs a network of 5 inputs (x, y, z, u, v) and 2 outputs, got {sizes[0]} and "
            f"{sizes[-1]}."
        )
    layers = [np.vstack([weight, bias]).T.ravel() for weight, bias in zip(weights, biases, strict=True)]
    return (
        sizes,
        np.stack([centre, 1 / scale]).astype(np.float32),
        np.concatenate(layers).astype(np.float32),
        lens,
    )


def _pack_lens(arrays):
    """Return a thin lens as 18 numbers: offset (3), rotation (9), s_o, s_i, 1 - s_i/f + s_i/s_o, pupil scale, axis (2).

    1 - s_i/f + s_i/s_o is computed in double precision; it is zero for a camera focused at its offset.
    """
    distance, focus = (float(arrays[f"thin_lens_{name}_distance_mm"]) for name in ("object", "image"))
    focal_length = float(arrays["thin_lens_focal_length_mm"])
    scalars = [distance, focus, 1 - focus / focal_length + focus / distance, float(arrays["thin_lens_pupil_scale"])]
    parts = [arrays["thin_lens_offset_mm"], arrays["thin_lens_rotation"], scalars, arrays["thin_lens_array_offset_mm"]]
    return np.concatenate([np.ravel(part) for part in parts]).astype(np.float32)


def _check(name, array, shape):
    """Raise ValueError unless `array` is a C-contiguous float32 array of the shape, in which None is any length."""
    expected = "(" + ", ".join("n" if length is None else str(length) for length in shape) + ")"
    found = getattr(array, "shape", None)
    fits = found is not None and len(found) == len(shape)
    if not fits or any(a != b for a, b in zip(found, shape, strict=True) if b is not None):
        raise ValueError(f"{name}: expected a NumPy array of shape {expected}, got {found or type(array).__name__}.")
    if array.dtype != np.float32 or not array.flags.c_contiguous:
        raise ValueError(
            f"{name}: expected C-contiguous float32, got {array.dtype}"
            f"{'' if array.flags.c_contiguous else ', not contiguous'}; use np.ascontiguousarray({name}, np.float32)."
        )
