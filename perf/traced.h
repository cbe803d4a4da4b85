// Notes what the threads of a Warp kernel read and write of their arrays; see ``gpu_trace.py``.
// The compiler calls the functions at the end before each access (-fsanitize-coverage-trace-loads and -stores).
#ifndef LFPIV_TRACED_H
#define LFPIV_TRACED_H

#define LFPIV_LANE(number) traced::begin_lane(number)
#define LFPIV_EXCHANGED(count) traced::exchange(count)

namespace traced {

/// An array's memory, and where it lies on a GPU.
struct Range {
    uint64_t begin, end, place;
};

/// An instruction, and how often each lane of the present warp has come to it. Lanes are in step again where a loop
/// over them begins: all then count from the most times.
struct Site {
    void* address;
    int64_t warp, loop;
    int times[32];
};

constexpr int SITES = 1 << 12;
/// Visits of an instruction, one after the other, of which all or none are noted.
constexpr int TOGETHER = 64;

// Volatile: the compiler adds the readers of these after it has removed writes that nobody reads.
static volatile int64_t task, lane, loop;
static volatile bool noted;
static uint64_t* events;  // two words each: warp, site, how often before, lane; address, bytes, kind of access
static int64_t capacity, used, exchanges, tasks_of_block, tasks_of_warp, apart, thinned;
static bool whole;  // whether threads that are not noted run
static const Range* ranges;
static int range_count;
static Site sites[SITES];

/// Whether a block of threads is noted: about every `apart`th, by multiples of the golden ratio, which lie evenly and
/// have no period in common with the rows of a volume.
inline bool is_noted(int64_t block) { return apart > 0 && (uint32_t)block * 2654435769u <= 0xffffffffu / apart; }

/// Begin a thread; return whether it is to run.
inline bool enter(int64_t number) {
    task = number;
    noted = is_noted(number / tasks_of_block);
    lane = number % tasks_of_warp;
    return noted || whole;
}

/// Go on with a lane of a loop over the lanes of a warp.
inline void begin_lane(int64_t number) {
    lane = number;
    if (number == 0) loop = loop + 1;
}

inline int64_t exchange(int64_t count) { return exchanges += noted && lane == 0 ? count : 0; }

__attribute__((always_inline, no_sanitize("coverage"))) inline void note(uint64_t at, int bytes, int kind, void* by) {
    if (!noted) return;
    const Range* range = ranges;
    while (range < ranges + range_count && (at < range->begin || at >= range->end)) ++range;
    if (range == ranges + range_count) return;  // the thread's own memory, or the arguments
    int number = (int)((uint64_t)by * 0x9e3779b97f4a7c15ull >> 52);
    while (sites[number].address && sites[number].address != by) number = (number + 1) % SITES;
    Site& site = sites[number];
    const int64_t warp = task / tasks_of_warp;
    if (!site.address || site.warp != warp || site.loop != loop) {
        int most = 0;
        for (int k = 0; k < 32; ++k)
            if (site.warp == warp && site.times[k] > most) most = site.times[k];
        for (int k = 0; k < 32; ++k) site.times[k] = most;
        site.address = by, site.warp = warp, site.loop = loop;
    }
    const int time = site.times[lane]++;
    if (time / TOGETHER % thinned) return;
    if (used < capacity) {
        events[2 * used] =
            (uint64_t)warp << 40 | (uint64_t)number << 28 | (uint64_t)(time & 0xfffff) << 8 | (uint64_t)lane;
        events[2 * used + 1] = (range->place + (at - range->begin)) << 8 | (uint64_t)bytes << 2 | kind;
    }
    ++used;
}

}  // namespace traced

#define LFPIV_HOOK(bytes)                                                                                             \
    void __sanitizer_cov_load##bytes(void* at) { traced::note((uint64_t)at, bytes, 0, __builtin_return_address(0)); } \
    void __sanitizer_cov_store##bytes(void* at) { traced::note((uint64_t)at, bytes, 1, __builtin_return_address(0)); }
extern "C" {
LFPIV_HOOK(1) LFPIV_HOOK(2) LFPIV_HOOK(4) LFPIV_HOOK(8) LFPIV_HOOK(16)
}

// Warp's names for the number of the thread.
#undef builtin_tid1d
#undef builtin_tid2d
#undef builtin_tid3d
#undef builtin_tid4d
#define LFPIV_TID(call)                         \
    ({                                          \
        if (!traced::enter(task_index)) return; \
        call;                                   \
    })
#define builtin_tid1d() LFPIV_TID(wp::linear_tid<wp_linear_tid>(task_index, dim))
#define builtin_tid2d(x, y) LFPIV_TID(wp::tid(x, y, task_index, dim))
#define builtin_tid3d(x, y, z) LFPIV_TID(wp::tid(x, y, z, task_index, dim))
#define builtin_tid4d(x, y, z, w) LFPIV_TID(wp::tid(x, y, z, w, task_index, dim))

#endif
