// A volume stored by phase on a GPU: a warp transposes voxels of 32 lanes in shared memory; see
// ``correlation/layout.py`` for the structures.
#ifndef LFPIV_SPLIT_GPU_H
#define LFPIV_SPLIT_GPU_H

#include "lanes.h"

namespace lfpiv {

/// Phases along x that a warp moves at once, and warps of a thread block.
constexpr int PHASES_OF_TILE = 16;
constexpr int SPLIT_WARPS = 8;

/// Voxels of 32 lanes, (lane, phase). Every 32 of them are followed by a gap: lanes whose voxels lie a power of two
/// apart then meet in different banks.
struct SplitTile {
    static constexpr int SIZE = PHASES_OF_TILE * LANES_OF_WARP + PHASES_OF_TILE;
    float* voxels;

    LFPIV_INLINE float& operator[](int k) const { return voxels[k + k / LANES_OF_WARP]; }
};

/// Store the voxels of 32 lanes of a plane by phase, as `split_plane` of ``blocks.h`` does. Tasks are numbered (phase
/// along y, group of lanes). Neighbouring lanes read neighbouring voxels, then write neighbouring places.
template <class Triple, class Lattice>
LFPIV_INLINE void split_lanes(const float* volume, const Triple& shape, const Lattice& lattice, int plane, int task,
                              float* split) {
#if defined(__CUDA_ARCH__)
    __shared__ float tile_of_warps[SPLIT_WARPS][SplitTile::SIZE];
    const SplitTile tile{tile_of_warps[threadIdx.x / LANES_OF_WARP % SPLIT_WARPS]};
#else
    float tile_of_warp[SplitTile::SIZE];
    const SplitTile tile{tile_of_warp};
#endif
    const int groups = (lattice.lanes + LANES_OF_WARP - 1) / LANES_OF_WARP;
    const int phase_y = task / groups, first = task % groups * LANES_OF_WARP, z = lattice.corner[0] + plane;
    float* to = split + ((int64_t)plane * lattice.phases[1] + phase_y) * lattice.phases[2] * lattice.lanes + first;
    for (int begin = 0; begin < lattice.phases[2]; begin += PHASES_OF_TILE, to += PHASES_OF_TILE * lattice.lanes) {
        const int phases = min(lattice.phases[2] - begin, PHASES_OF_TILE);
        for_lanes([&](int lane) {
            for (int k = lane; k < LANES_OF_WARP * phases; k += LANES_OF_WARP) {
                const int at = first + k / phases, row = at / lattice.pitch;
                const int y = lattice.corner[1] + row * lattice.stride[1] + phase_y;
                const int x = lattice.corner[2] + (at - row * lattice.pitch) * lattice.stride[2] + begin + k % phases;
                const bool inside = z >= 0 && z < shape[0] && y >= 0 && y < shape[1] && x >= 0 && x < shape[2];
                tile[k] = inside ? volume[((int64_t)z * shape[1] + y) * shape[2] + x] : 0.0f;
            }
        });
        sync_lanes();
        for_lanes([&](int lane) {
            if (first + lane >= lattice.lanes) return;
            for (int p = 0; p < phases; ++p) to[p * lattice.lanes + lane] = tile[lane * phases + p];
        });
        sync_lanes();
    }
}

}  // namespace lfpiv

#endif
