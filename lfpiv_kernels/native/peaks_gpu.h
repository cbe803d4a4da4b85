// Correlation coefficients of windows on a GPU, and their highest peaks; see ``correlation/peaks_gpu.py``. The
// coefficients of a window lie side by side, (window, lag).
#ifndef LFPIV_PEAKS_GPU_H
#define LFPIV_PEAKS_GPU_H

#include "lanes.h"
#include "peaks.h"

namespace lfpiv {

static_assert(WIDTH == 1, "a lane per window");

/// Lags of a tile, whose coefficients a window writes side by side. And warps of a thread block.
constexpr int LAGS_OF_TILE = 4;
constexpr int SCORE_WARPS = 8;

/// Coefficients of 32 windows at the lags of a tile, (lag, window). Every row is followed by a gap: lanes that read
/// neighbouring lags of neighbouring windows then meet in different banks.
struct ScoreTile {
    static constexpr int PITCH = LANES_OF_WARP + 8, SIZE = LAGS_OF_TILE * PITCH;
    float* scores;

    LFPIV_INLINE float* at(int lag, int window) const {
        LFPIV_EXCHANGED(1);
        return scores + lag * PITCH + window;
    }
};

/// Form the coefficients of 32 of `count` windows at the lags of a tile. Tasks are numbered (tile, group of windows).
/// Neighbouring lanes read the sums of neighbouring windows, then write neighbouring lags.
template <class Sums, class Statistics, class Windows>
LFPIV_INLINE void score_windows(const Sums& sums, const Statistics& first, const Statistics& second,
                                const Windows& windows, int count, int task, float* score) {
#if defined(__CUDA_ARCH__)
    __shared__ float tile_of_warps[SCORE_WARPS][ScoreTile::SIZE];
    const ScoreTile tile{tile_of_warps[threadIdx.x / LANES_OF_WARP % SCORE_WARPS]};
#else
    float tile_of_warp[ScoreTile::SIZE];
    const ScoreTile tile{tile_of_warp};
#endif
    const int groups = (count + LANES_OF_WARP - 1) / LANES_OF_WARP, ny = windows.lags[1], nx = windows.lags[2];
    const int first_lag = task / groups * LAGS_OF_TILE, first_window = task % groups * LANES_OF_WARP;
    const int lags = min(windows.lags[0] * ny * nx - first_lag, LAGS_OF_TILE);
    for_lanes([&](int lane) {
        if (first_window + lane >= count) return;
        const WindowTask window = windows_of(windows, first_window + lane);
        for (int k = 0; k < lags; ++k) {
            const int lag = first_lag + k, z = lag / (ny * nx), y = lag / nx % ny, x = lag % nx;
            score_lag(sums, first, second, windows, window, z, y, x, nullptr, tile.at(k, lane));
        }
    });
    sync_lanes();
    for_lanes([&](int lane) {
        for (int k = lane; k < LANES_OF_WARP * LAGS_OF_TILE; k += LANES_OF_WARP) {
            const int window = k / LAGS_OF_TILE, lag = k % LAGS_OF_TILE;
            if (first_window + window >= count || lag >= lags) continue;
            score[(int64_t)(first_window + window) * windows.score_pitch + first_lag + lag] = *tile.at(lag, window);
        }
    });
}

/// A coefficient of each lane, and its lag.
struct LaneScores {
    PerLane<float> score;
    PerLane<int> lag;

    LFPIV_INLINE LaneScores() {
        for_lanes([&](int lane) { score[lane] = 0.0f, lag[lane] = 0; });
    }

    /// Give all lanes the highest coefficient, at its first lag.
    LFPIV_INLINE void share_highest() {
        for (int away = LANES_OF_WARP / 2; away > 0; away /= 2) {
            LaneScores other;
            for_lanes([&](int lane) {
                other.score[lane] = score.of(lane ^ away);
                other.lag[lane] = lag.of(lane ^ away);
            });
            for_lanes([&](int lane) {
                const bool equal = other.score[lane] == score[lane];
                if (other.score[lane] > score[lane] || (equal && other.lag[lane] < lag[lane]))
                    score[lane] = other.score[lane], lag[lane] = other.lag[lane];
            });
        }
    }
};

/// Return whether a lag has neighbours on both sides along all axes.
template <class Triple>
LFPIV_INLINE bool has_neighbours(const Triple& lags, int lag) {
    const int z = lag / (lags[1] * lags[2]), y = lag / lags[2] % lags[1], x = lag % lags[2];
    return z > 0 && y > 0 && x > 0 && z < lags[0] - 1 && y < lags[1] - 1 && x < lags[2] - 1;
}

/// Return whether a lag has neighbours, and none with a higher coefficient.
template <class Triple>
LFPIV_INLINE bool is_peak(const float* score, const Triple& lags, int lag) {
    if (!has_neighbours(lags, lag)) return false;
    const float* p = score + lag;
    const int nx = lags[2], ny = lags[1];
    return *p >= p[-1] && *p >= p[1] && *p >= p[-nx] && *p >= p[nx] && *p >= p[-ny * nx] && *p >= p[ny * nx];
}

/// Find the peaks of one window, as `find_peaks` of ``peaks.h`` does: each lane looks at every 32nd lag. Often the
/// second peak is the rival, and no lag with a lower coefficient is compared with its neighbours then.
template <class Windows>
LFPIV_INLINE void find_peaks_of_window(const Windows& windows, int task, const float* scores, float* out) {
    const int ny = windows.lags[1], nx = windows.lags[2], lags = windows.lags[0] * ny * nx;
    const float* score = scores + (int64_t)task * windows.score_pitch;
    LaneScores best, rival;
    for_lanes([&](int lane) {
        for (int lag = lane; lag < lags; lag += LANES_OF_WARP)
            if (score[lag] > best.score[lane]) best.score[lane] = score[lag], best.lag[lane] = lag;
    });
    best.share_highest();
    const int best_lag = best.lag.of(0), best_z = best_lag / (ny * nx), best_y = best_lag / nx % ny;
    const auto lags_away = [&](int lag) {
        const int dz = lag / (ny * nx) - best_z, dy = lag / nx % ny - best_y, dx = lag % nx - best_lag % nx;
        return max(max(dz < 0 ? -dz : dz, dy < 0 ? -dy : dy), dx < 0 ? -dx : dx);
    };
    for_lanes([&](int lane) {
        for (int lag = lane; lag < lags; lag += LANES_OF_WARP)
            if (score[lag] > rival.score[lane] && lags_away(lag) > windows.reach)
                rival.score[lane] = score[lag], rival.lag[lane] = lag;
    });
    rival.share_highest();
    LaneScores second;
    for_lanes([&](int lane) {
        if (rival.score[lane] > 0.0f && is_peak(score, windows.lags, rival.lag[lane]))
            second.score[lane] = rival.score[lane], second.lag[lane] = rival.lag[lane];
        for (int lag = lane; lag < lags; lag += LANES_OF_WARP)
            if (score[lag] > second.score[lane] && lags_away(lag) >= windows.reach && is_peak(score, windows.lags, lag))
                second.score[lane] = score[lag], second.lag[lane] = lag;
    });
    second.share_highest();
    for_lanes([&](int lane) {  // each writes one of the eight values
        if (lane > 7) return;
        const int lag = lane < 3 ? best.lag[lane] : second.lag[lane];
        const bool found = lane < 3 ? has_neighbours(windows.lags, lag) : second.score[lane] > 0.0f;
        float value = lane == 6 ? best.score[lane] : rival.score[lane];
        if (lane < 6) value = found ? displacement_along(lane % 3, windows.lags, score + lag, lag, 1) : NAN;
        out[lane * windows.peak_pitch + task] = value;
    });
}

}  // namespace lfpiv

#endif
