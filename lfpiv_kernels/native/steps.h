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
/// Largest absolute power of 2 by which light is multiplied: light below 1e30 vanishes before.
constexpr float LARGEST_POWER = 250.0f;

/// A float and its bits.
union Bits {
    float value;
    int bits;
};

/// Return 2^whole, for -126 <= whole <= 127.
LFPIV_INLINE float power_of_2(int whole) {
    Bits power;
    power.bits = (int)((unsigned)(whole + 127) << 23);
    return power.value;
}

/// The integer next to a number, absolute value below 2^22.
struct Nearest {
    int whole;
    float value;

    LFPIV_INLINE explicit Nearest(float x) {
    LFPIV_FUSED
        constexpr float SHIFT = 12582912.0f;  // 1.5 * 2^23: the sum has no bits for a fraction
        Bits sum, shift;
        shift.value = SHIFT, sum.value = x + SHIFT;
        whole = sum.bits - shift.bits;
        value = sum.value - SHIFT;
    }
};

/// Return light * 2^whole * e^rest for |whole| <= `LARGEST_POWER`, |rest| <= log(2) / 2; relative error 2e-7. Zeros
/// stay zero, and the result is not infinite or subnormal before the last product.
LFPIV_INLINE float times_power(float light, int whole, float rest) {
    LFPIV_FUSED
    float series = 1.3888889e-3f * rest + 8.3333333e-3f;  // Taylor series of e^rest
    series = series * rest + 4.1666667e-2f;
    series = series * rest + 1.6666667e-1f;
    series = series * rest + 0.5f;
    series = series * rest + 1.0f;
    series = series * rest + 1.0f;
    const int first = min(max(whole, -125), 127);
    return light * (series * power_of_2(first)) * power_of_2(whole - first);
}

/// Return light * e^x. Beyond |x| = 173 the power no longer changes.
LFPIV_INLINE float times_exp(float light, float x) {
    LFPIV_FUSED
    constexpr float LARGEST = LARGEST_POWER * 0.6931472f;
    x = -LARGEST > x ? -LARGEST : x < LARGEST ? x : LARGEST;
    const Nearest power(1.4426950f * x);
    const float rest = (x - power.value * 0.693359375f) + power.value * 2.12194440e-4f;  // log(2) in two parts
    return times_power(light, power.whole, rest);
}

/// Return log2(x) for a normal number x > 0; error 1e-7 and a rounding.
LFPIV_INLINE float log2_of(float x) {
    LFPIV_FUSED
    Bits mantissa;
    mantissa.value = x;
    const int whole = (mantissa.bits - 0x3f3504f3) >> 23;
    mantissa.bits -= whole << 23;
    const float t = (mantissa.value - 1.0f) / (mantissa.value + 1.0f), t2 = t * t;  // 2 artanh(t) / log(2)
    return (float)whole + t * (2.8853901f + t2 * (0.9617967f + t2 * (0.5770780f + t2 * 0.4121986f)));
}

/// Return light * (light / last)^exponent, at least `SMALLEST`; zeros of `last` stay zero.
LFPIV_INLINE float extrapolated(float light, float last, float exponent) {
    LFPIV_FUSED
    const float ratio = min(max(light / last, 1.0f / LARGEST_LEAP), LARGEST_LEAP);
    const float power = min(max(exponent * log2_of(ratio), -LARGEST_POWER), LARGEST_POWER);
    const Nearest nearest(power);
    const float ahead = times_power(light, nearest.whole, (power - nearest.value) * 0.6931472f);
    return last > 0.0f ? max(ahead, SMALLEST) : last;
}

/// Store the light of each voxel after a step, `light(voxel)`, and, if there is a last one, that to which momentum
/// carries it. Each output may be an input.
template <class Light>
LFPIV_INLINE void store_steps(int run, int size, const float* last, float momentum, float* stepped, float* ahead,
                              Light light) {
    if (last)
        for_voxels(run, size, [=](int k) {
            const float before = last[k], own = light(k);
            const float lifted = before > 0.0f ? max(own, SMALLEST) : own;
            const float beyond = extrapolated(lifted, before, momentum);
            stepped[k] = lifted;
            ahead[k] = beyond;
        });
    else
        for_voxels(run, size, [=](int k) { stepped[k] = light(k); });
}

/// Step by volume * exp(step * exponent * length). `over` is a factor of the exponent, if there is any.
LFPIV_INLINE void update(int run, int size, const float* volume, const float* exponent, const float* step, float length,
                         const float* over, const float* last, float momentum, float* stepped, float* ahead) {
    if (over)
        store_steps(run, size, last, momentum, stepped, ahead,
                    [=](int k) { return times_exp(volume[k], step[k] * (exponent[k] * length * over[k])); });
    else
        store_steps(run, size, last, momentum, stepped, ahead,
                    [=](int k) { return times_exp(volume[k], step[k] * (exponent[k] * length)); });
}

/// Step by volume * exp(logarithm + share * (logarithm - blurred)), the absolute exponent at most `largest`. `over` is
/// a factor of the blurred logarithm, if there is any.
LFPIV_INLINE void sharpen(int run, int size, const float* volume, const float* logarithm, const float* blurred,
                          float share, float largest, const float* over, const float* last, float momentum,
                          float* stepped, float* ahead) {
    const auto light = [=](int k, float smooth) {
        const float step = logarithm[k] + share * (logarithm[k] - smooth);
        return times_exp(volume[k], min(max(step, -largest), largest));
    };
    if (over)
        store_steps(run, size, last, momentum, stepped, ahead, [=](int k) { return light(k, blurred[k] * over[k]); });
    else
        store_steps(run, size, last, momentum, stepped, ahead, [=](int k) { return light(k, blurred[k]); });
}

/// Let momentum go on from the light of a volume.
LFPIV_INLINE void extrapolate(int run, int size, const float* last, float exponent, float* volume, float* ahead) {
    store_steps(run, size, last, exponent, volume, ahead, [=](int k) { return volume[k]; });
}

}  // namespace lfpiv

#endif
