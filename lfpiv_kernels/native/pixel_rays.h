// The linear map between the rays of a camera and its pixels, for those rays that voxels light. For the CPU; a GPU has
// ``pixel_rays_gpu.h``.
#ifndef LFPIV_PIXEL_RAYS_H
#define LFPIV_PIXEL_RAYS_H

#include "microimages.h"

namespace lfpiv {

/// Pixels that a thread goes through.
constexpr int RUN = 64;

/// Device arrays of `PixelRays`, see ``pixel_rays.py``, and the part of the pixels that one thread goes through.
struct PixelRun {
    const int* pixel;
    const int* first;
    const int* place;
    const float* share;
    const int* dark;
    int start, pixels;  // the pixels from here to here
    int aside, asides;  // pixels that take no part though their rays do, and their end
    int darks, runs;
    int run;

    /// Return the light of a pixel: the sum of its rays, each times its share.
    LFPIV_INLINE float collect(const float* rays, int pixel) const {
        float light = 0.0f;
        for (int n = first[pixel]; n < first[pixel + 1]; ++n) light += share[n] * rays[place[n]];
        return light;
    }

    /// Write a pixel's light, times their shares, on its rays.
    LFPIV_INLINE void spread(float light, int pixel, float* rays_out) const {
        for (int n = first[pixel]; n < first[pixel + 1]; ++n) rays_out[place[n]] = share[n] * light;
    }

    /// Write zero on this run's part of the rays that no pixel sees, or pixels that take no part.
    LFPIV_INLINE void darken(float* rays_out) const {
        const int end = aside + (int)((int64_t)(asides - aside) * (run + 1) / runs);
        const int begin = aside + (int)((int64_t)(asides - aside) * run / runs);
        for (int n = begin < end ? first[begin] : 0; n < (begin < end ? first[end] : 0); ++n) rays_out[place[n]] = 0.0f;
        const int last = (int)((int64_t)darks * (run + 1) / runs);
        for (int n = (int)((int64_t)darks * run / runs); n < last; ++n) rays_out[dark[n]] = 0.0f;
    }

    /// Pixels that `for_pixels` gives at once: all of the run, so that the compiler's vectors are full.
    static constexpr int GROUP = RUN;

    /// Call work(first pixel, number of pixels) for the run's pixels.
    template <class Work>
    LFPIV_INLINE void for_pixels(Work work) const {
        const int next = start + run * RUN;
        if (next < pixels) work(next, pixels - next < GROUP ? pixels - next : GROUP);
    }
};

/// Return one thread's part of the map from Warp's struct.
template <class Map>
LFPIV_INLINE PixelRun pixel_run(const Map& map, int run) {
    return {map.pixel.data, map.first.data, map.place.data, map.share.data,         map.dark.data, map.start,
            map.end,        map.aside,      map.asides,     (int)map.dark.shape[0], map.runs,      run};
}

/// Sum the rays of every pixel of a run.
LFPIV_INLINE void collect(const PixelRun& run, const float* rays, float* image_out) {
    run.for_pixels([&](int start, int count) {
        for (int k = start; k < start + count; ++k) image_out[run.pixel[k]] = run.collect(rays, k);
    });
}

/// Give every ray of a run the light of its pixel times its share.
LFPIV_INLINE void spread(const PixelRun& run, const float* image, float* rays_out) {
    run.for_pixels([&](int start, int count) {
        for (int k = start; k < start + count; ++k) run.spread(image[run.pixel[k]], k, rays_out);
    });
    run.darken(rays_out);
}

/// Rays in memory, part after part: ray `starts[n]` lies at place `parts[n]`, and so on to `parts[n + 1]`.
struct PlacedRays {
    const float* light;  // per place
    const int* parts;
    int ends;  // length of `parts`
    const int* starts;
    const int* pixel;  // per ray
    const float* share;
    int size;                     // pixels of the sensor
    const unsigned char* set_of;  // set of each group of rays
    int group;                    // rays of a group
    int sets;

    /// Call lit(place, ray) for rays with light that a pixel sees, dark(place) for those that none sees.
    template <class Lit, class Dark>
    LFPIV_INLINE void for_places(Lit lit, Dark dark) const {
        for (int part = 0; part + 1 < ends; ++part) {
            const int shift = starts[part] - parts[part];
            for (int place = parts[part]; place < parts[part + 1]; ++place) {
                if (light[place] == 0.0f) continue;
                const int ray = place + shift;
                if (share[ray] > 0.0f)
                    lit(place, ray);
                else
                    dark(place);
            }
        }
    }
};

/// Return the rays from Warp's struct.
template <class Placed>
LFPIV_INLINE PlacedRays placed_rays(const Placed& placed) {
    return {placed.light.data, placed.parts.data, (int)placed.parts.shape[0], placed.starts.data, placed.pixel.data,
            placed.share.data, placed.size,       placed.set_of.data,         placed.group,       placed.sets};
}

/// Sets of rays at most.
constexpr int MOST_SETS = 64;

/// Number the pixels that see light, and count their rays: those of the first set, those of the second one and so on,
/// then those that see several. Within each they are in the order of their first rays. `number_out` and `first_out`
/// must hold zeros. Write where each set's pixels end, then the numbers of pixels, rays and dark places.
LFPIV_INLINE void number_pixels(const PlacedRays& placed, int* number_out, int* pixel_out, int* first_out,
                                int* count_out) {
    const int several = placed.sets + 1;  // sets are counted from 1 on
    int rays = 0, darks = 0, next[MOST_SETS + 3] = {};
    placed.for_places(
        [&](int, int ray) {
            int& seen = number_out[placed.pixel[ray]];
            const int set = 1 + placed.set_of[ray / placed.group];
            seen = seen == 0 || seen == -set ? -set : -several;
        },
        [&](int) { ++darks; });
    for (int pixel = 0; pixel < placed.size; ++pixel) ++next[1 - number_out[pixel]];
    next[1] = 0;
    for (int set = 1; set <= several; ++set) next[set + 1] += next[set];
    for (int set = 0; set < placed.sets; ++set) count_out[set] = next[set + 2];
    const int pixels = next[several + 1];
    placed.for_places(
        [&](int, int ray) {
            int& number = number_out[placed.pixel[ray]];
            if (number < 0) {
                int& last = next[-number];
                pixel_out[last] = placed.pixel[ray];
                number = ++last;
            }
            ++first_out[number + 1];
            ++rays;
        },
        [&](int) {});
    for (int k = 2; k < pixels + 2; ++k) first_out[k] += first_out[k - 1];
    count_out[placed.sets] = pixels, count_out[placed.sets + 1] = rays, count_out[placed.sets + 2] = darks;
}

/// Put each pixel's rays side by side. Moves `first_out[n]` from where the rays of pixel n begin to where they end.
LFPIV_INLINE void sort_rays(const PlacedRays& placed, const int* number, int* first_out, int* place_out,
                            float* share_out, int* dark_out) {
    int darks = 0;
    placed.for_places(
        [&](int place, int ray) {
            const int n = first_out[number[placed.pixel[ray]]]++;
            place_out[n] = place;
            share_out[n] = placed.share[ray];
        },
        [&](int place) { dark_out[darks++] = place; });
}

}  // namespace lfpiv

#endif
