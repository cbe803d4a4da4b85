// The map between rays and pixels on a GPU, a lane for each pixel, and SMART's correction on the rays; see
// ``reconstruction/pixel_rays_gpu.py``.
#ifndef LFPIV_PIXEL_RAYS_GPU_H
#define LFPIV_PIXEL_RAYS_GPU_H

#include "lanes.h"
#include "update.h"

namespace lfpiv {

/// Warps that go through the pixels of a camera: half of those that the largest GPUs hold at once.
constexpr int PIXEL_WARPS = 4096;

/// Call work(pixel) in a lane for each pixel from `begin` to `end`, 32 at a time, those of one warp out of
/// `PIXEL_WARPS`.
template <class Work>
LFPIV_INLINE void for_pixels(int warp, int begin, int end, Work work) {
    for (int64_t first = begin + (int64_t)warp * LANES_OF_WARP; first < end; first += PIXEL_WARPS * LANES_OF_WARP)
        for_lanes([&](int lane) {
            if (first + lane < end) work((int)first + lane);
        });
}

/// A pixel's rays.
template <class Map>
struct RaysOfPixel {
    const Map& map;
    int first, end;

    LFPIV_INLINE RaysOfPixel(const Map& map, int pixel)
        : map(map), first(map.first.data[pixel]), end(map.first.data[pixel + 1]) {}
    /// Return the sum of the rays, each times its share.
    LFPIV_INLINE float collect(const float* rays) const {
        float light = 0.0f;
        for (int n = first; n < end; ++n) {
            light += map.share.data[n] * rays[map.place.data[n]];
        }
        return light;
    }
    /// Write the light times their shares on the rays.
    LFPIV_INLINE void spread(float light, float* rays_out) const {
        for (int n = first; n < end; ++n) {
            rays_out[map.place.data[n]] = map.share.data[n] * light;
        }
    }
};

/// Write zero on one warp's part of the rays that no pixel sees, and of those of pixels that take no part.
template <class Map>
LFPIV_INLINE void darken_rays(const Map& map, int warp, float* rays_out) {
    for_pixels(warp, map.aside, map.asides, [&](int k) { RaysOfPixel<Map>(map, k).spread(0.0f, rays_out); });
    for_pixels(warp, 0, (int)map.dark.shape[0], [&](int k) { rays_out[map.dark.data[k]] = 0.0f; });
}

/// Sum the rays of every pixel of a warp.
template <class Map>
LFPIV_INLINE void collect_pixels(const Map& map, int warp, const float* rays, float* image_out) {
    for_pixels(warp, map.start, map.end, [&](int k) {
        const float light = RaysOfPixel<Map>(map, k).collect(rays);
        image_out[map.pixel.data[k]] = light;
    });
}

/// Give every ray of a warp the light of its pixel times its share.
template <class Map>
LFPIV_INLINE void spread_pixels(const Map& map, int warp, const float* image, float* rays_out) {
    for_pixels(warp, map.start, map.end, [&](int k) {
        const float light = image[map.pixel.data[k]];
        RaysOfPixel<Map>(map, k).spread(light, rays_out);
    });
    darken_rays(map, warp, rays_out);
}

/// Write the correction of a warp's pixels on their rays, which may lie where their light lies, and sum the misfit of
/// these pixels.
template <class Map>
LFPIV_INLINE void compare_pixels(const Map& map, int warp, const float* image, const float* gain, float floor,
                                 const float* rays_in, float* rays_out, double* squares_out, double* divergence_out) {
    PerLane<double> squares, divergence;
    for_lanes([&](int lane) { squares[lane] = divergence[lane] = 0.0; });
    for (int64_t first = map.start + (int64_t)warp * LANES_OF_WARP; first < map.end;
         first += PIXEL_WARPS * LANES_OF_WARP)
        for_lanes([&](int lane) {
            const int k = (int)first + lane;
            if (first + lane >= map.end) return;
            const RaysOfPixel<Map> rays(map, k);
            const float light = max(rays.collect(rays_in), 0.0f);  // interpolation may undershoot
            const Misfit misfit = compare_pixel(image[k], gain[k], floor, light);
            squares[lane] += (double)misfit.square, divergence[lane] += (double)misfit.divergence;
            rays.spread(misfit.correction, rays_out);
        });
    darken_rays(map, warp, rays_out);
    const double square = sum_lanes(squares), term = sum_lanes(divergence);
    in_first_lane([&] {
        squares_out[warp] = square;
        divergence_out[warp] = term;
    });
}

}  // namespace lfpiv

#endif
