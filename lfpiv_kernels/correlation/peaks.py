"""Warp kernel that finds the peaks of a correlation: `correlate` launches it.

Lanes, offsets and statistics split by phase are those of `correlation_kernels` and `window_kernels`.
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

_PEAKS = (
    VECTORS
    + """
    const int nz = lags[0], ny = lags[1], nx = lags[2], all = nz * ny * nx;
    float* score = scratch_out.data + scratch;
    float* highest = score + (int64_t)all * score_pitch;  // of every row of lags along x
    const int64_t layer_pitch = (int64_t)all * sum_pitch;
    auto summed = [&](const float* sums, int lag, auto use) {  // windows are sums of blocks
        const float* from = sums + (layer % ring) * layer_pitch + (int64_t)lag * sum_pitch + lane;
        auto column = [&](int k) {
            V total = V{};
            const float* p = from + k;
            for (int z = 0, at = layer % ring; z < blocks[0]; ++z, p += layer_pitch) {
                for (int y = 0; y < blocks[1]; ++y) total += load(p + y * pitch);
                if (++at == ring) { at = 0; p -= ring * layer_pitch; }
            }
            return total;
        };
#if defined(__CUDA_ARCH__)
        V total = V{};
        for (int x = 0; x < blocks[2]; ++x) total += column(x);
        use(0, total);
#else
        const float* ahead = from + 8 * (int64_t)sum_pitch;  // lags ahead, which no processor guesses
        for (int z = 0, at = layer % ring; z < blocks[0]; ++z, ahead += layer_pitch) {
            for (int k = 0; k < lanes + (blocks[1] - 1) * pitch + blocks[2] - 1; k += 16) fetch(ahead + k);
            if (++at == ring) { at = 0; ahead -= ring * layer_pitch; }
        }
        float* columns = highest + nz * ny * score_pitch;
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
        M best_lag = M{}, rival_lag = M{}, second_lag = M{};
        const float* p = score + k;
        for (int lag = 0; lag < all; ++lag, p += score_pitch) {
            const V v = load(p);
            const M m = v > best;
            best = m ? v : best;
            best_lag = m ? M{} + lag : best_lag;
        }
        const M best_z = best_lag / (ny * nx), best_y = best_lag / nx % ny, best_x = best_lag % nx;
        float* high = highest + k;
        p = score + k;
        for (int z = 0; z < nz; ++z) for (int y = 0; y < ny; ++y, high += score_pitch) {
            const M dz = z - best_z, dy = y - best_y;
            const M beside = (dz > 2) | (dz < -2) | (dy > 2) | (dy < -2);
            V row = V{};
            M lag = M{} + (z * ny + y) * nx, dx = -best_x;
            for (int x = 0; x < nx; ++x, p += score_pitch, lag += 1, dx += 1) {
                const V v = load(p);
                const M m = (beside | (dx > 2) | (dx < -2)) & (v > rival);
                row = v > row ? v : row;
                rival = m ? v : rival;
                rival_lag = m ? lag : rival_lag;
            }
            store(high, row);
        }
        auto consider = [&](int z, int y, int x, M among) {  // a peak beside the highest one, higher than those so far
            if (z == 0 || y == 0 || x == 0 || z == nz - 1 || y == ny - 1 || x == nx - 1) return;
            const int lag = (z * ny + y) * nx + x;
            const float* p = score + (int64_t)lag * score_pitch + k;
            const V v = load(p);
            M peak = among & (v > second);
            if (!any(peak)) return;
            const M dz = z - best_z, dy = y - best_y, dx = x - best_x;
            peak = peak & ((dz > 1) | (dz < -1) | (dy > 1) | (dy < -1) | (dx > 1) | (dx < -1));
            if (!any(peak)) return;
            peak = peak & (v >= load(p - pitch_z)) & (v >= load(p + pitch_z)) & (v >= load(p - pitch_y));
            peak = peak & (v >= load(p + pitch_y)) & (v >= load(p - pitch_x)) & (v >= load(p + pitch_x));
            second = peak ? v : second;
            second_lag = peak ? M{} + lag : second_lag;
        };
        for (int j = 0; j < width; ++j) {  // often the rival is that peak: whatever is lower need not be looked at
            const int lag = at(rival_lag, j);
            if (j > 0 && lag == at(rival_lag, j - 1)) continue;
            consider(lag / (ny * nx), lag / nx % ny, lag % nx, rival_lag == lag);
        }
        high = highest + k;
        for (int z = 1; z < nz - 1; ++z) for (int y = 1; y < ny - 1; ++y) {
            if (!any(load(high + (z * ny + y) * score_pitch) > second)) continue;
            for (int x = 1; x < nx - 1; ++x) consider(z, y, x, ~M{});
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
