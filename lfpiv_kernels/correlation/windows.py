"""Warp kernels for the statistics of windows at every lag; `correlation_sides` launches them.

Lanes, offsets and volumes split by phase are those of `correlation_kernels`.
"""

import warp as wp

from lfpiv_kernels.correlation.blocks import VECTORS

wp.set_module_options(
    {
        "enable_backward": False,
        "max_unroll": 0,
        "cpu_compiler_flags": wp.config.cpu_compiler_flags + " -ffp-contract=fast",  # fused multiply-add
    }
)

_PLANE = (
    VECTORS
    + """
    // sums over the window's x, then over its y, each as a sum of sums of `part` values
    const int nx = shape[2], ny = shape[1], padded = nx + 2 * margin[2], pad_y = margin[1];
    const int sums_x = padded - window[2] + 1, rows = ny + 2 * pad_y - window[1] + 1;
    const int pitch = (padded + 31) / 16 * 16, depth = part[0];
    float* memory = scratch_out.data + (int64_t)slot * scratch_pitch;
    float* line = memory;
    float* square = line + pitch;
    float* some = square + pitch;
    float* along_x = some + 2 * pitch;  // (y, sum or sum of squares, x)
    float* along_y = along_x + (int64_t)2 * ny * pitch;
    auto add = [&](float* to, const float* from, int64_t step, int terms, int size) {
        for (int x = 0; x < size; x += width) {
            V total = load(from + x);
            for (int k = 1; k < terms; ++k) total += load(from + k * step + x);
            store(to + x, total);
        }
    };
    for (int x = 0; x < 4 * pitch; ++x) memory[x] = 0.0f;
    for (int y = 0; y < ny; ++y) {
        const float* row = volume.data + ((int64_t)z * ny + y) * nx;
        for (int x = 0; x < nx; ++x) {
            line[margin[2] + x] = row[x];
            square[margin[2] + x] = row[x] * row[x];
        }
        for (int k = 0; k < 2; ++k) {
            add(some, line + k * pitch, 1, part[1], padded - part[1] + 1);
            add(along_x + (2 * y + k) * (int64_t)pitch, some, part[1], window[2] / part[1], sums_x);
        }
    }
    for (int y = 0; y <= ny + 2 * pad_y - depth; ++y) {  // rows beside the volume are 0
        const int low = y > pad_y ? y - pad_y : 0, high = y - pad_y + depth < ny ? y - pad_y + depth : ny;
        float* to = along_y + (int64_t)2 * y * pitch;
        if (low < high) add(to, along_x + (int64_t)2 * low * pitch, 2 * pitch, high - low, 2 * pitch);
        else for (int x = 0; x < 2 * pitch; ++x) to[x] = 0.0f;
    }
    for (int y = 0; y < rows; ++y) {
        if (y < corner || (y - corner) % stride >= phases) continue;  // no window starts there
        for (int k = 0; k < 2; ++k) {
            float* out = (k ? square_out.data : sum_out.data) + ((int64_t)z * rows + y) * sums_x;
            const float* from = along_y + (int64_t)(2 * y + k) * pitch;
            add(some, from, (int64_t)depth * 2 * pitch, window[1] / depth, sums_x);
            for (int x = 0; x < sums_x; ++x) out[x] = some[x];
        }
    }
"""
)


@wp.func_native(_PLANE)
def _sum_plane(
    volume: wp.array(dtype=float),
    shape: wp.vec3i,
    margin: wp.vec3i,
    window: wp.vec3i,
    part: wp.vec2i,
    corner: int,
    stride: int,
    phases: int,
    z: int,
    slot: int,
    scratch_pitch: wp.int64,
    scratch_out: wp.array(dtype=float),
    sum_out: wp.array(dtype=float),
    square_out: wp.array(dtype=float),
): ...


@wp.kernel
def _sum_planes(
    # in
    volume: wp.array(dtype=float),  # flat, (z, y, x)
    shape: wp.vec3i,
    margin: wp.vec3i,  # zeros around the volume along y and x that windows may cover
    window: wp.vec3i,
    part: wp.vec2i,  # factors of the window's edges along y and x
    corner: int,  # rows that windows start from: this one, each `stride` behind it, and as many after each as `phases`
    stride: int,
    phases: int,
    slot: int,  # scratch memory to use; -1: that of the plane
    scratch_pitch: wp.int64,
    begin: int,
    # out
    scratch_out: wp.array(dtype=float),
    sum_out: wp.array(dtype=float),  # sums over the windows' y and x, (z, y, x) with as many y and x as windows fit
    square_out: wp.array(dtype=float),  # the same of the squares
):
    z = begin + wp.tid()
    memory = slot
    if slot < 0:
        memory = z
    _sum_plane(
        volume,
        shape,
        margin,
        window,
        part,
        corner,
        stride,
        phases,
        z,
        memory,
        scratch_pitch,
        scratch_out,
        sum_out,
        square_out,
    )


_STATISTICS = """
    const int width = shape[2];
    const int64_t next = (int64_t)shape[1] * width;
    const double share = 1.0 / count;
    enum { most = 256 };
    double total[most], square[most];
    float mean[most], scale[most];
    for (int begin = 0; begin < width; begin += most) {
        const int some = width - begin < most ? width - begin : most;
        for (int x = 0; x < some; ++x) total[x] = square[x] = 0.0;
        const float* sums = sum.data + (int64_t)y * width + begin;
        const float* sums_of_squares = squares.data + (int64_t)y * width + begin;
        auto at = [&](int plane) { return plane >= 0 && plane < shape[0]; };
        for (int plane = 1 - depth; plane < planes; ++plane) {  // one plane is added and one taken away, which in
            const int ahead = z + plane + depth - 1, behind = z + plane - 1;  // double precision leaves nothing behind
            const float *a = sums + ahead * next, *b = sums + behind * next;
            const float *a2 = sums_of_squares + ahead * next, *b2 = sums_of_squares + behind * next;
            if (at(ahead) && at(behind) && plane > 0) {
                for (int x = 0; x < some; ++x) total[x] += (double)a[x] - (double)b[x];
                for (int x = 0; x < some; ++x) square[x] += (double)a2[x] - (double)b2[x];
            } else if (at(ahead)) {
                for (int x = 0; x < some; ++x) total[x] += a[x];
                for (int x = 0; x < some; ++x) square[x] += a2[x];
            } else if (at(behind) && plane > 0) {
                for (int x = 0; x < some; ++x) total[x] -= b[x];
                for (int x = 0; x < some; ++x) square[x] -= b2[x];
            }
            if (plane < 0 || plane % stride_z >= phases_z) continue;
            for (int x = 0; x < some; ++x) {
                const double m = total[x] * share;
                const float deviation = (float)(square[x] - total[x] * m);
                mean[x] = (float)m;
                scale[x] = deviation > floor ? 1.0f / sqrtf(deviation > floor ? deviation : floor) : 0.0f;
            }
            const int64_t plane_at = out + (int64_t)plane * plane_pitch;
            for (int r = 0; r < phases; ++r) {
                int x = corner + r - begin;  // first of this phase in this part of the row
                int kx = 0;
                if (x < 0) { kx = (-x + stride - 1) / stride; x += kx * stride; }
                const int end = x < some ? kx + (some - x + stride - 1) / stride : kx, last = end < pitch ? end : pitch;
                float* means = mean_out.data + plane_at + (int64_t)r * out_pitch;
                float* scales = scale_out.data + plane_at + (int64_t)r * out_pitch;
                const float *m = mean + x, *s = scale + x;
                for (int k = kx; k < last; ++k, m += stride) means[k] = *m;
                for (int k = kx; k < last; ++k, s += stride) scales[k] = *s;
            }
        }
    }
"""


@wp.func_native(_STATISTICS)
def _row_statistics(
    sum: wp.array(dtype=float),
    squares: wp.array(dtype=float),
    shape: wp.vec3i,
    depth: int,
    count: int,
    floor: float,
    z: int,
    planes: int,
    stride_z: int,
    phases_z: int,
    y: int,
    corner: int,
    stride: int,
    phases: int,
    pitch: int,
    out: wp.int64,
    out_pitch: int,
    plane_pitch: wp.int64,
    mean_out: wp.array(dtype=float),
    scale_out: wp.array(dtype=float),
): ...


@wp.kernel
def _window_statistics(
    # in
    sum: wp.array(dtype=float),  # of `_sum_planes`
    squares: wp.array(dtype=float),
    shape: wp.vec3i,  # of `sum`
    margin: int,  # zeros before and behind the volume along z that windows may cover
    window: wp.vec3i,
    floor: float,  # window sum of squared deviations that is no signal
    corner: wp.vec3i,  # the lattice: window of plane 0, phase (0, 0), lane 0, counted from the first one that fits
    stride: wp.vec3i,
    phases: wp.vec3i,
    planes: int,
    pitch: int,
    lanes: int,
    begin: int,
    # out
    mean_out: wp.array(dtype=float),  # window means, split by phase
    scale_out: wp.array(dtype=float),  # 1 / sqrt(window sum of squared deviations), 0 where there is no signal
):
    y = begin + wp.tid()
    row = y - corner[1]
    if row >= 0 and row % stride[1] < phases[1] and (row // stride[1] + 1) * pitch <= lanes:
        _row_statistics(
            sum,
            squares,
            shape,
            window[0],
            window[0] * window[1] * window[2],
            floor,
            corner[0] - margin,
            planes,
            stride[0],
            phases[0],
            y,
            corner[2],
            stride[2],
            phases[2],
            pitch,
            wp.int64(row % stride[1] * phases[2]) * wp.int64(lanes) + wp.int64(row // stride[1] * pitch),
            lanes,
            wp.int64(phases[1] * phases[2]) * wp.int64(lanes),
            mean_out,
            scale_out,
        )
