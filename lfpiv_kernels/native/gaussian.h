// Image of a Gaussian particle under one microlens, a vector of pixels at a time; see ``weights/gaussian.py``.
#ifndef LFPIV_GAUSSIAN_H
#define LFPIV_GAUSSIAN_H

#include "ray_model.h"

namespace lfpiv {

/// Distance from a cell at which a Gaussian is cut off [standard deviation].
constexpr float REACH = 2.8f;
/// Numbers of a pixel: derivatives by x, y, z, and the weight.
constexpr int VALUES = 4;

/// Return 1 / sqrt(2 pi) exp(-x^2 / 2), relative error 3e-7.
LFPIV_INLINE V normal_density(V x) {
    constexpr float ROOT = 0.39894228f;
#if LFPIV_GPU
    return ROOT * expf(-0.5f * x * x);
#else
    const V power = max(-0.72134752f * x * x, splat(-120.0f));  // of 2
    const V whole = floor(power + 0.5f), part = power - whole;
    V series = 1.5403530e-4f * part + 1.3333558e-3f;  // Taylor series of 2^part
    series = series * part + 9.6181291e-3f;
    series = series * part + 5.5504109e-2f;
    series = series * part + 2.4022651e-1f;
    series = series * part + 6.9314718e-1f;
    series = series * part + 1.0f;
    const M exponent = (__builtin_convertvector(whole, M) + 127) << 23;
    return ROOT * series * (V)exponent;
#endif
}

/// Return the probability of a standard normal variable below x, from its density (Hastings; error 1e-7).
LFPIV_INLINE V normal_below(V x, V density) {
    const V t = 1.0f / (1.0f + 0.2316419f * abs(x));
    V series = 1.330274429f * t - 1.821255978f;
    series = series * t + 1.781477937f;
    series = series * t - 0.356563782f;
    series = series * t + 0.319381530f;
    const V tail = density * series * t;
    return x > 0.0f ? 1.0f - tail : tail;
}

/// Probability that a normal variable lies between two limits, and its derivative by the mean.
struct Within {
    V probability, slope;

    LFPIV_INLINE Within(float low, float high, V at, float inverse_sigma) {
        const V x = (low - at) * inverse_sigma, y = (high - at) * inverse_sigma;
        const V density_x = normal_density(x), density_y = normal_density(y);
        probability = normal_below(y, density_y) - normal_below(x, density_x);
        slope = (density_x - density_y) * inverse_sigma;
    }
};

/// A particle before the microlens at `centre`: Warp's structs `Inputs` and `View`, and its ray model.
template <class Inputs, class View>
struct Particle {
    const Inputs& inputs;
    const View& view;
    const float* model;
    float centre_s, centre_t;

    LFPIV_INLINE V along(int axis, V s, V t) const {
        return view.to_cell.data[axis][0] * s + view.to_cell.data[axis][1] * t;
    }

    /// Where rays through the pupil points (u, v) pass the lens's centre, along an axis of the cell [pitch].
    LFPIV_INLINE void pass(V u, V v, V& a, V& b) const {
        const float* m = model;
        const V s = Voxel::along(m[0] - centre_s, m, m + 30, u, v);
        const V t = Voxel::along(m[6] - centre_t, m + 6, m + 34, u, v);
        a = along(0, s, t);
        b = along(1, s, t);
    }

    /// Derivatives of the weight by x, y, z [1 / voxel] and the weight, without share and gain.
    LFPIV_INLINE void weigh(V u, V v, V a, V b, V (&weight)[VALUES]) const {
        V inside = V{}, slope_a = V{}, slope_b = V{};
        const float inverse_a = 1.0f / view.sigma[0], inverse_b = 1.0f / view.sigma[1];
        for (int k = 0; k < (int)inputs.rectangles.shape[0]; ++k) {
            const float* limit = inputs.rectangles.data + 4 * k;
            const Within in_a(limit[0], limit[1], a, inverse_a), in_b(limit[2], limit[3], b, inverse_b);
            inside = inside + in_a.probability * in_b.probability;
            slope_a = slope_a + in_a.slope * in_b.probability;
            slope_b = slope_b + in_a.probability * in_b.slope;
        }
        for (int axis = 0; axis < 3; ++axis) {
            const float *edge = model + 12 + 2 * axis, *bend = model + 18 + 4 * axis;
            const V s = edge[0] + bend[0] * u + bend[1] * v, t = edge[1] + bend[2] * u + bend[3] * v;
            weight[axis] = view.amplitude * (slope_a * along(0, s, t) + slope_b * along(1, s, t));
        }
        weight[3] = view.amplitude * inside;
    }
};

/// Read shares of a microimage; lanes beyond its end are 0.
LFPIV_INLINE V load_shares(const float* from, int left) {
    if (left >= WIDTH) return load(from);
    V shares = V{};
    for (int k = 0; k < left; ++k) set_lane(shares, k, from[k]);
    return shares;
}

/// Write the pixels that a particle lights through one lens and their values; return their number.
template <class Inputs, class View>
LFPIV_INLINE int write_lens(const Inputs& inputs, const View& view, int particle, int lens, int ray, float centre_s,
                            float centre_t, int* pixel_out, float* values_out) {
    const Particle<Inputs, View> own{inputs, view, inputs.model.data + MODEL_SIZE * (int64_t)particle, centre_s,
                                     centre_t};
    const int edge = inputs.edge, rays = edge * edge;
    const float cell = inputs.pixel_mm / inputs.ratio, grown = (1.0f + inputs.ratio) / inputs.ratio;
    const float first_u = centre_s * grown - (inputs.corners.data[2 * lens] + 0.5f - inputs.half[0]) * cell;
    const float first_v = centre_t * grown - (inputs.corners.data[2 * lens + 1] + 0.5f - inputs.half[1]) * cell;
    const float reach_a = inputs.extent[0] + REACH * view.sigma[0], reach_b = inputs.extent[1] + REACH * view.sigma[1];
    V column = V{}, row = V{};
    for (int k = 0; k < WIDTH; ++k) {
        set_lane(column, k, (float)(k % edge));
        set_lane(row, k, (float)(k / edge));
    }
    int written = 0;
    for (int n = 0; n < rays; n += WIDTH) {
        const V share = load_shares(inputs.share.data + ray + n, rays - n);
        V u = first_u - cell * column, v = first_v - cell * row;
        column = column + (float)WIDTH;
        for (auto over = column >= (float)edge; any(over); over = column >= (float)edge) {
            row = over ? row + 1.0f : row;
            column = over ? column - (float)edge : column;
        }
        if (!any(share > 0.0f)) continue;
        if (any(share < 1.0f)) {  // the middle of the part inside the pupil
            const V far = max(sqrt(u * u + v * v), splat(cell));
            const V shrunk = 1.0f - (1.0f - share) * (0.5f * cell) / far;
            u = u * shrunk;
            v = v * shrunk;
        }
        V a, b;
        own.pass(u, v, a, b);
        const auto lit = (abs(a) < reach_a) & (abs(b) < reach_b) & (share > 0.0f);
        if (!any(lit)) continue;
        V weight[VALUES];
        own.weigh(u, v, a, b, weight);
        for (int k = 0; k < WIDTH; ++k) {
            if (!lane(lit, k)) continue;
            const int pixel = inputs.pixel.data[ray + n + k];
            const float scale = pixel >= 0 ? lane(share, k) * inputs.gain.data[pixel] : 0.0f;
            if (scale <= 0.0f) continue;
            pixel_out[written] = pixel;
            for (int value = 0; value < VALUES; ++value)
                values_out[VALUES * written + value] = lane(weight[value], k) * scale;
            ++written;
        }
    }
    return written;
}

}  // namespace lfpiv

#endif
