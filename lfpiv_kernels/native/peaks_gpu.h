// Correlation coefficients of windows on a GPU, and their highest peaks; see ``correlation/peaks_gpu.py``. The
// coefficients of a window lie side by side, (window, lag).
#ifndef LFPIV_PEAKS_GPU_H
#define LFPIV_PEAKS_GPU_H

#include "lanes.h"
#include "peaks.h"

namespace lfpiv {

static_assert(WIDTH == 1, "a lane per window");

/// Form the coefficients of 32 of `count` windows at one lag. Tasks are numbered (lag, group of windows). Neighbouring
/// lanes read the sums of neighbouring windows.
template <class Sums, class Statistics, class Windows>
LFPIV_INLINE void score_windows(const Sums& sums, const Statistics& first, const Statistics& second,
                                const Windows& windows, int count, int task, float* score) {
    const int groups = (count + LANES_OF_WARP - 1) / LANES_OF_WARP, ny = windows.lags[1], nx = windows.lags[2];
    const int lag = task / groups, z = lag / (ny * nx), y = lag / nx % ny, x = lag % nx;
    for_lanes([&](int lane) {
        const int window = task % groups * LANES_OF_WARP + lane;
        if (window >= count) return;
        float* to = score + (int64_t)window * windows.score_pitch + lag;
        score_lag(sums, first, second, windows, windows_of(windows, window), z, y, x, nullptr, to);
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
