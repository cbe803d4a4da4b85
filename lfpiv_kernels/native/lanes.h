// A warp of 32 lanes with one syntax for both processors: on a GPU each lane is a thread; on the CPU, for tests, a
// loop walks the lanes through one phase after the other.
#ifndef LFPIV_LANES_H
#define LFPIV_LANES_H

#include "simd.h"

namespace lfpiv {

/// Lanes of a warp.
constexpr int LANES_OF_WARP = 32;
constexpr unsigned ALL_OF_WARP = 0xffffffffu;

#if defined(__CUDA_ARCH__)

/// Sixteen bytes, read by one instruction.
struct alignas(16) Quad {
    unsigned x, y, z, w;
};

/// A variable of each lane.
template <class T>
struct PerLane {
    T own;

    LFPIV_INLINE T& operator[](int) { return own; }
    /// Return the variable of another lane. All lanes must ask, and none may write it in the same phase.
    LFPIV_INLINE T of(int lane) const { return __shfl_sync(ALL_OF_WARP, own, lane); }
};

/// Call phase(lane) for each lane of the warp.
template <class Phase>
LFPIV_INLINE void for_lanes(Phase phase) {
    phase((int)(threadIdx.x % LANES_OF_WARP));
}

/// Wait until what all lanes wrote to shared memory can be read.
LFPIV_INLINE void sync_lanes() { __syncwarp(); }

/// Return the sum of all lanes, added in pairs.
template <class T>
LFPIV_INLINE T sum_lanes(const PerLane<T>& value) {
    T total = value.own;
    for (int away = LANES_OF_WARP / 2; away > 0; away /= 2) total += __shfl_xor_sync(ALL_OF_WARP, total, away);
    return total;
}

#else

typedef unsigned Quad __attribute__((ext_vector_type(4)));

template <class T>
struct PerLane {
    T all[LANES_OF_WARP];

    LFPIV_INLINE T& operator[](int lane) { return all[lane]; }
    LFPIV_INLINE T of(int lane) const { return all[lane]; }
};

template <class Phase>
LFPIV_INLINE void for_lanes(Phase phase) {
    for (int lane = 0; lane < LANES_OF_WARP; ++lane) phase(lane);
}

LFPIV_INLINE void sync_lanes() {}

template <class T>
LFPIV_INLINE T sum_lanes(PerLane<T> value) {
    for (int away = LANES_OF_WARP / 2; away > 0; away /= 2)
        for (int lane = 0; lane < away; ++lane) value.all[lane] += value.all[lane + away];
    return value.all[0];
}

#endif

/// Call work() in one lane.
template <class Work>
LFPIV_INLINE void in_first_lane(Work work) {
    for_lanes([&](int lane) {
        if (lane == 0) work();
    });
}

}  // namespace lfpiv

#endif
