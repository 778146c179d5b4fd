/* The kernels with AVX2: one 64-bit load takes the four taps of a row. */
#include "tracking/kernels/track_kernels.h"

#include <immintrin.h>

static inline __m256i load(const int16_t *at)
{
    return _mm256_loadu_si256((const __m256i *)(const void *)at);
}

/* out = middle + (before + after) * factor / 2^15 */
static inline void tap_scaled(const int16_t *before, const int16_t *middle, const int16_t *after,
                              int factor, int16_t *out)
{
    const __m256i share = _mm256_set1_epi16((short)factor);
    for (int i = 0; i < 32; i += 16) {
        const __m256i both = _mm256_add_epi16(load(before + i), load(after + i));
        const __m256i sum = _mm256_add_epi16(_mm256_mulhrs_epi16(both, share), load(middle + i));
        _mm256_storeu_si256((__m256i *)(void *)(out + i), sum);
    }
}

/* out = 4 middle - (before + after) */
static inline void tap_widening(const int16_t *before, const int16_t *middle,
                                const int16_t *after, int16_t *out)
{
    for (int i = 0; i < 32; i += 16) {
        const __m256i both = _mm256_add_epi16(load(before + i), load(after + i));
        const __m256i four = _mm256_slli_epi16(load(middle + i), 2);
        _mm256_storeu_si256((__m256i *)(void *)(out + i), _mm256_sub_epi16(four, both));
    }
}

/* tap_widening of 32 bytes from `in` on, as pixels of 10 bits less 512. */
static inline void tap_bytes(const unsigned char *in, int16_t *out)
{
    for (int i = 0; i < 32; i += 16) {
        __m256i p[3];
        for (int k = 0; k < 3; ++k) {
            p[k] = _mm256_cvtepu8_epi16(
                _mm_loadu_si128((const __m128i *)(const void *)(in + i + k)));
        }
        const __m256i both = _mm256_add_epi16(p[0], p[2]);
        const __m256i four = _mm256_sub_epi16(_mm256_slli_epi16(p[1], 2), both);
        const __m256i sum =
            _mm256_sub_epi16(_mm256_slli_epi16(four, 2), _mm256_set1_epi16(1024));
        _mm256_storeu_si256((__m256i *)(void *)(out + i), sum);
    }
}

enum { ROW_COLUMNS = 0 };
static void filter_row(const unsigned char *in, int16_t *out) { (void)in, (void)out; }

#define WIDTH 8
#include "tracking/kernels/track_body.h" /* filter, widen, sums */

enum { FRACTION = TRACK_FRACTION_BITS };

static int least(int a, int b) { return a < b ? a : b; }

/* Four coefficients from each of four places. Loads, as a gather costs several times as much on
 * processors whose microcode mends its leaks. */
static __m256i four_places(const int16_t *row, const int32_t *at)
{
    __m128d a = _mm_load_sd((const double *)(const void *)(row + at[0]));
    __m128d b = _mm_load_sd((const double *)(const void *)(row + at[2]));
    a = _mm_loadh_pd(a, (const double *)(const void *)(row + at[1]));
    b = _mm_loadh_pd(b, (const double *)(const void *)(row + at[3]));
    return _mm256_inserti128_si256(_mm256_castsi128_si256(_mm_castpd_si128(a)),
                                   _mm_castpd_si128(b), 1);
}

/* Sums of four products of 16 bits, for eight samples of which `low` and `high` hold four each. */
static __m256i four_taps(const int16_t *row, const int32_t *at, __m256i low, __m256i high)
{
    const __m256i first = four_places(row, at), second = four_places(row, at + 4);
    const __m256i sums =
        _mm256_hadd_epi32(_mm256_madd_epi16(first, low), _mm256_madd_epi16(second, high));
    return _mm256_permute4x64_epi64(sums, 0xD8);
}

/* Up to 8 samples of one row from (x, y) on; those after `count` repeat the last. */
static void sample_block(const struct track_grid *g, int32_t x, int32_t y, int count, float *out)
{
    const __m256i lane = _mm256_min_epi32(_mm256_set_epi32(7, 6, 5, 4, 3, 2, 1, 0),
                                          _mm256_set1_epi32(count - 1));
    const __m256i xs = _mm256_add_epi32(
        _mm256_set1_epi32(x), _mm256_mullo_epi32(lane, _mm256_set1_epi32(g->along_x)));
    const __m256i ys = _mm256_add_epi32(
        _mm256_set1_epi32(y), _mm256_mullo_epi32(lane, _mm256_set1_epi32(g->along_y)));
    const __m256i at =
        _mm256_add_epi32(_mm256_srai_epi32(xs, FRACTION),
                         _mm256_mullo_epi32(_mm256_srai_epi32(ys, FRACTION),
                                            _mm256_set1_epi32(g->pitch)));

    const __m256i t =
        _mm256_and_si256(_mm256_srai_epi32(xs, FRACTION - 15), _mm256_set1_epi32(32767));
    const __m256i z = _mm256_add_epi32(_mm256_slli_epi32(t, 16),
                                       _mm256_sub_epi32(_mm256_set1_epi32(32767), t));
    const __m256i z2 = _mm256_mulhrs_epi16(z, z), z3 = _mm256_mulhrs_epi16(z2, z);
    const __m256i outer = _mm256_mulhrs_epi16(z3, _mm256_set1_epi16(5461));
    const __m256i inner = _mm256_add_epi16(_mm256_sub_epi16(_mm256_set1_epi16(21845), z2),
                                           _mm256_srai_epi16(z3, 1));
    const __m256i weight_a = _mm256_blend_epi16(outer, inner, 0xAA);
    const __m256i weight_b = _mm256_blend_epi16(inner, outer, 0xAA);
    const __m256i even = _mm256_unpacklo_epi32(weight_a, weight_b); /* samples 0 1 4 5 */
    const __m256i odd = _mm256_unpackhi_epi32(weight_a, weight_b);  /* samples 2 3 6 7 */
    const __m256i low = _mm256_permute2x128_si256(even, odd, 0x20);
    const __m256i high = _mm256_permute2x128_si256(even, odd, 0x31);

    const __m256 q = _mm256_mul_ps(
        _mm256_cvtepi32_ps(_mm256_and_si256(ys, _mm256_set1_epi32((1 << FRACTION) - 1))),
        _mm256_set1_ps(1.0f / (float)(1 << FRACTION)));
    const __m256 one = _mm256_set1_ps(1.0f), half = _mm256_set1_ps(0.5f);
    const __m256 sixth = _mm256_set1_ps(1.0f / 6.0f), middle = _mm256_set1_ps(2.0f / 3.0f);
    const __m256 p = _mm256_sub_ps(one, q);
    const __m256 q2 = _mm256_mul_ps(q, q), p2 = _mm256_mul_ps(p, p);
    const __m256 v[4] = {
        _mm256_mul_ps(_mm256_mul_ps(p2, p), sixth),
        _mm256_sub_ps(middle, _mm256_mul_ps(q2, _mm256_sub_ps(one, _mm256_mul_ps(half, q)))),
        _mm256_sub_ps(middle, _mm256_mul_ps(p2, _mm256_sub_ps(one, _mm256_mul_ps(half, p)))),
        _mm256_mul_ps(_mm256_mul_ps(q2, q), sixth)};
    const int16_t *row = g->values - g->pitch - 1;
    int32_t places[8];
    _mm256_storeu_si256((__m256i *)(void *)places, at);
    __m256 sum = _mm256_setzero_ps();
    for (int k = 0; k < 4; ++k, row += g->pitch) {
        const __m256 value = _mm256_cvtepi32_ps(four_taps(row, places, low, high));
        sum = _mm256_add_ps(sum, _mm256_mul_ps(value, v[k]));
    }
    _mm256_storeu_ps(out, _mm256_mul_ps(sum, _mm256_set1_ps(g->scale)));
}

static void sample(const struct track_grid *g, float *out)
{
    for (int j = 0; j < g->side; ++j) {
        for (int i = 0; i < g->side; i += 8) {
            sample_block(g, g->x + j * g->down_x + i * g->along_x,
                         g->y + j * g->down_y + i * g->along_y, least(8, g->side - i),
                         out + j * g->side + i);
        }
    }
    for (int n = g->side * g->side; n < g->stride; ++n) {
        out[n] = 0.0f;
    }
}

const struct track_kernels track_avx2 = {"avx2", filter, filter_bytes, widen, sample, sums};
