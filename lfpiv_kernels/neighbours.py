"""What the 26 neighbours of a vector say about it: robust predictions for outlier detection and filling."""

from dataclasses import dataclass

import numpy as np
import warp as wp

from . import runtime

wp.set_module_options({"enable_backward": False, "max_unroll": 0})

_Cube = wp.types.vector(length=27, dtype=float)
_MIDDLE = 13


@dataclass(frozen=True)
class Prediction:
    """Predictions of vectors from their neighbours, shape (vector, 3); NaN where there are none."""

    median: np.ndarray
    """Median of the neighbours."""
    scatter: np.ndarray
    """Median distance of the neighbours from `median`."""
    level: np.ndarray
    """Median of the neighbours after each was moved to the middle along the local gradient."""
    level_scatter: np.ndarray
    """Median distance of the moved neighbours from `level`."""
    lowest: np.ndarray
    """Least of the neighbours."""
    highest: np.ndarray
    """Greatest of the neighbours."""
    count: np.ndarray
    """Number of neighbours, shape (vector,)."""


@wp.func
def _median(values: _Cube, count: int):
    """Median of the first `count` values, which are sorted by insertion."""
    for i in range(1, count):
        value = values[i]
        j = i - 1
        while j >= 0 and values[j] > value:
            values[j + 1] = values[j]
            j -= 1
        values[j + 1] = value
    return 0.5 * (values[(count - 1) // 2] + values[count // 2])


@wp.func
def _slope(cube: _Cube, present: int, stride: int):
    """Median difference of adjacent neighbours along the axis whose elements are `stride` apart; 0 without any."""
    differences = _Cube()
    count = wp.int32(0)
    for i in range(27 - stride):
        if (i // stride) % 3 < 2 and (present >> i) & (present >> (i + stride)) & 1 == 1:
            differences[count] = cube[i + stride] - cube[i]
            count += 1
    if count == 0:
        return wp.float32(0.0)
    return _median(differences, count)


@wp.func
def _median_and_scatter(values: _Cube, count: int):
    """Median of the first `count` values and the median of their distances from it."""
    median = _median(values, count)
    distances = _Cube()
    for i in range(count):
        distances[i] = wp.abs(values[i] - median)
    return wp.vec2(median, _median(distances, count))


@wp.kernel
def _predict(
    # in
    field: wp.array4d(dtype=float),  # (z, y, x, component)
    keep: wp.array3d(dtype=int),  # 1 where a vector counts as neighbour
    points: wp.array(dtype=int),  # linear index of the vectors wanted
    first_point: int,
    # out
    prediction_out: wp.array3d(dtype=float),  # (vector, component, 6): as in `Prediction`
    count_out: wp.array(dtype=int),  # neighbours, (vector,)
):
    index, component = wp.tid()
    point = first_point + index
    z = points[point] // (keep.shape[1] * keep.shape[2])
    y = points[point] // keep.shape[2] % keep.shape[1]
    x = points[point] % keep.shape[2]
    cube = _Cube()
    values = _Cube()
    present = wp.int32(0)
    count = wp.int32(0)
    for i in range(27):
        pz = z + i // 9 - 1
        py = y + (i // 3) % 3 - 1
        px = x + i % 3 - 1
        if i != _MIDDLE and pz >= 0 and py >= 0 and px >= 0:
            if pz < keep.shape[0] and py < keep.shape[1] and px < keep.shape[2]:
                if keep[pz, py, px] == 1:
                    cube[i] = field[pz, py, px, component]
                    values[count] = cube[i]
                    present = present | (1 << i)
                    count += 1
    if component == 0:
        count_out[point] = count
    if count == 0:
        for k in range(6):
            prediction_out[point, component, k] = wp.nan
    else:
        plain = _median_and_scatter(values, count)
        lowest = values[0]
        highest = values[0]
        slope_z = _slope(cube, present, 9)
        slope_y = _slope(cube, present, 3)
        slope_x = _slope(cube, present, 1)
        n = wp.int32(0)
        for i in range(27):
            if (present >> i) & 1 == 1:
                lowest = wp.min(lowest, cube[i])
                highest = wp.max(highest, cube[i])
                away = slope_z * float(i // 9 - 1) + slope_y * float((i // 3) % 3 - 1) + slope_x * float(i % 3 - 1)
                values[n] = cube[i] - away
                n += 1
        moved = _median_and_scatter(values, count)
        prediction_out[point, component, 0] = plain[0]
        prediction_out[point, component, 1] = plain[1]
        prediction_out[point, component, 2] = moved[0]
        prediction_out[point, component, 3] = moved[1]
        prediction_out[point, component, 4] = lowest
        prediction_out[point, component, 5] = highest


def predict(field: np.ndarray, keep: np.ndarray, wanted: np.ndarray) -> Prediction:
    """Predict vectors of a field from their neighbours, the vectors themselves left out.

    Parameters
    ----------
    field : ndarray, shape (z, y, x, 3)
        Vectors; those that are not kept may be anything.
    keep : ndarray of bool, shape (z, y, x)
        Vectors that count as neighbours.
    wanted : ndarray of bool, shape (z, y, x)
        Vectors to predict.

    Returns
    -------
    Prediction
        Of the wanted vectors, in C order.

    Raises
    ------
    ValueError
        If the shapes do not match.
    """
    if field.ndim != 4 or field.shape[3] != 3:
        raise ValueError(f"field: expected shape (z, y, x, 3), got {field.shape}.")
    for name, flags in (("keep", keep), ("wanted", wanted)):
        if flags.shape != field.shape[:3]:
            raise ValueError(f"{name}: expected the shape of the field's grid, {field.shape[:3]}, got {flags.shape}.")
    where = runtime.device()
    wp.load_module(__name__, device=where.warp)  # before threads start: compilation is not thread-safe
    points = np.flatnonzero(wanted).astype(np.int32)
    arrays = ((field, np.float32, float), (keep, np.int32, int), (points, np.int32, int))
    inputs = [wp.array(np.ascontiguousarray(a, kind), dtype=t, device=where.warp) for a, kind, t in arrays]
    prediction = wp.empty((len(points), 3, 6), dtype=float, device=where.warp)
    count = wp.empty(len(points), dtype=int, device=where.warp)

    def part(chunk: int, begin: int, end: int) -> None:
        wp.launch(
            _predict,
            dim=(end - begin, 3),
            inputs=[*inputs, begin],
            outputs=[prediction, count],
            device=where.warp,
        )

    runtime.run_chunks(len(points), part)
    return Prediction(*np.moveaxis(prediction.numpy(), -1, 0), count.numpy())
