// A warp of 32 lanes with one syntax for both processors: on a GPU each lane is a thread; on the CPU, for tests and for
// the model of memory traffic, a loop walks the lanes through one phase after the other.
#ifndef LFPIV_LANES_H
#define LFPIV_LANES_H

#include "simd.h"

namespace lfpiv {

/// Lanes of a warp.
constexpr int LANES_OF_WARP = 32;
constexpr unsigned ALL_OF_WARP = 0xffffffffu;

#if defined(LFPIV_TRACE)

/// Accesses to the GPU's memory, in the order of the loop over lanes. Lanes whose access has the same warp, phase and
/// number are one instruction.
struct Trace {
    uint64_t* events;  // two words each: warp, phase, number in the phase, lane; address, bytes, kind of access
    int64_t capacity, used;
    int64_t exchanges;  // instructions that go through shared memory or from lane to lane
    uint64_t warp, phase, number, lane;

    void add(const void* address, uint64_t bytes, uint64_t kind) {
        if (used < capacity) {
            events[2 * used] = warp << 40 | phase << 20 | number << 8 | lane;
            events[2 * used + 1] = (uint64_t)address << 8 | bytes << 2 | kind;
        }
        ++used, ++number;
    }
};
static Trace trace;

enum AccessKind { READ = 0, WRITE = 1 };
#define LFPIV_TRACED(address, bytes, kind) lfpiv::trace.add(address, bytes, kind)
#define LFPIV_EXCHANGED(count) lfpiv::trace.exchanges += lfpiv::trace.lane == 0 ? count : 0

#else
#define LFPIV_TRACED(address, bytes, kind) (void)0
#if !defined(LFPIV_EXCHANGED)
#define LFPIV_EXCHANGED(count) (void)0
#endif
#endif

/// Say which lane of a warp comes next; ``perf/traced.h`` notes it.
#if !defined(LFPIV_LANE)
#define LFPIV_LANE(number) (void)0
#endif

/// Read the GPU's memory. Every lane of a phase must read, so that lanes stay in step; see `read_if`.
template <class T>
LFPIV_INLINE T read(const T* from) {
    LFPIV_TRACED(from, sizeof(T), 0);
    return *from;
}

/// Read the same place of the GPU's memory in all lanes, outside of the loop over lanes.
template <class T>
LFPIV_INLINE T read_together(const T* from) {
#if defined(LFPIV_TRACE)
    ++trace.phase, trace.lane = 0, trace.number = 0;
#endif
    return read(from);
}

/// Read the GPU's memory where a condition holds, else return a value.
template <class T>
LFPIV_INLINE T read_if(bool condition, const T* from, T otherwise) {
    if (condition) return read(from);
    LFPIV_TRACED(nullptr, 0, 0);
    return otherwise;
}

/// Write the GPU's memory where a condition holds.
template <class T>
LFPIV_INLINE void write_if(bool condition, T* to, T value) {
    LFPIV_TRACED(condition ? to : nullptr, condition ? sizeof(T) : 0, 1);
    if (condition) *to = value;
}

/// Say that lanes whose loops differ in length are in step again: give the number of the next access.
LFPIV_INLINE void in_step([[maybe_unused]] int number) {
#if defined(LFPIV_TRACE)
    trace.number = number;
#endif
}

/// Sixteen bytes, read by one instruction.
struct alignas(16) Quad {
    unsigned x, y, z, w;
};

#if defined(__CUDA_ARCH__)

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

template <class T>
struct PerLane {
    T all[LANES_OF_WARP];

    LFPIV_INLINE T& operator[](int lane) { return all[lane]; }
    LFPIV_INLINE T of(int lane) const {
        LFPIV_EXCHANGED(1);
        return all[lane];
    }
};

template <class Phase>
LFPIV_INLINE void for_lanes(Phase phase) {
#if defined(LFPIV_TRACE)
    ++trace.phase;
#endif
    for (int lane = 0; lane < LANES_OF_WARP; ++lane) {
#if defined(LFPIV_TRACE)
        trace.lane = lane, trace.number = 0;
#endif
        LFPIV_LANE(lane);
        phase(lane);
    }
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
