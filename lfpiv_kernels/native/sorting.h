// Medians by sorting networks, of floats or of vectors of floats.
#ifndef LFPIV_SORTING_H
#define LFPIV_SORTING_H

#include "simd.h"

namespace lfpiv {

/// Comparisons that sort SIZE values: Batcher's odd-even merge network, the same steps for any values.
template <int SIZE>
struct SortingNetwork {
    static constexpr int MOST = SIZE * SIZE;
    short low[MOST] = {}, high[MOST] = {};
    int steps = 0;

    constexpr SortingNetwork() {
        for (int merged = 1; merged < SIZE; merged *= 2)
            for (int distance = merged; distance > 0; distance /= 2)
                for (int start = distance % merged; start < SIZE - distance; start += 2 * distance)
                    for (int k = start; k < start + distance && k < SIZE - distance; ++k)
                        if (k / (2 * merged) == (k + distance) / (2 * merged)) {
                            low[steps] = (short)k;
                            high[steps++] = (short)(k + distance);
                        }
    }
};

template <int SIZE>
inline constexpr SortingNetwork<SIZE> NETWORK{};

/// Apply the steps BEGIN to END - 1 of the network.
template <int SIZE, int BEGIN, int END, class T>
LFPIV_INLINE void apply_steps(T* v) {
    if constexpr (END - BEGIN == 1) {
        constexpr int low = NETWORK<SIZE>.low[BEGIN], high = NETWORK<SIZE>.high[BEGIN];
        const T smaller = min(v[low], v[high]);
        v[high] = v[low] < v[high] ? v[high] : v[low];
        v[low] = smaller;
    } else {
        constexpr int middle = (BEGIN + END) / 2;
        apply_steps<SIZE, BEGIN, middle>(v);
        apply_steps<SIZE, middle, END>(v);
    }
}

/// Sort SIZE values in place.
template <int SIZE, class T>
LFPIV_INLINE void sort(T* v) {
    apply_steps<SIZE, 0, NETWORK<SIZE>.steps>(v);
}

/// Return the median of the first `count` of SIZE sorted values.
template <int SIZE, class T, class Count>
LFPIV_INLINE T median(const T* v, Count count) {
    T low = v[0], high = v[0];
    for (int i = 1; i <= SIZE / 2; ++i) {
        low = (count - 1) / 2 == i ? v[i] : low;
        high = count / 2 == i ? v[i] : high;
    }
    return 0.5f * (low + high);
}

/// Median of values, and the median distance of the values from it.
template <class T>
struct Robust {
    T median, scatter;
};

/// Return median and scatter of `count` values; the others are infinite. Overwrites the values.
template <class T, class Count>
LFPIV_INLINE Robust<T> robust(T (&v)[26], Count count) {
    Robust<T> found;
    sort<26>(v);
    found.median = median<26>(v, count);
    for (T& value : v) {
        const T distance = value - found.median;
        value = distance < 0.0f ? -distance : distance;
    }
    sort<26>(v);
    found.scatter = median<26>(v, count);
    return found;
}

}  // namespace lfpiv

#endif
