// Correlation coefficients of windows and their highest peaks; see ``correlation/peaks.py`` for the structures.
#ifndef LFPIV_PEAKS_H
#define LFPIV_PEAKS_H

#include "simd.h"

namespace lfpiv {

/// A task: windows of some lanes of a layer.
struct WindowTask {
    int layer;  // first layer of blocks
    int lane, lanes;
};

/// Return the place of a lane's statistics at a lag, counted from the farthest lag.
template <class Statistics>
LFPIV_INLINE int64_t place_of(const Statistics& of, int plane, int z, int y, int x, int lane) {
    return (int64_t)(plane + z) * of.plane + of.along_y.data[y] + of.along_x.data[x] + lane;
}

/// Return the sum of the blocks of a column of each window: all along z and y, one along x.
template <class Windows>
LFPIV_INLINE V sum_column(const float* from, const Windows& windows, int layer, int64_t layer_pitch) {
    V total = V{};
    for (int z = 0, at = layer % windows.ring; z < windows.blocks[0]; ++z, from += layer_pitch) {
        for (int y = 0; y < windows.blocks[1]; ++y) total += load(from + y * windows.pitch);
        if (++at == windows.ring) {
            at = 0;
            from -= windows.ring * layer_pitch;
        }
    }
    return total;
}

/// Prefetch the sums of a later lag: they lie farther away than processors predict.
template <class Windows>
LFPIV_INLINE void fetch_blocks(const float* from, const Windows& windows, const WindowTask& task, int64_t layer_pitch) {
    const int count = task.lanes + (windows.blocks[1] - 1) * windows.pitch + windows.blocks[2] - 1;
    for (int z = 0, at = task.layer % windows.ring; z < windows.blocks[0]; ++z, from += layer_pitch) {
        for (int k = 0; k < count; k += 16) prefetch(from + k);
        if (++at == windows.ring) {
            at = 0;
            from -= windows.ring * layer_pitch;
        }
    }
}

/// Lags between the sums that are read and those that are fetched.
constexpr int LAGS_AHEAD = 8;

/// Add up the blocks of each window at one lag, and call `use(lane, sums of products)` for each vector of windows.
template <class Windows, class Use>
LFPIV_INLINE void sum_blocks(const float* sums, const Windows& windows, const WindowTask& task, int lag, int lags,
                             [[maybe_unused]] float* columns, const Use& use) {
    const int64_t layer_pitch = (int64_t)lags * windows.lanes;
    const float* from = sums + task.layer % windows.ring * layer_pitch + (int64_t)lag * windows.lanes + task.lane;
#if LFPIV_GPU
    V total = V{};
    for (int x = 0; x < windows.blocks[2]; ++x) total += sum_column(from + x, windows, task.layer, layer_pitch);
    use(0, total);
#else
    fetch_blocks(from + LAGS_AHEAD * (int64_t)windows.lanes, windows, task, layer_pitch);
    for (int k = 0; k < task.lanes + windows.blocks[2] - 1; k += WIDTH)
        store(columns + k, sum_column(from + k, windows, task.layer, layer_pitch));
    for (int k = 0; k < task.lanes; k += WIDTH) {
        V total = load(columns + k);
        for (int x = 1; x < windows.blocks[2]; ++x) total += load(columns + k + x);
        use(k, total);
    }
#endif
}

/// Coefficients of a task's windows, (lag, lane), and the highest one of every row of lags along x.
struct Scores {
    float *score, *highest;
    int pitch;
    int nz, ny, nx;  // lags

    LFPIV_INLINE const float* at(int lag) const { return score + (int64_t)lag * pitch; }
};

/// Form the coefficients of a task's windows at one lag from the sums of products of their blocks, in one direction or
/// in both. Only the CPU needs memory for sums of columns.
template <class Sums, class Statistics, class Windows>
LFPIV_INLINE void score_lag(const Sums& sums, const Statistics& first, const Statistics& second, const Windows& windows,
                            const WindowTask& task, int z, int y, int x, float* columns, float* to) {
    const int nz = windows.lags[0], ny = windows.lags[1], nx = windows.lags[2];
    const int lags = nz * ny * nx, lag = (z * ny + y) * nx + x, plane = task.layer * windows.stride;
    const float voxels = (float)windows.voxels;
    const int64_t first_at = place_of(first, plane, first.centre[0], first.centre[1], first.centre[2], task.lane);
    const int64_t around = place_of(second, plane, z, y, x, task.lane);
    sum_blocks(sums.ahead.data, windows, task, lag, lags, columns, [&](int k, V total) {
        const V expected = voxels * load(first.mean.data + first_at + k) * load(second.mean.data + around + k);
        const V scale = load(first.scale.data + first_at + k) * load(second.scale.data + around + k);
        store(to + k, (total - expected) * scale);
    });
    if (!sums.symmetric) return;
    const int64_t second_at = place_of(second, plane, nz / 2, ny / 2, nx / 2, task.lane);
    const int64_t back = place_of(first, plane, nz - 1 - z, ny - 1 - y, nx - 1 - x, task.lane);
    sum_blocks(sums.behind.data, windows, task, lags - 1 - lag, lags, columns, [&](int k, V total) {
        const V expected = voxels * load(second.mean.data + second_at + k) * load(first.mean.data + back + k);
        const V scale = load(second.scale.data + second_at + k) * load(first.scale.data + back + k);
        store(to + k, 0.5f * (load(to + k) + (total - expected) * scale));
    });
}

/// Highest coefficient, the highest one beyond the reach of its peak, and the second peak, of a vector of windows.
struct Peaks {
    V best = V{}, rival = V{}, second = V{};
    M best_lag = M{}, rival_lag = M{}, second_lag = M{};
    M best_z = M{}, best_y = M{}, best_x = M{};
};

/// Return the highest coefficient of windows `k` and on.
LFPIV_INLINE Peaks find_best(const Scores& scores, int k) {
    Peaks peaks;
    const float* p = scores.score + k;
    for (int lag = 0; lag < scores.nz * scores.ny * scores.nx; ++lag, p += scores.pitch) {
        const V value = load(p);
        const M higher = value > peaks.best;
        peaks.best = higher ? value : peaks.best;
        peaks.best_lag = higher ? M{} + lag : peaks.best_lag;
    }
    peaks.best_z = peaks.best_lag / (scores.ny * scores.nx);
    peaks.best_y = peaks.best_lag / scores.nx % scores.ny;
    peaks.best_x = peaks.best_lag % scores.nx;
    return peaks;
}

/// Find the highest coefficient more than `reach` lags away from the highest, and the highest one of every row of lags.
LFPIV_INLINE void find_rival(const Scores& scores, int k, int reach, Peaks& peaks) {
    float* high = scores.highest + k;
    const float* p = scores.score + k;
    for (int z = 0; z < scores.nz; ++z)
        for (int y = 0; y < scores.ny; ++y, high += scores.pitch) {
            const M dz = z - peaks.best_z, dy = y - peaks.best_y;
            const M apart = (dz > reach) | (dz < -reach) | (dy > reach) | (dy < -reach);
            V row = V{};
            M lag = M{} + (z * scores.ny + y) * scores.nx, dx = -peaks.best_x;
            for (int x = 0; x < scores.nx; ++x, p += scores.pitch, lag += 1, dx += 1) {
                const V value = load(p);
                const M higher = (apart | (dx > reach) | (dx < -reach)) & (value > peaks.rival);
                row = value > row ? value : row;
                peaks.rival = higher ? value : peaks.rival;
                peaks.rival_lag = higher ? lag : peaks.rival_lag;
            }
            store(high, row);
        }
}

/// Take a lag as second peak in the windows `among` where it is a peak, higher than those so far, and at least `reach`
/// lags away from the highest one.
LFPIV_INLINE void consider(const Scores& scores, int k, int reach, int z, int y, int x, M among, Peaks& peaks) {
    const int nz = scores.nz, ny = scores.ny, nx = scores.nx, lag = (z * ny + y) * nx + x;
    if (z == 0 || y == 0 || x == 0 || z == nz - 1 || y == ny - 1 || x == nx - 1) return;
    const int64_t pitch_x = scores.pitch, pitch_y = nx * pitch_x, pitch_z = ny * pitch_y;
    const float* p = scores.at(lag) + k;
    const V value = load(p);
    M peak = among & (value > peaks.second);
    if (!any(peak)) return;
    const M dz = z - peaks.best_z, dy = y - peaks.best_y, dx = x - peaks.best_x;
    const int near = reach - 1;
    peak = peak & ((dz > near) | (dz < -near) | (dy > near) | (dy < -near) | (dx > near) | (dx < -near));
    if (!any(peak)) return;
    peak = peak & (value >= load(p - pitch_z)) & (value >= load(p + pitch_z)) & (value >= load(p - pitch_y));
    peak = peak & (value >= load(p + pitch_y)) & (value >= load(p - pitch_x)) & (value >= load(p + pitch_x));
    peaks.second = peak ? value : peaks.second;
    peaks.second_lag = peak ? M{} + lag : peaks.second_lag;
}

/// Find the second peak. Often it is the rival, and no lag with a lower coefficient is read then.
LFPIV_INLINE void find_second(const Scores& scores, int k, int reach, Peaks& peaks) {
    const int ny = scores.ny, nx = scores.nx;
    for (int j = 0; j < WIDTH; ++j) {
        const int lag = lane(peaks.rival_lag, j);
        if (j > 0 && lag == lane(peaks.rival_lag, j - 1)) continue;
        consider(scores, k, reach, lag / (ny * nx), lag / nx % ny, lag % nx, peaks.rival_lag == lag, peaks);
    }
    const float* high = scores.highest + k;
    for (int z = 1; z < scores.nz - 1; ++z)
        for (int y = 1; y < ny - 1; ++y) {
            if (!any(load(high + (int64_t)(z * ny + y) * scores.pitch) > peaks.second)) continue;
            for (int x = 1; x < nx - 1; ++x) consider(scores, k, reach, z, y, x, ~M{}, peaks);
        }
}

/// Return the maximum's offset by a Gaussian fit through three points; by a parabola if a neighbour is not positive.
LFPIV_INLINE float refine(const float* p, int64_t pitch) {
    float a = p[-pitch], b = p[0], c = p[pitch];
    if (a > 0.0f && c > 0.0f) {
        a = logf(a);
        b = logf(b);
        c = logf(c);
    }
    const float curvature = a - 2.0f * b + c;
    return curvature >= 0.0f ? 0.0f : 0.5f * (a - c) / curvature;
}

/// Return the displacement of the peak at a lag along z, y or x. Its coefficient is `p`, those of the next lags follow
/// after `pitch` elements each.
template <class Triple>
LFPIV_INLINE float displacement_along(int axis, const Triple& lags, const float* p, int lag, int64_t pitch) {
    const int apart = axis == 0 ? lags[1] * lags[2] : axis == 1 ? lags[2] : 1;
    const int count = axis == 0 ? lags[0] : axis == 1 ? lags[1] : lags[2];
    return lag / apart % count - count / 2 + refine(p, apart * pitch);
}

/// Write the displacement at a lag along z, y and x, not-a-number if there is none.
LFPIV_INLINE void write_displacement(const Scores& scores, int k, int lag, bool found, int64_t pitch, float* out) {
    const int lags[3] = {scores.nz, scores.ny, scores.nx};
    const float* p = scores.at(lag) + k;
    for (int axis = 0; axis < 3; ++axis)
        out[axis * pitch] = found ? displacement_along(axis, lags, p, lag, scores.pitch) : NAN;
}

/// Write both displacements, the highest coefficient and its rival of a vector of windows.
LFPIV_INLINE void write_peaks(const Scores& scores, int k, const Peaks& peaks, int64_t pitch, float* out) {
    for (int j = 0; j < WIDTH; ++j, ++out) {
        const int z = lane(peaks.best_z, j), y = lane(peaks.best_y, j), x = lane(peaks.best_x, j);
        const bool inside = z > 0 && y > 0 && x > 0 && z < scores.nz - 1 && y < scores.ny - 1 && x < scores.nx - 1;
        write_displacement(scores, k + j, lane(peaks.best_lag, j), inside, pitch, out);
        const bool exists = lane(peaks.second, j) > 0.0f;
        write_displacement(scores, k + j, lane(peaks.second_lag, j), exists, pitch, out + 3 * pitch);
        out[6 * pitch] = lane(peaks.best, j);
        out[7 * pitch] = lane(peaks.rival, j);
    }
}

/// Return where the coefficients of a task's windows lie.
template <class Windows>
LFPIV_INLINE Scores scores_of(const Windows& windows, float* score) {
    const int nz = windows.lags[0], ny = windows.lags[1], nx = windows.lags[2];
    return {score, score + (int64_t)nz * ny * nx * windows.score_pitch, windows.score_pitch, nz, ny, nx};
}

/// Return the windows of a task, numbered (layer, group of lanes).
template <class Windows>
LFPIV_INLINE WindowTask windows_of(const Windows& windows, int task) {
    const int layer = windows.begin + task / windows.groups, lane = task % windows.groups * windows.group;
    return {layer * windows.block_step, lane, min(windows.group, windows.lanes - lane)};
}

/// Find the peaks of a group of windows. Tasks are numbered (layer, group of lanes).
template <class Sums, class Statistics, class Windows>
LFPIV_INLINE void find_peaks(const Sums& sums, const Statistics& first, const Statistics& second,
                             const Windows& windows, int slot, int task, float* scratch, float* out) {
    const WindowTask where = windows_of(windows, task);
    const Scores scores = scores_of(windows, scratch + slot * windows.slot_pitch);
    float *to = scores.score, *columns = scores.highest + (int64_t)scores.nz * scores.ny * scores.pitch;
    for (int z = 0; z < scores.nz; ++z)
        for (int y = 0; y < scores.ny; ++y)
            for (int x = 0; x < scores.nx; ++x, to += scores.pitch)
                score_lag(sums, first, second, windows, where, z, y, x, columns, to);
    float* peak = out + (int64_t)(windows.begin + task / windows.groups) * windows.lanes + where.lane;
    for (int k = 0; k < where.lanes; k += WIDTH) {
        Peaks peaks = find_best(scores, k);
        find_rival(scores, k, windows.reach, peaks);
        find_second(scores, k, windows.reach, peaks);
        write_peaks(scores, k, peaks, windows.peak_pitch, peak + k);
    }
}

}  // namespace lfpiv

#endif
