// Statistics of a volume's windows on a GPU: a thread per row or column of windows; see ``correlation/windows_gpu.py``.
#ifndef LFPIV_WINDOWS_GPU_H
#define LFPIV_WINDOWS_GPU_H

#include "windows.h"

namespace lfpiv {

/// Sum the values, and their squares, of a row of the volume over the x of the window that starts at column
/// x; `row` counts rows of all planes.
template <class Extent>
LFPIV_INLINE void sum_row(const float* volume, const Extent& extent, int row, int x, float* sums, float* squares) {
    const int nx = extent.shape[2], first = x - extent.margin[2];
    const int low = max(first, 0), high = min(first + extent.window[2], nx);
    const float* from = volume + (int64_t)row * nx;
    float total = 0.0f, square = 0.0f;
    for (int k = low; k < high; ++k) {
        total += from[k];
        square += from[k] * from[k];
    }
    const int64_t to = (int64_t)row * windows_along(extent, 2) + x;
    sums[to] = total;
    squares[to] = square;
}

/// Add up the sums of `sum_row` over the y of the window that starts at row y and column x of a plane.
template <class Extent, class Lattice>
LFPIV_INLINE void sum_column(const float* along_x, const float* squares_along_x, const Extent& extent,
                             const Lattice& lattice, int z, int y, int x, float* sums, float* squares) {
    if (y < lattice.corner[1] || (y - lattice.corner[1]) % lattice.stride[1] >= lattice.phases[1]) return;
    const int columns = windows_along(extent, 2), first = y - extent.margin[1];
    const int low = max(first, 0), high = min(first + extent.window[1], extent.shape[1]);
    const int64_t from = (int64_t)z * extent.shape[1] * columns + x;
    float total = 0.0f, square = 0.0f;
    for (int k = low; k < high; ++k) {
        total += along_x[from + (int64_t)k * columns];
        square += squares_along_x[from + (int64_t)k * columns];
    }
    const int64_t to = ((int64_t)z * windows_along(extent, 1) + y) * columns + x;
    sums[to] = total;
    squares[to] = square;
}

/// Measure mean and scale of the windows that start at row y and column x of every plane, as `measure_row` does, and
/// store them (plane, y, x) with as many y and x as windows fit. Neighbouring threads have neighbouring columns.
template <class Extent, class Lattice>
LFPIV_INLINE void measure_column(const float* sums, const float* squares, const Extent& extent, float floor,
                                 const Lattice& lattice, int y, int x, float* mean, float* scale) {
    if (y < lattice.corner[1] || (y - lattice.corner[1]) % lattice.stride[1] >= lattice.phases[1]) return;
    const StatisticsRow<Extent, Lattice> row(extent, lattice, y);
    const int64_t from = (int64_t)y * row.columns + x;
    const int depth = extent.window[0];
    double total = 0.0, square = 0.0;
    for (int plane = 1 - depth; plane < lattice.planes; ++plane) {
        const int ahead = row.z + plane + depth - 1, behind = plane > 0 ? row.z + plane - 1 : -1;
        const bool adds = ahead >= 0 && ahead < extent.shape[0], drops = behind >= 0 && behind < extent.shape[0];
        const int64_t add = from + ahead * row.plane_pitch, drop = from + behind * row.plane_pitch;
        total += (adds ? (double)sums[add] : 0.0) - (drops ? (double)sums[drop] : 0.0);
        square += (adds ? (double)squares[add] : 0.0) - (drops ? (double)squares[drop] : 0.0);
        if (plane < 0) continue;
        const double m = total * row.share;
        mean[plane * row.plane_pitch + from] = (float)m;
        scale[plane * row.plane_pitch + from] = window_scale(total, square, m, floor);
    }
}

}  // namespace lfpiv

#endif
