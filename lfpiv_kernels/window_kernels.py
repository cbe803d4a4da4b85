"""Warp kernels for what a correlation needs of whole windows: their statistics, their peaks; `correlate` launches them.

Lanes, offsets and volumes split by phase are those of `correlation_kernels`.
"""

import warp as wp

from .correlation_kernels import VECTORS

wp.set_module_options(
    {
        "enable_backward": False,
        "max_unroll": 0,
        "cpu_compiler_flags": wp.config.cpu_compiler_flags + " -ffp-contract=fast",  # fused multiply-add
    }
)

_PLANE = """
    // sums over the window's x, then over its y, each as a sum of sums of `part` values
    const int nx = shape[2], ny = shape[1], padded = nx + 2 * margin[2];
    const int width = padded - window[2] + 1, rows = ny + 2 * margin[1] - window[1] + 1;
    float* memory = scratch_out.data + (int64_t)slot * scratch_pitch;
    auto add = [](float* __restrict to, const float* from, int64_t step, int terms, int size) {
        for (int x = 0; x < size; ++x) to[x] = from[x];
        int k = 1;
        for (; k + 2 < terms; k += 3) {
            const float *a = from + k * step, *b = a + step, *c = b + step;
            for (int x = 0; x < size; ++x) to[x] += (a[x] + b[x]) + c[x];
        }
        for (; k < terms; ++k) for (int x = 0; x < size; ++x) to[x] += from[k * step + x];
    };
    float* line = memory;
    float* square = line + padded;
    float* part_sum = square + padded;
    float* sums[2] = {part_sum + padded, part_sum + padded + (int64_t)ny * width};
    float* part_sums = sums[1] + (int64_t)ny * width;
    for (int x = 0; x < padded; ++x) line[x] = square[x] = 0.0f;
    for (int y = 0; y < ny; ++y) {
        const float* row = volume.data + ((int64_t)z * ny + y) * nx;
        for (int x = 0; x < nx; ++x) {
            line[margin[2] + x] = row[x];
            square[margin[2] + x] = row[x] * row[x];
        }
        for (int k = 0; k < 2; ++k) {
            add(part_sum, k ? square : line, 1, part[1], padded - part[1] + 1);
            add(sums[k] + (int64_t)y * width, part_sum, part[1], window[2] / part[1], width);
        }
    }
    const int depth = part[0];
    for (int k = 0; k < 2; ++k) {
        for (int y = 0; y <= ny + 2 * margin[1] - depth; ++y) {  // rows beside the volume are 0
            const int low = y > margin[1] ? y - margin[1] : 0;
            const int high = y - margin[1] + depth < ny ? y - margin[1] + depth : ny;
            float* to = part_sums + (int64_t)y * width;
            if (low < high) add(to, sums[k] + (int64_t)low * width, width, high - low, width);
            else for (int x = 0; x < width; ++x) to[x] = 0.0f;
        }
        float* out = (k ? square_out.data : sum_out.data) + (int64_t)z * rows * width;
        for (int y = 0; y < rows; ++y) {
            const float* from = part_sums + (int64_t)y * width;
            add(out + (int64_t)y * width, from, (int64_t)depth * width, window[1] / depth, width);
        }
    }
"""


@wp.func_native(_PLANE)
def _sum_plane(
    volume: wp.array(dtype=float),
    shape: wp.vec3i,
    margin: wp.vec3i,
    window: wp.vec3i,
    part: wp.vec2i,
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
    _sum_plane(volume, shape, margin, window, part, z, memory, scratch_pitch, scratch_out, sum_out, square_out)


_STATISTICS = """
    const int nz = shape[0], width = shape[2];
    const float voxels = (float)count;
    enum { most = 256 };
    float mean[most], scale[most];
    for (int begin = 0; begin < width; begin += most) {
        const int some = width - begin < most ? width - begin : most;
        float* __restrict total = mean;
        float* __restrict square = scale;
        for (int x = 0; x < some; ++x) total[x] = square[x] = 0.0f;
        const int last = z + depth < nz ? z + depth : nz;
        const int64_t next = (int64_t)shape[1] * width;
        int from = z > 0 ? z : 0;
        for (; from + 3 < last; from += 4) {
            const float* a = sum.data + ((int64_t)from * shape[1] + y) * width + begin;
            const float* b = squares.data + ((int64_t)from * shape[1] + y) * width + begin;
            for (int x = 0; x < some; ++x) total[x] += (a[x] + a[x + next]) + (a[x + 2 * next] + a[x + 3 * next]);
            for (int x = 0; x < some; ++x) square[x] += (b[x] + b[x + next]) + (b[x + 2 * next] + b[x + 3 * next]);
        }
        for (; from < last; ++from) {
            const float* a = sum.data + ((int64_t)from * shape[1] + y) * width + begin;
            const float* b = squares.data + ((int64_t)from * shape[1] + y) * width + begin;
            for (int x = 0; x < some; ++x) total[x] += a[x];
            for (int x = 0; x < some; ++x) square[x] += b[x];
        }
        for (int x = 0; x < some; ++x) {
            const float m = total[x] / voxels;
            const float deviation = square[x] - total[x] * m;
            mean[x] = m;
            scale[x] = deviation > floor ? 1.0f / sqrtf(deviation > floor ? deviation : floor) : 0.0f;
        }
        for (int r = 0; r < phases; ++r) {
            int x = corner + r - begin;  // first of this phase in this part of the row
            int kx = 0;
            if (x < 0) { kx = (-x + stride - 1) / stride; x += kx * stride; }
            for (; kx < pitch && x < some; ++kx, x += stride) {
                mean_out.data[out + (int64_t)r * out_pitch + kx] = mean[x];
                scale_out.data[out + (int64_t)r * out_pitch + kx] = scale[x];
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
    y: int,
    corner: int,
    stride: int,
    phases: int,
    pitch: int,
    out: wp.int64,
    out_pitch: int,
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
        for plane in range(planes):
            if plane % stride[0] < phases[0]:
                out = wp.int64((plane * phases[1] + row % stride[1]) * phases[2]) * wp.int64(lanes)
                _row_statistics(
                    sum,
                    squares,
                    shape,
                    window[0],
                    window[0] * window[1] * window[2],
                    floor,
                    corner[0] + plane - margin,
                    y,
                    corner[2],
                    stride[2],
                    phases[2],
                    pitch,
                    out + wp.int64(row // stride[1] * pitch),
                    lanes,
                    mean_out,
                    scale_out,
                )


_PEAKS = (
    VECTORS
    + """
    const int nz = lags[0], ny = lags[1], nx = lags[2], all = nz * ny * nx;
    float* score = scratch_out.data + scratch;
    auto summed = [&](const float* sums, int lag, auto use) {  // windows are sums of blocks
        const float* from = sums + (int64_t)lag * sum_pitch + lane;
        auto column = [&](int k) {
            V total = V{};
            for (int z = 0; z < blocks[0]; ++z) {
                const float* plane = from + (int64_t)((layer + z) % ring) * all * sum_pitch + k;
                for (int y = 0; y < blocks[1]; ++y) {
                    fetch(plane + y * pitch + 8 * (int64_t)sum_pitch);  // lags ahead, which no processor guesses
                    total += load(plane + y * pitch);
                }
            }
            return total;
        };
#if defined(__CUDA_ARCH__)
        V total = V{};
        for (int x = 0; x < blocks[2]; ++x) total += column(x);
        use(0, total);
#else
        float* columns = score + (int64_t)all * score_pitch;
        for (int k = 0; k < lanes + blocks[2] - 1; k += width) store(columns + k, column(k));
        for (int k = 0; k < lanes; k += width) {
            V total = load(columns + k);
            for (int x = 1; x < blocks[2]; ++x) total += load(columns + k + x);
            use(k, total);
        }
#endif
    };
    const float voxels = (float)count;
    const int64_t first_at = (int64_t)(layer * stride + first_centre[0]) * first_pitch
        + first_y.data[first_centre[1]] + first_x.data[first_centre[2]] + lane;
    const int64_t second_at = (int64_t)(layer * stride + lags[0] / 2) * second_pitch
        + second_y.data[ny / 2] + second_x.data[nx / 2] + lane;
    for (int z = 0; z < nz; ++z) for (int y = 0; y < ny; ++y) for (int x = 0; x < nx; ++x) {
        const int lag = (z * ny + y) * nx + x;
        float* to = score + (int64_t)lag * score_pitch;
        const int64_t beside = (int64_t)(layer * stride + z) * second_pitch
            + second_y.data[y] + second_x.data[x] + lane;
        summed(ahead.data, lag, [&](int k, V total) {
            const V expected = voxels * load(first_mean.data + first_at + k) * load(second_mean.data + beside + k);
            const V scale = load(first_scale.data + first_at + k) * load(second_scale.data + beside + k);
            store(to + k, (total - expected) * scale);
        });
        if (symmetric) {
            const int64_t back = (int64_t)(layer * stride + nz - 1 - z) * first_pitch
                + first_y.data[ny - 1 - y] + first_x.data[nx - 1 - x] + lane;
            summed(behind.data, all - 1 - lag, [&](int k, V total) {
                const V expected = voxels * load(second_mean.data + second_at + k) * load(first_mean.data + back + k);
                const V scale = load(second_scale.data + second_at + k) * load(first_scale.data + back + k);
                store(to + k, 0.5f * (load(to + k) + (total - expected) * scale));
            });
        }
    }
    auto refine = [&](const float* p, int pitch) {  // Gaussian fit; parabola where a neighbour is not positive
        float a = p[-pitch], b = p[0], c = p[pitch];
        if (a > 0.0f && c > 0.0f) { a = logf(a); b = logf(b); c = logf(c); }
        const float curvature = a - 2.0f * b + c;
        return curvature >= 0.0f ? 0.0f : 0.5f * (a - c) / curvature;
    };
    const int pitch_z = ny * nx * score_pitch, pitch_y = nx * score_pitch, pitch_x = score_pitch;
    for (int k = 0; k < lanes; k += width) {
        V best = V{}, rival = V{}, second = V{};
        M best_z = M{}, best_y = M{}, best_x = M{}, second_lag = M{};
        const float* p = score + k;
        for (int z = 0; z < nz; ++z) for (int y = 0; y < ny; ++y) for (int x = 0; x < nx; ++x, p += score_pitch) {
            const V v = load(p);
            const M m = v > best;
            best = m ? v : best;
            best_z = m ? M{} + z : best_z;
            best_y = m ? M{} + y : best_y;
            best_x = m ? M{} + x : best_x;
        }
        p = score + k;
        for (int z = 0; z < nz; ++z) for (int y = 0; y < ny; ++y) for (int x = 0; x < nx; ++x, p += score_pitch) {
            const V v = load(p);
            const V least = rival < second ? rival : second;
            if (!any(v > least)) continue;
            const M dz = z - best_z, dy = y - best_y, dx = x - best_x;
            const M far = (dz > 2) | (dz < -2) | (dy > 2) | (dy < -2) | (dx > 2) | (dx < -2);
            rival = (far & (v > rival)) ? v : rival;
            if (z == 0 || y == 0 || x == 0 || z == nz - 1 || y == ny - 1 || x == nx - 1) continue;
            M peak = (dz > 1) | (dz < -1) | (dy > 1) | (dy < -1) | (dx > 1) | (dx < -1);
            peak = peak & (v > second);
            if (!any(peak)) continue;
            peak = peak & (v >= load(p - pitch_z)) & (v >= load(p + pitch_z)) & (v >= load(p - pitch_y));
            peak = peak & (v >= load(p + pitch_y)) & (v >= load(p - pitch_x)) & (v >= load(p + pitch_x));
            second = peak ? v : second;
            second_lag = peak ? M{} + ((z * ny + y) * nx + x) : second_lag;
        }
        for (int j = 0; j < width; ++j) {
            const int64_t row = (int64_t)out_pitch;
            float* out = peak_out.data + out_lane + k + j;
            const int z = at(best_z, j), y = at(best_y, j), x = at(best_x, j), other = at(second_lag, j);
            const bool inside = z > 0 && y > 0 && x > 0 && z < nz - 1 && y < ny - 1 && x < nx - 1;
            const bool exists = value(second, j) > 0.0f;
            for (int peak = 0; peak < 2; ++peak) {
                const int lag = peak ? other : (z * ny + y) * nx + x;
                const bool found = peak ? exists : inside;
                const float* p = score + (int64_t)lag * score_pitch + k + j;
                out[(3 * peak) * row] = found ? lag / (ny * nx) - nz / 2 + refine(p, pitch_z) : NAN;
                out[(3 * peak + 1) * row] = found ? lag / nx % ny - ny / 2 + refine(p, pitch_y) : NAN;
                out[(3 * peak + 2) * row] = found ? lag % nx - nx / 2 + refine(p, pitch_x) : NAN;
            }
            out[6 * row] = value(best, j);
            out[7 * row] = value(rival, j);
        }
    }
"""
)


@wp.func_native(_PEAKS)
def _measure_windows(
    ahead: wp.array(dtype=float),
    behind: wp.array(dtype=float),
    symmetric: int,
    first_mean: wp.array(dtype=float),
    first_scale: wp.array(dtype=float),
    second_mean: wp.array(dtype=float),
    second_scale: wp.array(dtype=float),
    first_y: wp.array(dtype=int),
    first_x: wp.array(dtype=int),
    second_y: wp.array(dtype=int),
    second_x: wp.array(dtype=int),
    first_pitch: int,
    second_pitch: int,
    first_centre: wp.vec3i,
    stride: int,
    count: int,
    blocks: wp.vec3i,
    lags: wp.vec3i,
    layer: int,
    lane: int,
    lanes: int,
    ring: int,
    pitch: int,
    sum_pitch: int,
    scratch: wp.int64,
    score_pitch: int,
    out_lane: wp.int64,
    out_pitch: wp.int64,
    scratch_out: wp.array(dtype=float),
    peak_out: wp.array(dtype=float),
): ...


@wp.kernel
def _find_peaks(
    # in
    ahead: wp.array(dtype=float),  # sums of products of blocks of the first volume, (layer, lag, lane)
    behind: wp.array(dtype=float),  # of blocks of the second volume, whose lags count backwards
    symmetric: int,  # 1: average both; 0: `behind` is not read
    first_mean: wp.array(dtype=float),  # of `_window_statistics`, at every lag where symmetric, else at lag 0
    first_scale: wp.array(dtype=float),
    second_mean: wp.array(dtype=float),  # at every lag
    second_scale: wp.array(dtype=float),
    first_y: wp.array(dtype=int),  # offsets along y and x, see the head of this module
    first_x: wp.array(dtype=int),
    second_y: wp.array(dtype=int),
    second_x: wp.array(dtype=int),
    pitches: wp.vec2i,  # elements per plane of the statistics of either volume
    first_centre: wp.vec3i,  # lag index of lag 0 in the first's statistics
    stride: int,  # distance of layers of blocks [voxel]
    count: int,  # voxels in a window
    blocks: wp.vec3i,  # blocks per window and axis
    block_step: int,  # layers of blocks from one layer of windows to the next
    lags: wp.vec3i,
    begin_layer: int,  # of windows
    ring: int,  # layers of blocks that the sums hold: layer i lies at i % ring
    groups: int,  # groups of lanes
    group: int,  # lanes of a group: a multiple of `LANES` on the CPU, 1 on CUDA
    pitch: int,  # lanes per row
    sum_pitch: int,  # lanes per lag
    slot: int,
    slot_pitch: wp.int64,
    score_pitch: int,
    out_pitch: wp.int64,
    begin: int,
    # out
    scratch_out: wp.array(dtype=float),
    peak_out: wp.array(dtype=float),  # two displacements (z, y, x), best and rival coefficient; each (layer, lane)
):
    index = begin + wp.tid()
    lane = (index % groups) * group
    layer = begin_layer + index // groups
    lanes = wp.min(group, sum_pitch - lane)
    scratch = wp.int64(slot) * slot_pitch
    if slot < 0:
        scratch = wp.int64(index)
    _measure_windows(
        ahead,
        behind,
        symmetric,
        first_mean,
        first_scale,
        second_mean,
        second_scale,
        first_y,
        first_x,
        second_y,
        second_x,
        pitches[0],
        pitches[1],
        first_centre,
        stride,
        count,
        blocks,
        lags,
        layer * block_step,
        lane,
        lanes,
        ring,
        pitch,
        sum_pitch,
        scratch,
        score_pitch,
        wp.int64(layer) * wp.int64(sum_pitch) + wp.int64(lane),
        out_pitch,
        scratch_out,
        peak_out,
    )


ROW = 8
"""Neighbours along x that box sums add at once."""
Row = wp.types.vector(length=ROW, dtype=float)


@wp.kernel
def _box_sum(
    # in
    source: wp.array(dtype=Row),  # overlapping rows of a flat volume
    pitch: int,  # distance of the terms [element]
    terms: int,
    rows: int,  # rows of `sum_out`
    batch: int,  # rows per thread
    first_batch: int,
    # out
    sum_out: wp.array(dtype=Row),  # every eighth overlapping row: [i] holds floats 8 i .. 8 i + 7
):
    begin = (first_batch + wp.tid()) * batch
    for index in range(begin, wp.min(begin + batch, rows)):
        total = source[8 * index]
        for k in range(1, terms):
            total += source[8 * index + k * pitch]
        sum_out[index] = total
