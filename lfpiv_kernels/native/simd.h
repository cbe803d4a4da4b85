// Vectors of floats with one syntax for both processors: on the CPU a vector of the compiler, as wide as the registers;
// on a GPU a plain float, because there each lane is a thread of its own.
#ifndef LFPIV_SIMD_H
#define LFPIV_SIMD_H

#if !defined(WP_NO_CRT)  // inside a Warp module, Warp's own headers declare what these do
#include <math.h>
#include <stdint.h>
#endif

#if defined(__CUDACC__)
#define LFPIV_INLINE __host__ __device__ __forceinline__
#else
#define LFPIV_INLINE inline __attribute__((always_inline))
#endif

/// Whether loops are written for a GPU: a thread per lane. Tests compile them for the processor as well.
#if defined(__CUDA_ARCH__) || defined(LFPIV_EMULATE_GPU)
#define LFPIV_GPU 1
#else
#define LFPIV_GPU 0
#endif

namespace lfpiv {

#if LFPIV_GPU

/// Lanes of a vector `V`.
constexpr int WIDTH = 1;

/// `N` floats with the arithmetic of a vector, for the few places where a GPU thread works on several values.
template <int N>
struct FloatArray {
    float x[N];

    LFPIV_INLINE float operator[](int k) const { return x[k]; }
    LFPIV_INLINE FloatArray operator+(const FloatArray& other) const {
        FloatArray sum;
        for (int k = 0; k < N; ++k) sum.x[k] = x[k] + other.x[k];
        return sum;
    }
    LFPIV_INLINE FloatArray operator*(const FloatArray& other) const {
        FloatArray product;
        for (int k = 0; k < N; ++k) product.x[k] = x[k] * other.x[k];
        return product;
    }
};

template <int N>
struct LanesOf {
    using Floats = FloatArray<N>;
};
template <>
struct LanesOf<1> {
    using Floats = float;
    using Ints = int;
};

#else

#if defined(__AVX512F__)
constexpr int WIDTH = 16;
#else
constexpr int WIDTH = 8;
#endif

template <int N>
struct LanesOf {
    typedef float Floats __attribute__((vector_size(4 * N)));
    typedef int Ints __attribute__((vector_size(4 * N)));
    typedef float FloatsAnywhere __attribute__((vector_size(4 * N), aligned(4)));
    typedef unsigned char Bytes __attribute__((vector_size(N), aligned(1)));
};

#endif

template <int N>
using Floats = typename LanesOf<N>::Floats;
template <int N>
using Ints = typename LanesOf<N>::Ints;

/// One float per lane.
using V = Floats<WIDTH>;
/// One integer per lane. A comparison of two `V` gives one that is not 0 where it holds.
using M = Ints<WIDTH>;

/// Return the smaller value, lane by lane.
template <class T>
LFPIV_INLINE T min(T a, T b) {
    return a < b ? a : b;
}
/// Return the larger value, lane by lane.
template <class T>
LFPIV_INLINE T max(T a, T b) {
    return a > b ? a : b;
}

#if LFPIV_GPU

LFPIV_INLINE float abs(float x) { return fabsf(x); }
LFPIV_INLINE float sqrt(float x) { return sqrtf(x); }
LFPIV_INLINE float floor(float x) { return floorf(x); }
LFPIV_INLINE float ceil(float x) { return ceilf(x); }

/// Return whether any lane of a mask is set.
LFPIV_INLINE bool any(int mask) { return mask != 0; }
/// Return one lane.
LFPIV_INLINE float lane(float x, int) { return x; }
LFPIV_INLINE int lane(int x, int) { return x; }
/// Write one lane.
LFPIV_INLINE void set_lane(float& x, int, float value) { x = value; }
LFPIV_INLINE void set_lane(int& x, int, int value) { x = value; }

/// Return a vector of equal lanes.
template <int N = WIDTH>
LFPIV_INLINE Floats<N> splat(float x) {
    FloatArray<N> lanes;
    for (int k = 0; k < N; ++k) lanes.x[k] = x;
    return lanes;
}
template <>
LFPIV_INLINE float splat<1>(float x) {
    return x;
}

/// Read `N` floats.
template <int N = WIDTH>
LFPIV_INLINE Floats<N> load(const float* from) {
    FloatArray<N> lanes;
    for (int k = 0; k < N; ++k) lanes.x[k] = from[k];
    return lanes;
}
template <>
LFPIV_INLINE float load<1>(const float* from) {
    return *from;
}

/// Read `N` bytes as floats.
template <int N = WIDTH>
LFPIV_INLINE Floats<N> load_bytes(const unsigned char* from) {
    FloatArray<N> lanes;
    for (int k = 0; k < N; ++k) lanes.x[k] = from[k];
    return lanes;
}

/// Write a vector.
LFPIV_INLINE void store(float* to, float x) { *to = x; }
/// Write a vector to an aligned place, past the caches.
LFPIV_INLINE void stream(float* to, float x) { *to = x; }
/// Write a vector as bytes, fractions cut off.
LFPIV_INLINE void store_bytes(unsigned char* to, float x) { *to = (unsigned char)x; }
/// Ask for the cache line of an address.
LFPIV_INLINE void prefetch(const float*) {}

/// Return a vector with zeros from lane `count` on.
template <int N>
LFPIV_INLINE FloatArray<N> first_lanes(FloatArray<N> x, int count) {
    for (int k = count; k < N; ++k) x.x[k] = 0.0f;
    return x;
}

#else

template <class T>
LFPIV_INLINE T abs(T x) {
    return __builtin_elementwise_abs(x);
}
template <class T>
LFPIV_INLINE T sqrt(T x) {
    return __builtin_elementwise_sqrt(x);
}
template <class T>
LFPIV_INLINE T floor(T x) {
    return __builtin_elementwise_floor(x);
}
template <class T>
LFPIV_INLINE T ceil(T x) {
    return __builtin_elementwise_ceil(x);
}

template <class T>
LFPIV_INLINE bool any(T mask) {
    return __builtin_reduce_or(mask) != 0;
}
template <class T>
LFPIV_INLINE auto lane(T x, int k) {
    return x[k];
}
template <class T, class Value>
LFPIV_INLINE void set_lane(T& x, int k, Value value) {
    x[k] = value;
}

template <int N = WIDTH>
LFPIV_INLINE Floats<N> splat(float x) {
    return Floats<N>{} + x;
}
template <int N = WIDTH>
LFPIV_INLINE Floats<N> load(const float* from) {
    return *(const typename LanesOf<N>::FloatsAnywhere*)from;
}
template <int N = WIDTH>
LFPIV_INLINE Floats<N> load_bytes(const unsigned char* from) {
    return __builtin_convertvector(*(const typename LanesOf<N>::Bytes*)from, Floats<N>);
}
template <class T>
LFPIV_INLINE void store(float* to, T x) {
    *(typename LanesOf<sizeof(T) / 4>::FloatsAnywhere*)to = x;
}
template <class T>
LFPIV_INLINE void stream(float* to, T x) {
    __builtin_nontemporal_store(x, (T*)to);
}
template <class T>
LFPIV_INLINE void store_bytes(unsigned char* to, T x) {
    using Lanes = LanesOf<sizeof(T) / 4>;
    *(typename Lanes::Bytes*)to =
        __builtin_convertvector(__builtin_convertvector(x, typename Lanes::Ints), typename Lanes::Bytes);
}
LFPIV_INLINE void prefetch(const float* from) { __builtin_prefetch(from); }

template <class T>
LFPIV_INLINE T first_lanes(T x, int count) {
    typename LanesOf<sizeof(T) / 4>::Ints index;
    for (unsigned k = 0; k < sizeof(T) / 4; ++k) index[k] = (int)k;
    return index < count ? x : T{};
}

#endif

/// Return the sum of 8 lanes, added in pairs.
LFPIV_INLINE float sum(Floats<8> x) { return ((x[0] + x[4]) + (x[1] + x[5])) + ((x[2] + x[6]) + (x[3] + x[7])); }

}  // namespace lfpiv

#endif
