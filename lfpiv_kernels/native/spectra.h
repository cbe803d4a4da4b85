// Correlation of blocks with their surroundings by transforms, on the CPU; see ``correlation/transforms.py``.
#ifndef LFPIV_SPECTRA_H
#define LFPIV_SPECTRA_H

#include "planes.h"

namespace lfpiv {

/// Frequencies along y that are computed at once; rows of the waves are padded to a multiple of it.
constexpr int ROWS = 3;

#if !LFPIV_GPU

/// Pairs of lags, an even and an odd one, that are summed at once.
constexpr int MOST_PAIRS = WIDTH == 16 ? 5 : 2;

/// Sum PAIRS pairs of lags from pair `first` on, see `synthesise`.
template <int PAIRS, class Read, class Put>
LFPIV_INLINE void synthesise_pairs(const Read& read, const float* waves, int pairs, int half, int first, int most,
                                   const Put& put) {
    V cosines[PAIRS], cosines_odd[PAIRS], sines[PAIRS], sines_odd[PAIRS];
#pragma unroll
    for (int i = 0; i < PAIRS; ++i) cosines[i] = cosines_odd[i] = sines[i] = sines_odd[i] = V{};
    const float* wave = waves + first;
    for (int k = 0; k <= half / 2; ++k, wave += 4 * pairs) {
        const V even = read(0, k), even_far = read(0, half - k);
        const V sum = even + even_far, difference = even - even_far;
#pragma unroll
        for (int i = 0; i < PAIRS; ++i) {
            cosines[i] += wave[i] * sum;
            cosines_odd[i] += wave[pairs + i] * difference;
        }
        if (k == 0) continue;
        const V odd = read(1, k), odd_far = read(1, half - k);
        const V odd_sum = odd + odd_far, odd_difference = odd - odd_far;
#pragma unroll
        for (int i = 0; i < PAIRS; ++i) {
            sines[i] += wave[2 * pairs + i] * odd_difference;
            sines_odd[i] += wave[3 * pairs + i] * odd_sum;
        }
    }
#pragma unroll
    for (int i = 0; i < PAIRS; ++i) {
        const int lag = 2 * (first + i);
        put(-lag, cosines[i] + sines[i]);
        if (lag) put(lag, cosines[i] - sines[i]);
        if (lag == most) continue;
        put(-lag - 1, cosines_odd[i] + sines_odd[i]);
        put(lag + 1, cosines_odd[i] - sines_odd[i]);
    }
}

/// Transform back to the lags -most to most. Terms k and half - k are added for even lags and subtracted for odd ones
/// (the reverse for sines). `read(0, k)` gives the term that is even in the lag, `read(1, k)` the odd one; `waves` are
/// those of `_back` in ``transforms.py``.
template <class Read, class Put>
LFPIV_INLINE void synthesise(const Read& read, const float* waves, int half, int most, const Put& put) {
    const int pairs = most / 2 + 1;
    in_parts<1, MOST_PAIRS>(pairs, [&](auto length, int first) {
        synthesise_pairs<decltype(length)::value>(read, waves, pairs, half, first, most, put);
    });
}

/// Blocks of a group of lanes, or their surroundings: planes transformed along z, and how to transform their rows.
struct Operand {
    const float* planes;  // at the first lane
    int64_t plane;        // elements per plane
    const int *along_y, *along_x;
    int columns, lanes;  // voxels along x (of surroundings: their phases), and lanes of each
    const int* quads;    // folds along y
    int folds, sets;     // 2 sets if even and odd frequencies need different folds, else 1
    const float* waves;  // (even or odd frequencies, fold, cosine or sine, frequency)
    float* folded;       // (fold, real or imaginary, set, even or odd, x, lane)
    float* factors;      // (frequency, sign, factor, x, lane)

    int64_t pitch() const { return (int64_t)columns * lanes; }
};

/// Fold the rows of one plane along y; `part` is 0 for real values, 1 for imaginary ones.
LFPIV_INLINE void fold_rows(const Operand& of, int64_t plane, int part) {
    const float* from = of.planes + plane * of.plane;
    const int* quad = of.quads;
    const int64_t pitch = of.pitch();
    float* to = of.folded + part * 2 * of.sets * pitch;
    for (int q = 0; q < of.folds; ++q, quad += 4, to += 4 * of.sets * pitch) {
        for (int x = 0; x < of.columns; ++x) {
            const float* row[4];
            for (int i = 0; i < 4; ++i) row[i] = quad[i] < 0 ? nullptr : from + of.along_y[quad[i]] + of.along_x[x];
            for (int k = 0; k < of.lanes; k += WIDTH) {
                auto voxel = [&](int i) { return row[i] ? load(row[i] + k) : V{}; };
                store_folded(voxel, of.sets, pitch, to + (int64_t)x * of.lanes + k);
            }
        }
    }
}

/// Transform folded rows to factors at ROWS even or odd frequencies from the `first` on, and at their negatives.
/// PARTS is 1 if the rows are real, 2 if complex. The products of the factors (re - im, re, im) of a block with those
/// of its surroundings, (re, im - re, im + re), are those of a complex product.
template <int PARTS, bool IS_BLOCK>
LFPIV_INLINE void analyse(const Operand& of, int odd, int first, int padded) {
    const int64_t pitch = of.pitch(), part_pitch = 2 * of.sets * pitch;
    const float* in = of.folded + (of.sets - 1) * 2 * odd * pitch;
    const float* waves = of.waves + (int64_t)odd * 2 * of.folds * padded + first;
    for (int64_t c = 0; c < pitch; c += WIDTH) {
        V even_sum[ROWS][PARTS], odd_sum[ROWS][PARTS];
#pragma unroll
        for (int i = 0; i < ROWS * PARTS; ++i) even_sum[i / PARTS][i % PARTS] = odd_sum[i / PARTS][i % PARTS] = V{};
        const float* from = in + c;
        const float* wave = waves;
        for (int q = 0; q < of.folds; ++q, from += 2 * part_pitch, wave += 2 * padded) {
#pragma unroll
            for (int p = 0; p < PARTS; ++p) {
                const V even = load(from + p * part_pitch), difference = load(from + p * part_pitch + pitch);
#pragma unroll
                for (int i = 0; i < ROWS; ++i) {
                    even_sum[i][p] += wave[i] * even;
                    odd_sum[i][p] += wave[padded + i] * difference;
                }
            }
        }
#pragma unroll
        for (int i = 0; i < ROWS; ++i)
            for (int sign = 0; sign < PARTS; ++sign) {
                V re = even_sum[i][0], im = sign ? odd_sum[i][0] : -odd_sum[i][0];
                if (PARTS > 1) {
                    re += sign ? -odd_sum[i][PARTS - 1] : odd_sum[i][PARTS - 1];
                    im += even_sum[i][PARTS - 1];
                }
                float* to = of.factors + (i * 2 + sign) * 3 * pitch + c;
                store(to, IS_BLOCK ? re - im : re);
                store(to + pitch, IS_BLOCK ? re : im - re);
                store(to + 2 * pitch, IS_BLOCK ? im : im + re);
            }
    }
}

/// Factors of a block and its surroundings as `add_row` reads them.
struct FactorVoxels {
    int64_t lanes;
    const int* places;  // of an offset along x in a row of the surroundings

    V block_at(const float* row, int x) const { return load(row + x * lanes); }
    V around_at(const float* row, int x) const { return load(row + places[x]); }
};

/// The correlation of a group of lanes, plane of frequencies by plane.
struct SpectralTask {
    Operand block, around;
    FactorVoxels voxels;
    int columns;  // of a block
    int half_z, half_y;
    int ny, nx;       // lags
    int padded;       // frequencies per row of the waves
    float* sums;      // (frequency y, sum re, im, difference re, im, lag x, lane)
    float* spectrum;  // (frequency z, re or im, lag y, lag x, lane)

    int64_t lag_pitch() const { return (int64_t)nx * block.lanes; }

    /// Sum the complex products of the conjugate of the block's factors and those of the surroundings along x.
    template <int LAGS>
    LFPIV_INLINE void multiply(V (&re)[LAGS], V (&im)[LAGS], int index, int lane, int lag) const {
        const float* a = block.factors + index * 3 * block.pitch() + lane;
        const float* b = around.factors + index * 3 * around.pitch() + lane;
#pragma unroll
        for (int t = 0; t < LAGS; ++t) re[t] = V{};
        add_row(re, voxels, a, b, columns, lag);
#pragma unroll
        for (int t = 0; t < LAGS; ++t) im[t] = re[t];
        add_row(re, voxels, a + 2 * block.pitch(), b + 2 * around.pitch(), columns, lag);
        add_row(im, voxels, a + block.pitch(), b + around.pitch(), columns, lag);
    }

    /// Store sum and difference of the products at one frequency along y, the `i`th of ROWS, and at its negative.
    template <int LAGS>
    LFPIV_INLINE void correlate_frequency(int i, int frequency, bool real, int lane, int lag) const {
        V re[LAGS], im[LAGS], re_back[LAGS], im_back[LAGS];
        multiply(re, im, 2 * i, lane, lag);
        const bool single = frequency == 0 || frequency == half_y;
        if (real || single) {
            const float twice = single ? 1.0f : 2.0f;  // the product at the negative is the conjugate
#pragma unroll
            for (int t = 0; t < LAGS; ++t) {
                re_back[t] = V{};
                im_back[t] = V{};
                re[t] *= twice;
                im[t] *= twice;
            }
        } else {
            multiply(re_back, im_back, 2 * i + 1, lane, lag);
        }
        const int64_t pitch = lag_pitch();
        float* to = sums + frequency * 4 * pitch + lag * block.lanes + lane;
#pragma unroll
        for (int t = 0; t < LAGS; ++t, to += block.lanes) {
            store(to, re[t] + re_back[t]);
            store(to + pitch, im[t] + im_back[t]);
            store(to + 2 * pitch, re[t] - re_back[t]);
            store(to + 3 * pitch, im[t] - im_back[t]);
        }
    }

    /// Correlate all frequencies along y of one frequency along z; `real` if its rows are.
    void correlate_plane(bool real) const {
        for (int odd = 0; odd < 2; ++odd)
            for (int first = 0; 2 * first + odd <= half_y; first += ROWS) {
                if (real) {
                    analyse<1, true>(block, odd, first, padded);
                    analyse<1, false>(around, odd, first, padded);
                } else {
                    analyse<2, true>(block, odd, first, padded);
                    analyse<2, false>(around, odd, first, padded);
                }
                for (int i = 0; i < ROWS && 2 * (first + i) + odd <= half_y; ++i)
                    for (int k = 0; k < block.lanes; k += WIDTH)
                        in_parts<LEAST_LAGS, MOST_LAGS>(nx, [&](auto length, int lag) {
                            correlate_frequency<decltype(length)::value>(i, 2 * (first + i) + odd, real, k, lag);
                        });
            }
    }

    /// Transform the products of one frequency along z back along y; `part` is 0 for real values, 1 for imaginary ones.
    void back_along_y(int frequency, int part, const float* waves) const {
        const int64_t pitch = lag_pitch(), sign = part ? -pitch : pitch;
        const float* from[2] = {sums + part * pitch, sums + (3 - part) * pitch};
        float* to = spectrum + (frequency * 2 + part) * ny * pitch + ny / 2 * pitch;
        for (int64_t c = 0; c < pitch; c += WIDTH)
            synthesise([&](int odd, int g) { return load(from[odd] + g * 4 * pitch + c); }, waves, half_y, ny / 2,
                       [&](int lag, V value) { store(to + lag * sign + c, value); });
    }

    /// Transform back along z and write the sums of products, (lag z, lag y, lag x, lane); `to` is at lag z = 0.
    void back_along_z(int most, const float* waves, float* to, int64_t sum_pitch) const {
        const int64_t plane = ny * lag_pitch();
        for (int column = 0; column < ny * nx; ++column)
            for (int k = 0; k < block.lanes; k += WIDTH) {
                const float* from = spectrum + (int64_t)column * block.lanes + k;
                synthesise(
                    [&](int odd, int f) { return load(from + (2 * f + odd) * plane); }, waves, half_z, most,
                    [&](int lag, V value) { stream(to + ((int64_t)lag * ny * nx + column) * sum_pitch + k, value); });
            }
    }
};

/// Sum the products of a group of blocks with their surroundings at all lags. Tasks are numbered (layer, group).
/// `past` is the number of lanes behind a group's last whose voxels it reaches.
template <class Volume, class Transform, class Layers>
LFPIV_INLINE void correlate_spectra(const Volume& first, const Volume& second, const Transform& transform,
                                    const Layers& layers, int past, int task, float* scratch, float* sums) {
    const int layer = task / layers.groups, lane = task % layers.groups * layers.group;
    const int lanes = min(layers.group, layers.lanes - lane), wide = (lanes + past + LANES - 1) / LANES * LANES;
    const int size_z = transform.size[0], half_z = size_z / 2, half_y = transform.size[1] / 2;
    const int nz = layers.lags[0], ny = layers.lags[1], nx = layers.lags[2], columns = layers.block[2];
    const int reach = columns + nx - 1, phases = min(reach, layers.stride[2]);
    const int padded = (half_y / 2 + ROWS) / ROWS * ROWS, folds = transform.folds[0], folds_around = transform.folds[1];
    const float* waves_around = transform.matrices.data + 4 * folds * padded;
    const float* from_y = waves_around + 4 * folds_around * padded;
    const float* from_z = from_y + 4 * (half_y / 2 + 1) * (ny / 4 + 1);
    const int64_t block_pitch = (int64_t)columns * lanes, around_pitch = (int64_t)phases * wide;
    float* folded_around = scratch + 8 * folds * block_pitch;
    float* factors = folded_around + 8 * folds_around * around_pitch;
    float* factors_around = factors + ROWS * 6 * block_pitch;
    float* frequency_sums = factors_around + ROWS * 6 * around_pitch;
    float* spectrum = frequency_sums + (int64_t)(half_y + 1) * 4 * nx * lanes;
    int* places = (int*)(spectrum + (int64_t)(half_z + 1) * 2 * ny * nx * lanes);
    for (int x = 0; x < reach; ++x) places[x] = x % layers.stride[2] * wide + x / layers.stride[2];
    const int64_t plane = (int64_t)layer * size_z;
    const SpectralTask correlation{
        {first.values.data + lane, first.plane, first.along_y.data, first.along_x.data, columns, lanes,
         transform.quads.data, folds, transform.folds[2] ? 2 : 1, transform.matrices.data, scratch, factors},
        {second.values.data + lane, second.plane, second.along_y.data, second.along_x.data, phases, wide,
         transform.quads.data + 4 * folds, folds_around, 2, waves_around, folded_around, factors_around},
        {lanes, places},
        columns,
        half_z,
        half_y,
        ny,
        nx,
        padded,
        frequency_sums,
        spectrum};
    for (int f = 0; f <= half_z; ++f) {
        const bool real = f == 0 || f == half_z;
        for (int part = 0; part < (real ? 1 : 2); ++part) {
            fold_rows(correlation.block, plane + (part ? half_z + f : f), part);
            fold_rows(correlation.around, plane + (part ? half_z + f : f), part);
        }
        correlation.correlate_plane(real);
        for (int part = 0; part < (real ? 1 : 2); ++part) correlation.back_along_y(f, part, from_y);
    }
    const int row = (layers.begin + layer) % layers.ring * nz + nz / 2;
    correlation.back_along_z(nz / 2, from_z, sums + (int64_t)row * ny * nx * layers.lanes + lane, layers.lanes);
}

#endif

}  // namespace lfpiv

#endif
