// Sums of products of a row of voxels and its surroundings at several lags, which stay in registers.
#ifndef LFPIV_PRODUCTS_H
#define LFPIV_PRODUCTS_H

#include "simd.h"

namespace lfpiv {

/// Neighbouring windows that a CPU task handles at once; rows of windows are padded to a multiple of it.
constexpr int LANES = 16;
/// Lags along x that are summed at once. `search` is at least 2, so nearly equal parts of the lags have 5 to 11.
constexpr int LEAST_LAGS = 5, MOST_LAGS = 11;

/// A number known at compile time.
template <int N>
struct Constant {
    static constexpr int value = N;
};

/// Call `use` with `count` as a `Constant`, LEAST <= count <= MOST.
template <int LEAST, int MOST, class Use>
LFPIV_INLINE void with_constant(int count, const Use& use) {
    if constexpr (LEAST == MOST) {
        use(Constant<MOST>{});
    } else if (count == MOST) {
        use(Constant<MOST>{});
    } else {
        with_constant<LEAST, MOST - 1>(count, use);
    }
}

/// Split 0 to `count - 1` into nearly equal parts of LEAST to MOST, and call `use` with the length and begin of each.
template <int LEAST, int MOST, class Use>
LFPIV_INLINE void in_parts(int count, const Use& use) {
    int parts = (count + MOST - 1) / MOST;
    for (int begin = 0; parts > 0; --parts) {
        const int length = (count - begin + parts - 1) / parts;
        with_constant<LEAST, MOST>(length, [&](auto constant) { use(constant, begin); });
        begin += length;
    }
}

/// Add the products of COLUMNS voxels of a row from x on, see `add_row`.
template <int COLUMNS, int LAGS, class Voxels>
LFPIV_INLINE void add_columns(V (&total)[LAGS], const Voxels& voxels, const float* row, const float* around, int x,
                              int lag) {
    V block[COLUMNS];
#pragma unroll
    for (int c = 0; c < COLUMNS; ++c) block[c] = voxels.block_at(row, x + c);
#pragma unroll
    for (int k = 0; k < LAGS + COLUMNS - 1; ++k) {
        const V voxel = voxels.around_at(around, x + lag + k);
#pragma unroll
        for (int c = 0; c < COLUMNS; ++c)
            if (k >= c && k - c < LAGS) total[k - c] += block[c] * voxel;
    }
}

/// Add the products of a block's row and a row of its surroundings to the sums at LAGS lags from `lag` on.
/// `voxels.block_at(row, x)` and `voxels.around_at(around, x)` read one voxel of every lane.
template <int LAGS, class Voxels>
LFPIV_INLINE void add_row(V (&total)[LAGS], const Voxels& voxels, const float* row, const float* around, int columns,
                          int lag) {
    int x = 0;
    for (; x + 4 <= columns; x += 4) add_columns<4>(total, voxels, row, around, x, lag);
    for (; x < columns; ++x) add_columns<1>(total, voxels, row, around, x, lag);
}

}  // namespace lfpiv

#endif
