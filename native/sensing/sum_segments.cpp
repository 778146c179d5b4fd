// Takes: what hs_sum_segments takes. Gives: the same bits, by the vector unit of this machine.
//
// core/hs_lockin.c is the reference, for the microcontroller and for every compiler; here its
// sixteen lanes are vectors (an extension of gcc and clang), which keeps them in registers.
#include "sensing/sum_segments.h"

#include <cstring>

#if defined(__GNUC__) && defined(__x86_64__)
#include <immintrin.h>

#define INLINE inline __attribute__((always_inline))

namespace {

constexpr size_t lanes = 16, rows = 5; // cosine, sine, level, ramp, square

// Sixteen lanes as vectors of W floats.
template <size_t W> struct Lanes {
    typedef float vector __attribute__((vector_size(4 * W)));
    static constexpr size_t count = lanes / W;
    vector part[count];

    INLINE void clear()
    {
        for (size_t h = 0; h < count; ++h) {
            part[h] = vector{};
        }
    }
};

// Lanes k, k + 4, k + 8 and k + 12 into lane k, halves first.
INLINE __m128 fold(const Lanes<4> &x)
{
    return (x.part[0] + x.part[2]) + (x.part[1] + x.part[3]);
}

INLINE __m128 fold(const Lanes<8> &x)
{
    const auto half = x.part[0] + x.part[1];
    return __builtin_shufflevector(half, half, 0, 1, 2, 3) +
           __builtin_shufflevector(half, half, 4, 5, 6, 7);
}

INLINE __m128 fold(const Lanes<16> &x)
{
    const auto all = x.part[0];
    const auto half = __builtin_shufflevector(all, all, 0, 1, 2, 3, 4, 5, 6, 7) +
                      __builtin_shufflevector(all, all, 8, 9, 10, 11, 12, 13, 14, 15);
    return __builtin_shufflevector(half, half, 0, 1, 2, 3) +
           __builtin_shufflevector(half, half, 4, 5, 6, 7);
}

template <size_t W>
INLINE void sum_segment(const float *x, const float *cosine, const float *sine, size_t n,
                      size_t ahead, __m128 kept[rows])
{
    using L = Lanes<W>;
    using V = typename L::vector;
    L c, s, l, t, q;
    const float first = x[0];
    size_t k;

    c.clear();
    s.clear();
    l.clear();
    t.clear();
    q.clear();
    for (k = 0; k + lanes <= n; k += lanes) {
        __builtin_prefetch(reinterpret_cast<const char *>(x + k) + ahead);
        for (size_t h = 0; h < L::count; ++h) {
            V d, wc, ws;
            std::memcpy(&d, x + k + W * h, sizeof d);
            std::memcpy(&wc, cosine + k + W * h, sizeof wc);
            std::memcpy(&ws, sine + k + W * h, sizeof ws);
            d -= first;
            c.part[h] += d * wc;
            s.part[h] += d * ws;
            l.part[h] += d;
            t.part[h] += l.part[h];
            q.part[h] += d * d;
        }
    }
    for (size_t h = 0; h < L::count; ++h) {
        V number;
        for (size_t j = 0; j < W; ++j) {
            number[j] = static_cast<float>(k + W * h + j);
        }
        t.part[h] = l.part[h] * number - t.part[h] * static_cast<float>(lanes);
    }
    kept[0] = fold(c);
    kept[1] = fold(s);
    kept[2] = fold(l);
    kept[3] = fold(t);
    kept[4] = fold(q);
    for (; k < n; ++k) {
        const float d = x[k] - first;
        const size_t j = k % 4;
        kept[0][j] += d * cosine[k];
        kept[1][j] += d * sine[k];
        kept[2][j] += d;
        kept[3][j] += d * static_cast<float>(k);
        kept[4][j] += d * d;
    }
}

template <size_t W>
INLINE void sum_all(const float *x, size_t n, const float *cosine, const float *sine, size_t segment,
                    size_t ahead, hs_sums *out)
{
    for (size_t from = 0; from < n; from += segment, ++out) {
        __m128 kept[rows];
        float fifth[4];
        sum_segment<W>(x + from, cosine, sine, n - from < segment ? n - from : segment, ahead,
                     kept);
        _MM_TRANSPOSE4_PS(kept[0], kept[1], kept[2], kept[3]);
        const __m128 four = (kept[0] + kept[2]) + (kept[1] + kept[3]);
        _mm_storeu_ps(fifth, kept[4]);
        out->first = x[from];
        out->cosine = four[0];
        out->sine = four[1];
        out->level = four[2];
        out->ramp = four[3];
        out->square = (fifth[0] + fifth[2]) + (fifth[1] + fifth[3]);
    }
}

__attribute__((target("avx512f"))) void by_512(const float *x, size_t n, const float *cosine,
                                               const float *sine, size_t segment, size_t ahead,
                                               hs_sums *out)
{
    sum_all<16>(x, n, cosine, sine, segment, ahead, out);
}

__attribute__((target("avx2"))) void by_256(const float *x, size_t n, const float *cosine,
                                            const float *sine, size_t segment, size_t ahead,
                                            hs_sums *out)
{
    sum_all<8>(x, n, cosine, sine, segment, ahead, out);
}

void by_128(const float *x, size_t n, const float *cosine, const float *sine, size_t segment,
            size_t ahead, hs_sums *out)
{
    sum_all<4>(x, n, cosine, sine, segment, ahead, out);
}

void by_core(const float *x, size_t n, const float *cosine, const float *sine, size_t segment,
             size_t, hs_sums *out)
{
    hs_sum_segments(x, static_cast<uint32_t>(n), cosine, sine, static_cast<uint16_t>(segment), out);
}

} // namespace

extern "C" int sum_segments_bits(int bits)
{
    __builtin_cpu_init();
    if (bits >= 512 && __builtin_cpu_supports("avx512f")) {
        return 512;
    }
    if (bits >= 256 && __builtin_cpu_supports("avx2")) {
        return 256;
    }
    return bits >= 128 ? 128 : 0;
}

extern "C" sum_segments_fn sum_segments_by(int bits)
{
    switch (sum_segments_bits(bits)) {
    case 512:
        return by_512;
    case 256:
        return by_256;
    case 128:
        return by_128;
    default:
        return by_core;
    }
}

#else

static void by_core(const float *x, size_t n, const float *cosine, const float *sine, size_t segment,
                    size_t ahead, hs_sums *out)
{
    hs_sum_segments(x, static_cast<uint32_t>(n), cosine, sine, static_cast<uint16_t>(segment), out);
}

extern "C" int sum_segments_bits(int) { return 0; }

extern "C" sum_segments_fn sum_segments_by(int) { return by_core; }

#endif
