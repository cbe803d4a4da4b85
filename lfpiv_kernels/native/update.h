// One camera's image beside the projection of a volume: SMART's correction on the rays, and two sums of the misfit.
#ifndef LFPIV_UPDATE_H
#define LFPIV_UPDATE_H

#include "pixel_rays.h"
#include "steps.h"

namespace lfpiv {

/// In place of -infinity, which a level of zero would not take away [counts].
constexpr float LEAST_CORRECTION = -1e30f;

/// One pixel's misfit.
struct Misfit {
    float correction;  // gain * log(I / P): what the volume's exponent gathers
    float square;      // (I - P)^2 [counts^2]
    float divergence;  // P log(P / I) - P + I [counts]
};

/// Compare a pixel's counts with its projected light, with I the counts and P the light times the gain, both plus
/// floor.
///
/// log(I / P) is 2 artanh(t) + exponent * log(2) with the quotient brought to 0.7 ... 1.4 by a power of 2, t at most
/// 0.172. Where that power is 1, t and the divergence come from the difference I - P, whose digits the quotient loses:
/// near its minimum a divergence is made of these.
LFPIV_INLINE Misfit compare_pixel(float counts, float gain, float floor, float projected) {
    const float infinite = (float)INFINITY;
    const float light = gain * projected, difference = counts - light, below = light + floor;
    const float excess = difference / below, quotient = (counts + floor) / below;
    const Binary binary(quotient);
    const int exponent = binary.exponent;
    const float t = (exponent ? binary.value - 1.0f : excess) / (binary.value + 1.0f), t2 = t * t;
    const float rest = t * t2 * (0.6666667f + t2 * (0.4f + t2 * (0.2857143f + t2 * 0.2222222f)));
    float logarithm = 0.6931472f * (float)exponent + (2.0f * t + rest);
    logarithm = quotient > 0.0f ? logarithm : -infinite;
    logarithm = below > 0.0f ? logarithm : 0.0f;
    const float other = difference - below * logarithm;
    const float correction = max(gain * logarithm, LEAST_CORRECTION);
    return {gain > 0.0f ? correction : 0.0f, difference * difference,
            (exponent || !(below > 0.0f)) ? other : below * (excess * t - rest)};
}

/// Write the correction of a run's pixels on their rays, which may lie where their light lies, and sum the misfit of
/// these pixels.
LFPIV_INLINE void compare(const PixelRun& run, const float* image, const float* gain, float floor, const float* rays,
                          float* rays_out, double* squares_out, double* divergence_out) {
    double squares = 0.0, divergence = 0.0;
    run.for_pixels([&](int start, int count) {
        float model[PixelRun::GROUP], square[PixelRun::GROUP], term[PixelRun::GROUP];
        for (int k = 0; k < count; ++k)
            model[k] = max(run.collect(rays, start + k), 0.0f);  // interpolation may undershoot
        for (int k = 0; k < count; ++k) {
            const Misfit misfit = compare_pixel(image[start + k], gain[start + k], floor, model[k]);
            model[k] = misfit.correction, square[k] = misfit.square, term[k] = misfit.divergence;
        }
        for (int k = 0; k < count; ++k) {
            squares += (double)square[k];
            divergence += (double)term[k];
        }
        for (int k = 0; k < count; ++k) run.spread(model[k], start + k, rays_out);
    });
    run.darken(rays_out);
    squares_out[run.run] = squares;
    divergence_out[run.run] = divergence;
}

}  // namespace lfpiv

#endif
