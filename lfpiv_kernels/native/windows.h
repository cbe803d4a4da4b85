// Statistics of a volume's windows: sums over y and x in each plane, then along z; see ``correlation/windows.py``.
#ifndef LFPIV_WINDOWS_H
#define LFPIV_WINDOWS_H

#include "simd.h"

namespace lfpiv {

/// Return how many windows fit along an axis of the volume with its margin.
template <class Extent>
LFPIV_INLINE int windows_along(const Extent& extent, int axis) {
    return extent.shape[axis] + 2 * extent.margin[axis] - extent.window[axis] + 1;
}

/// Sum `terms` elements at a distance for each of `size` elements, which are rounded up to whole vectors.
LFPIV_INLINE void sum_terms(const float* from, int64_t distance, int terms, int size, float* to) {
    for (int k = 0; k < size; k += WIDTH) {
        V total = load(from + k);
        for (int i = 1; i < terms; ++i) total += load(from + i * distance + k);
        store(to + k, total);
    }
}

/// Sum a plane and its squares over the y and x of every window of the lattice's rows.
/// Each sum over an edge is a sum of sums of `factors` values.
template <class Extent, class Lattice>
LFPIV_INLINE void sum_plane(const float* volume, const Extent& extent, const Lattice& lattice, int z, float* scratch,
                            float* sums, float* squares) {
    const int ny = extent.shape[1], nx = extent.shape[2], margin_y = extent.margin[1], margin_x = extent.margin[2];
    const int columns = windows_along(extent, 2), rows = windows_along(extent, 1), padded = nx + 2 * margin_x;
    const int part_y = extent.factors[0], part_x = extent.factors[1];
    const int pitch = (padded + 31) / 16 * 16;  // as in `plane_sums_call`
    float* line = scratch;                      // a row of the volume with its margin
    float* square = line + pitch;
    float* part = square + pitch;
    float* along_x = part + 2 * pitch;                   // (y, sum or sum of squares, x)
    float* along_y = along_x + (int64_t)2 * ny * pitch;  // the same of `part_y` rows
    for (int x = 0; x < 4 * pitch; ++x) scratch[x] = 0.0f;
    for (int y = 0; y < ny; ++y) {
        const float* row = volume + ((int64_t)z * ny + y) * nx;
        for (int x = 0; x < nx; ++x) {
            line[margin_x + x] = row[x];
            square[margin_x + x] = row[x] * row[x];
        }
        for (int k = 0; k < 2; ++k) {
            sum_terms(line + k * pitch, 1, part_x, padded - part_x + 1, part);
            sum_terms(part, part_x, extent.window[2] / part_x, columns, along_x + (2 * y + k) * (int64_t)pitch);
        }
    }
    for (int y = 0; y <= ny + 2 * margin_y - part_y; ++y) {  // rows of the margin are 0
        const int low = max(y - margin_y, 0), high = min(y - margin_y + part_y, ny);
        float* to = along_y + (int64_t)2 * y * pitch;
        if (low < high)
            sum_terms(along_x + (int64_t)2 * low * pitch, 2 * pitch, high - low, 2 * pitch, to);
        else
            for (int x = 0; x < 2 * pitch; ++x) to[x] = 0.0f;
    }
    for (int y = lattice.corner[1]; y < rows; ++y) {
        if ((y - lattice.corner[1]) % lattice.stride[1] >= lattice.phases[1]) continue;  // no window starts there
        for (int k = 0; k < 2; ++k) {
            float* to = (k ? squares : sums) + ((int64_t)z * rows + y) * columns;
            const float* from = along_y + (int64_t)(2 * y + k) * pitch;
            sum_terms(from, (int64_t)part_y * 2 * pitch, extent.window[1] / part_y, columns, part);
            for (int x = 0; x < columns; ++x) to[x] = part[x];
        }
    }
}

/// Windows of a row whose statistics are measured at once.
constexpr int MOST_WINDOWS = 256;

/// Add the sums of one plane to those of `count` windows and subtract those of another; either may be null.
/// In double precision a plane that is subtracted leaves nothing behind.
LFPIV_INLINE void move(double* total, int count, const float* ahead, const float* behind) {
    if (ahead && behind) {
        for (int x = 0; x < count; ++x) total[x] += (double)ahead[x] - (double)behind[x];
    } else if (ahead) {
        for (int x = 0; x < count; ++x) total[x] += ahead[x];
    } else if (behind) {
        for (int x = 0; x < count; ++x) total[x] -= behind[x];
    }
}

/// Copy `count` windows' values, window `begin` first, to the phases of a row of the lattice.
template <class Lattice>
LFPIV_INLINE void store_phases(const float* values, int begin, int count, const Lattice& lattice, float* to) {
    const int stride = lattice.stride[2];
    for (int phase = 0; phase < lattice.phases[2]; ++phase, to += lattice.lanes) {
        int x = lattice.corner[2] + phase - begin, lane = 0;  // first window of the phase
        if (x < 0) {
            lane = (stride - 1 - x) / stride;
            x += lane * stride;
        }
        const int end = x < count ? lane + (count - x + stride - 1) / stride : lane, last = min(end, lattice.pitch);
        for (const float* value = values + x; lane < last; ++lane, value += stride) to[lane] = *value;
    }
}

/// Where the statistics of the windows that start at row y are stored, and how many voxels a window has.
template <class Extent, class Lattice>
struct StatisticsRow {
    bool wanted;  // whether windows of the lattice start there
    int columns;  // windows that fit along x
    int z;        // plane of the volume at which the lattice begins
    int64_t plane_pitch, to_row, to_plane;
    double share;  // of a voxel in its window

    LFPIV_INLINE StatisticsRow(const Extent& extent, const Lattice& lattice, int y) {
        const int row = y - lattice.corner[1], phase = row % lattice.stride[1], lane_row = row / lattice.stride[1];
        wanted = row >= 0 && phase < lattice.phases[1] && (lane_row + 1) * lattice.pitch <= lattice.lanes;
        columns = windows_along(extent, 2);
        z = lattice.corner[0] - extent.margin[0];
        plane_pitch = (int64_t)windows_along(extent, 1) * columns;
        to_row = (int64_t)phase * lattice.phases[2] * lattice.lanes + lane_row * lattice.pitch;
        to_plane = (int64_t)lattice.phases[1] * lattice.phases[2] * lattice.lanes;
        share = 1.0 / (extent.window[0] * extent.window[1] * extent.window[2]);
    }
};

/// Return 1 / sqrt(sum of squared deviations) from the sums of a window's values and squares, and their mean.
/// Windows whose sum of squared deviations is at most `floor` hold no signal: their scale is 0.
LFPIV_INLINE float window_scale(double total, double square, double mean, float floor) {
    const float deviation = (float)(square - total * mean);
    return deviation > floor ? 1.0f / sqrtf(max(deviation, floor)) : 0.0f;
}

/// Measure mean and scale of the windows that start at row y, from the sums of `sum_plane`, and store them
/// by phase.
template <class Extent, class Lattice>
LFPIV_INLINE void measure_row(const float* sums, const float* squares, const Extent& extent, float floor,
                              const Lattice& lattice, int y, float* mean, float* scale) {
    const StatisticsRow<Extent, Lattice> row(extent, lattice, y);
    if (!row.wanted) return;
    const int depth = extent.window[0];
    double total[MOST_WINDOWS], square[MOST_WINDOWS];
    float means[MOST_WINDOWS], scales[MOST_WINDOWS];
    for (int begin = 0; begin < row.columns; begin += MOST_WINDOWS) {
        const int count = min(row.columns - begin, MOST_WINDOWS);
        for (int x = 0; x < count; ++x) total[x] = square[x] = 0.0;
        const int64_t start = (int64_t)y * row.columns + begin;
        auto plane_of = [&](const float* of, int p) {
            return p >= 0 && p < extent.shape[0] ? of + start + p * row.plane_pitch : nullptr;
        };
        for (int plane = 1 - depth; plane < lattice.planes; ++plane) {
            const int ahead = row.z + plane + depth - 1, behind = plane > 0 ? row.z + plane - 1 : -1;
            move(total, count, plane_of(sums, ahead), plane_of(sums, behind));
            move(square, count, plane_of(squares, ahead), plane_of(squares, behind));
            if (plane < 0 || plane % lattice.stride[0] >= lattice.phases[0]) continue;
            for (int x = 0; x < count; ++x) {
                const double m = total[x] * row.share;
                means[x] = (float)m;
                scales[x] = window_scale(total[x], square[x], m, floor);
            }
            store_phases(means, begin, count, lattice, mean + plane * row.to_plane + row.to_row);
            store_phases(scales, begin, count, lattice, scale + plane * row.to_plane + row.to_row);
        }
    }
}

}  // namespace lfpiv

#endif
