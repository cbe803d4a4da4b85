// Blur of a volume along one axis on a GPU, a lane for each voxel; see ``filters/blur_gpu.py``.
#ifndef LFPIV_BLUR_GPU_H
#define LFPIV_BLUR_GPU_H

#include "blur.h"
#include "lanes.h"

namespace lfpiv {

/// Write 32 voxels of a volume blurred along an axis whose neighbours lie `stride` apart. Neighbouring lanes read
/// neighbouring voxels whatever the axis. Away from the borders all read the same weights.
LFPIV_INLINE void blur_lanes(const AxisBlur& axis, int stride, int warp, int size, const float* volume, float* out) {
    for_lanes([&](int lane) {
        const int voxel = warp * LANES_OF_WARP + lane;
        if (voxel >= size) return;
        const int k = voxel / stride % axis.size;
        const float* const from = volume + voxel + (int64_t)(axis.first[k] - k) * stride;
        const float* const weight = axis.weight + (k >= axis.begin && k < axis.end ? axis.begin : k) * axis.taps;
        float sum = 0.0f;
        for (int t = 0; t < axis.taps; ++t) sum += weight[t] * from[(int64_t)t * stride];
        out[voxel] = sum;
    });
}

}  // namespace lfpiv

#endif
