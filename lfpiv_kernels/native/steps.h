// SMART's steps on voxels, and the momentum after them. Powers are polynomials: the CPU's compiler works on many voxels
// at once, which functions of a library prevent.
#ifndef LFPIV_STEPS_H
#define LFPIV_STEPS_H

#include "voxels.h"

/// Lets the CPU's compiler fuse the products and sums of a function, as that of a GPU does.
#if LFPIV_GPU
#define LFPIV_FUSED
#else
#define LFPIV_FUSED _Pragma("clang fp contract(fast)")
#endif

namespace lfpiv {

/// Largest ratio of two iterates that momentum repeats, and the inverse of the smallest one.
constexpr float LARGEST_LEAP = 50.0f;
/// Least light of an active voxel under momentum: smaller float32 numbers are slow, and a zero would stay zero.
constexpr float SMALLEST = 1.17549435e-38f;
/// Largest absolute exponent of momentum.
constexpr float LARGEST_MOMENTUM = 20.0f;
/// Largest absolute x for which `exponential` gives e^x.
constexpr float LARGEST_EXPONENT = 86.0f;

/// A float and its bits.
union Bits {
    float value;
    int bits;
};

/// Return 2^whole * e^rest for |whole| <= 125 and |rest| <= log(2) / 2; relative error 1e-7 and roundings.
LFPIV_INLINE float power(int whole, float rest) {
    LFPIV_FUSED
    float series = 8.3125010e-3f * rest + 4.1890330e-2f;  // the least largest error
    series = series * rest + 1.6667116e-1f;
    series = series * rest + 4.9999230e-1f;
    series = series * rest + 1.0f;
    series = series * rest + 1.0f;
    Bits scale;
    scale.bits = (int)((unsigned)(whole + 127) << 23);
    return series * scale.value;
}

/// The integer next to a number, absolute value below 2^22.
struct Nearest {
    int whole;
    float value;

    LFPIV_INLINE explicit Nearest(float x) {
        constexpr float SHIFT = 12582912.0f;  // 1.5 * 2^23: the sum has no bits for a fraction
        Bits sum, shift;
        shift.value = SHIFT, sum.value = x + SHIFT;
        whole = sum.bits - shift.bits;
        value = sum.value - SHIFT;
    }
};

/// e^x as 2^whole * e^rest.
struct Exponent {
    int whole;
    float rest;

    LFPIV_INLINE explicit Exponent(float x) {
        LFPIV_FUSED
        const Nearest nearest(1.4426950f * x);
        whole = nearest.whole;
        rest = (x - nearest.value * 0.693359375f) + nearest.value * 2.1219444e-4f;  // log(2) in two parts
    }
};

/// Return e^x for |x| <= `LARGEST_EXPONENT`.
LFPIV_INLINE float exponential(float x) {
    const Exponent exponent(x);
    return power(exponent.whole, exponent.rest);
}

/// Return light * e^x for light below 1e30. An x beyond twice `LARGEST_EXPONENT` counts as that: light vanishes there.
/// Zeros stay zero, and no power is infinite.
LFPIV_INLINE float times_exponential(float light, float x) {
    constexpr float LARGEST = 2 * LARGEST_EXPONENT;
    x = x < -LARGEST ? -LARGEST : x > LARGEST ? LARGEST : x;  // NaN stays
    const Exponent exponent(x);
    const int first = min(max(exponent.whole, -125), 125);
    return light * power(first, exponent.rest) * power(min(max(exponent.whole - first, -125), 125), 0.0f);
}

/// A normal number x > 0 as 2^exponent * value, with a value from 0.7 to 1.4.
struct Binary {
    int exponent;
    float value;

    LFPIV_INLINE explicit Binary(float x) {
        Bits mantissa;
        mantissa.value = x;
        exponent = (mantissa.bits - 0x3f3504f3) >> 23;
        mantissa.bits -= exponent << 23;
        value = mantissa.value;
    }
};

/// Return log2(x) for a normal number x > 0; error 4e-8 and roundings.
LFPIV_INLINE float log2_of(float x) {
    LFPIV_FUSED
    const Binary binary(x);
    const float t = (binary.value - 1.0f) / (binary.value + 1.0f), t2 = t * t;  // 2 artanh(t) / log(2)
    return (float)binary.exponent + t * (2.8853912f + t2 * (0.96147080f + t2 * 0.59897390f));
}

/// Return light * (light / last)^exponent, at least `SMALLEST`; zeros of `last` stay zero.
LFPIV_INLINE float extrapolated(float light, float last, float exponent) {
    const float ratio = min(max(light / last, 1.0f / LARGEST_LEAP), LARGEST_LEAP);
    const float logarithm = exponent * log2_of(ratio);
    const Nearest nearest(logarithm);
    const float ahead = light * power(nearest.whole, 0.69314718f * (logarithm - nearest.value));
    return last > 0.0f ? max(ahead, SMALLEST) : last;
}

/// Store the light of each voxel after a step, `light(voxel)`, and, if there is a last one, that to which momentum
/// carries it. Each output may be an input.
template <class Light>
LFPIV_INLINE void store_steps(int run, int size, const float* last, float momentum, float* stepped, float* ahead,
                              Light light) {
    const float exponent = min(max(momentum, -LARGEST_MOMENTUM), LARGEST_MOMENTUM);
    if (last)
        for_voxels(run, size, [=](int k) {
            const float before = last[k], own = light(k);
            const float lifted = before > 0.0f ? max(own, SMALLEST) : own;
            const float beyond = extrapolated(lifted, before, exponent);
            stepped[k] = lifted;
            ahead[k] = beyond;
        });
    else
        for_voxels(run, size, [=](int k) { stepped[k] = light(k); });
}

/// Step by volume * exp(step * exponent * length).
LFPIV_INLINE void update(int run, int size, const float* volume, const float* exponent, const float* step, float length,
                         const float* last, float momentum, float* stepped, float* ahead) {
    store_steps(run, size, last, momentum, stepped, ahead,
                [=](int k) { return times_exponential(volume[k], step[k] * (exponent[k] * length)); });
}

/// Step by volume * exp(logarithm + share * (logarithm - blurred)), the absolute exponent at most `largest`.
LFPIV_INLINE void sharpen(int run, int size, const float* volume, const float* logarithm, const float* blurred,
                          float share, float largest, const float* last, float momentum, float* stepped, float* ahead) {
    const float most = min(largest, LARGEST_EXPONENT);
    store_steps(run, size, last, momentum, stepped, ahead, [=](int k) {
        const float step = logarithm[k] + share * (logarithm[k] - blurred[k]);
        return volume[k] * exponential(min(max(step, -most), most));
    });
}

}  // namespace lfpiv

#endif
