"""What the 26 neighbours of a vector say about it: robust predictions for outlier detection and filling."""

from dataclasses import dataclass

import numpy as np
import warp as wp

from lfpiv_kernels import runtime

wp.set_module_options({"enable_backward": False, "max_unroll": 0})

LANES = 16
"""Vectors a CPU thread predicts at once; a CUDA thread takes one."""


def _sort(size: int) -> str:
    """Statements that sort `size` values in place: Batcher's odd-even merge network, the same steps for any values."""
    steps, merged = [], 1
    while merged < size:
        distance = merged
        while distance:
            for start in range(distance % merged, size - distance, 2 * distance):
                for low in range(start, min(start + distance, size - distance)):
                    if low // (2 * merged) == (low + distance) // (2 * merged):
                        steps.append(f"order(v[{low}], v[{low + distance}]);")
            distance //= 2
        merged *= 2
    return " ".join(steps)


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


_PREDICT = """
#if defined(__CUDA_ARCH__)
    typedef float V;
    typedef int M;
    const int lanes = 1;
    auto put = [](auto& v, int k, auto value) { v = value; };
    auto get = [](auto v, int k) { return v; };
#else
    typedef float V __attribute__((vector_size(64)));
    typedef int M __attribute__((vector_size(64)));
    const int lanes = 16;
    auto put = [](auto& v, int k, auto value) { v[k] = value; };
    auto get = [](auto v, int k) { return v[k]; };
#endif
    const int nz = shape[0], ny = shape[1], nx = shape[2], some = count < lanes ? count : lanes;
    const V none = V{} + INFINITY;  // stands for a missing value, behind all others
    auto order = [](V& a, V& b) { const V low = a < b ? a : b; b = a < b ? b : a; a = low; };
    auto sort26 = [&](V* v) { SORT26 };
    auto sort18 = [&](V* v) { SORT18 };
    auto middle = [](const V* v, int most, M number) {  // median of the first `number` of sorted values
        V low = v[0], high = v[0];
        for (int i = 1; i <= most / 2; ++i) {
            low = (number - 1) / 2 == i ? v[i] : low;
            high = number / 2 == i ? v[i] : high;
        }
        return 0.5f * (low + high);
    };
    V cube[27];
    M present[27], number = M{};
    int64_t at[lanes][27];
    for (int i = 0; i < 27; ++i) present[i] = M{};
    for (int k = 0; k < some; ++k) {
        const int point = points.data[first + k], z = point / (ny * nx), y = point / nx % ny, x = point % nx;
        for (int i = 0; i < 27; ++i) {
            const int pz = z + i / 9 - 1, py = y + i / 3 % 3 - 1, px = x + i % 3 - 1;
            const bool inside = pz >= 0 && py >= 0 && px >= 0 && pz < nz && py < ny && px < nx;
            at[k][i] = inside ? ((int64_t)pz * ny + py) * nx + px : 0;
            if (i != 13 && inside && keep.data[at[k][i]]) put(present[i], k, -1);
        }
    }
    for (int i = 0; i < 27; ++i) number = number + (present[i] != 0 ? M{} + 1 : M{});
    for (int component = 0; component < 3; ++component) {
        for (int i = 0; i < 27; ++i) {
            V value = V{};
            for (int k = 0; k < some; ++k) put(value, k, field.data[3 * at[k][i] + component]);
            cube[i] = present[i] != 0 ? value : none;
        }
        V v[26], result[6];
        auto robust = [&](V* out) {  // median of v, and the median distance from it
            sort26(v);
            out[0] = middle(v, 26, number);
            for (int i = 0; i < 26; ++i) {
                const V distance = v[i] - out[0];
                v[i] = distance < 0.0f ? -distance : distance;
            }
            sort26(v);
            out[1] = middle(v, 26, number);
        };
        for (int i = 0; i < 26; ++i) v[i] = cube[i < 13 ? i : i + 1];
        robust(result);
        V slope[3];
        for (int axis = 0; axis < 3; ++axis) {  // median difference of adjacent neighbours, 0 without any
            const int stride = axis == 0 ? 9 : axis == 1 ? 3 : 1;
            M pairs = M{};
            int n = 0;
            for (int i = 0; i < 27 - stride; ++i) {
                if (i / stride % 3 == 2) continue;
                const M both = (present[i] != 0) & (present[i + stride] != 0);
                v[n++] = both != 0 ? cube[i + stride] - cube[i] : none;
                pairs = pairs + (both != 0 ? M{} + 1 : M{});
            }
            sort18(v);
            slope[axis] = pairs > 0 ? middle(v, 18, pairs) : V{};
        }
        result[4] = none;
        result[5] = -none;
        for (int i = 0, n = 0; i < 27; ++i) {
            if (i == 13) continue;
            const V value = cube[i];
            const V away = slope[0] * (float)(i / 9 - 1) + slope[1] * (float)(i / 3 % 3 - 1)
                + slope[2] * (float)(i % 3 - 1);
            result[4] = value < result[4] ? value : result[4];
            result[5] = (present[i] != 0) & (value > result[5]) ? value : result[5];
            v[n++] = present[i] != 0 ? value - away : none;
        }
        robust(result + 2);
        for (int j = 0; j < 6; ++j) for (int k = 0; k < some; ++k)
            prediction_out.data[((int64_t)(first + k) * 3 + component) * 6 + j] = get(result[j], k);
    }
    for (int k = 0; k < some; ++k) {
        const int neighbours = get(number, k);
        count_out.data[first + k] = neighbours;
        if (neighbours == 0)
            for (int j = 0; j < 18; ++j) prediction_out.data[(int64_t)(first + k) * 18 + j] = NAN;
    }
""".replace("SORT26", _sort(26)).replace("SORT18", _sort(18))


@wp.func_native(_PREDICT)
def _predict_group(
    field: wp.array(dtype=float),
    keep: wp.array(dtype=int),
    points: wp.array(dtype=int),
    shape: wp.vec3i,
    first: int,
    count: int,
    prediction_out: wp.array(dtype=float),
    count_out: wp.array(dtype=int),
): ...


@wp.kernel
def _predict(
    # in
    field: wp.array(dtype=float),  # flat, (z, y, x, component)
    keep: wp.array(dtype=int),  # flat, (z, y, x): 1 where a vector counts as neighbour
    points: wp.array(dtype=int),  # linear index of the vectors wanted
    shape: wp.vec3i,  # of the grid
    group: int,  # vectors per thread: `LANES` on the CPU, 1 on CUDA
    first_group: int,
    # out
    prediction_out: wp.array(dtype=float),  # flat, (vector, component, 6): as in `Prediction`
    count_out: wp.array(dtype=int),  # neighbours, (vector,)
):
    first = (first_group + wp.tid()) * group
    _predict_group(field, keep, points, shape, first, points.shape[0] - first, prediction_out, count_out)


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
    inputs = [wp.array(np.ascontiguousarray(a, kind).ravel(), dtype=t, device=where.warp) for a, kind, t in arrays]
    prediction = wp.empty((len(points), 3, 6), dtype=float, device=where.warp)
    count = wp.empty(len(points), dtype=int, device=where.warp)
    group = LANES if where.kind == "cpu" else 1
    layout, outputs = [wp.vec3i(*keep.shape), group], [prediction.flatten(), count]

    def part(chunk: int, begin: int, end: int) -> None:
        wp.launch(_predict, dim=end - begin, inputs=[*inputs, *layout, begin], outputs=outputs, device=where.warp)

    runtime.run_chunks(-(-len(points) // group), part)
    return Prediction(*np.moveaxis(prediction.numpy(), -1, 0), count.numpy())
