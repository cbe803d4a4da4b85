// A volume stored by phase on a GPU, a thread per voxel; see ``correlation/layout.py`` for the structures.
#ifndef LFPIV_SPLIT_GPU_H
#define LFPIV_SPLIT_GPU_H

#include "simd.h"

namespace lfpiv {

/// Store one voxel by phase, as `split_plane` of ``blocks.h`` does. `place` is where, counted from the first plane.
template <class Triple, class Lattice>
LFPIV_INLINE void split_voxel(const float* volume, const Triple& shape, const Lattice& lattice, int plane, int place,
                              float* split) {
    const int lane = place % lattice.lanes, phase = place / lattice.lanes, row = lane / lattice.pitch;
    const int z = lattice.corner[0] + plane;
    const int y = lattice.corner[1] + row * lattice.stride[1] + phase / lattice.phases[2];
    const int x = lattice.corner[2] + (lane - row * lattice.pitch) * lattice.stride[2] + phase % lattice.phases[2];
    const bool inside = z >= 0 && z < shape[0] && y >= 0 && y < shape[1] && x >= 0 && x < shape[2];
    const int64_t plane_size = (int64_t)lattice.phases[1] * lattice.phases[2] * lattice.lanes;
    split[plane * plane_size + place] = inside ? volume[((int64_t)z * shape[1] + y) * shape[2] + x] : 0.0f;
}

}  // namespace lfpiv

#endif
