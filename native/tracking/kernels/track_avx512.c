/* The kernels with AVX-512 F, BW, DQ and VL. A row of 16 samples spans at most 32 coefficients, one
 * register: its taps are permutations, no gather. */
#include "tracking/kernels/track_kernels.h"

#include <immintrin.h>

/* out = middle + (before + after) * factor / 2^15 */
static inline void tap_scaled(const int16_t *before, const int16_t *middle, const int16_t *after,
                              int factor, int16_t *out)
{
    const __m512i both =
        _mm512_add_epi16(_mm512_loadu_si512(before), _mm512_loadu_si512(after));
    const __m512i part = _mm512_mulhrs_epi16(both, _mm512_set1_epi16((short)factor));
    _mm512_storeu_si512(out, _mm512_add_epi16(part, _mm512_loadu_si512(middle)));
}

/* out = 4 middle - (before + after) */
static inline void tap_widening(const int16_t *before, const int16_t *middle,
                                const int16_t *after, int16_t *out)
{
    const __m512i both =
        _mm512_add_epi16(_mm512_loadu_si512(before), _mm512_loadu_si512(after));
    const __m512i four = _mm512_slli_epi16(_mm512_loadu_si512(middle), 2);
    _mm512_storeu_si512(out, _mm512_sub_epi16(four, both));
}

/* tap_widening of 32 bytes from `in` on, as pixels of 10 bits less 512. */
static inline __m512i widened_bytes(const unsigned char *in)
{
    __m512i p[3];
    for (int k = 0; k < 3; ++k) {
        p[k] = _mm512_cvtepu8_epi16(_mm256_loadu_si256((const __m256i *)(const void *)(in + k)));
    }
    const __m512i four = _mm512_sub_epi16(_mm512_slli_epi16(p[1], 2), _mm512_add_epi16(p[0], p[2]));
    return _mm512_sub_epi16(_mm512_slli_epi16(four, 2), _mm512_set1_epi16(1024));
}

static inline void tap_bytes(const unsigned char *in, int16_t *out)
{
    _mm512_storeu_si512(out, widened_bytes(in));
}

/* All three factors along a row that fits one register: shifts in place of loads and stores. */
enum { ROW_COLUMNS = 20 };
static inline void filter_row(const unsigned char *in, int16_t *out)
{
    const __m512i a = widened_bytes(in);
    const __m512i a2 = _mm512_alignr_epi32(a, a, 1), a4 = _mm512_alignr_epi32(a, a, 2);
    const __m512i b = _mm512_add_epi16(
        a2, _mm512_mulhrs_epi16(_mm512_add_epi16(a, a4), _mm512_set1_epi16(2341)));
    const __m512i b4 = _mm512_alignr_epi32(b, b, 2), b8 = _mm512_alignr_epi32(b, b, 4);
    const __m512i c = _mm512_add_epi16(
        b4, _mm512_mulhrs_epi16(_mm512_add_epi16(b, b8), _mm512_set1_epi16(169)));
    _mm512_storeu_si512(out, c);
}

#define WIDTH 16
#include "tracking/kernels/track_body.h" /* filter, widen, sums */

enum { FRACTION = TRACK_FRACTION_BITS };

static int32_t least(int32_t a, int32_t b) { return a < b ? a : b; }
static int32_t most(int32_t a, int32_t b) { return a > b ? a : b; }

/* Up to 16 samples of one row from (x, y) on; `count` of them count. */
static void sample_block(const struct track_grid *g, int32_t x, int32_t y, int count,
                         __m512i along_x, __m512i along_y, float *out)
{
    const int32_t x_last = x + (count - 1) * g->along_x, y_last = y + (count - 1) * g->along_y;
    const int32_t base = (least(x, x_last) >> FRACTION) - 1;
    const int32_t top = least(y, y_last) >> FRACTION, bottom = most(y, y_last) >> FRACTION;
    const __m512i xs = _mm512_add_epi32(_mm512_set1_epi32(x), along_x);
    const __m512i ys = _mm512_add_epi32(_mm512_set1_epi32(y), along_y);

    /* pairs of taps in 32 bits: columns (0, 1) and (2, 3), weights along x in 1 / 32768 */
    const __m512i column =
        _mm512_sub_epi32(_mm512_srai_epi32(xs, FRACTION), _mm512_set1_epi32(base + 1));
    const __m512i pair_a = _mm512_add_epi32(_mm512_or_si512(column, _mm512_slli_epi32(column, 16)),
                                            _mm512_set1_epi32(0x10000));
    const __m512i pair_b = _mm512_add_epi32(pair_a, _mm512_set1_epi32(0x20002));
    const __m512i t =
        _mm512_and_si512(_mm512_srai_epi32(xs, FRACTION - 15), _mm512_set1_epi32(32767));
    const __m512i z = _mm512_add_epi32(_mm512_slli_epi32(t, 16),
                                       _mm512_sub_epi32(_mm512_set1_epi32(32767), t));
    const __m512i z2 = _mm512_mulhrs_epi16(z, z), z3 = _mm512_mulhrs_epi16(z2, z);
    const __m512i outer = _mm512_mulhrs_epi16(z3, _mm512_set1_epi16(5461));
    const __m512i inner = _mm512_add_epi16(_mm512_sub_epi16(_mm512_set1_epi16(21845), z2),
                                           _mm512_srai_epi16(z3, 1));
    const __m512i weight_a = _mm512_mask_blend_epi16(0xAAAAAAAAu, outer, inner);
    const __m512i weight_b = _mm512_mask_blend_epi16(0xAAAAAAAAu, inner, outer);

    /* weights along y */
    const __m512 q = _mm512_mul_ps(
        _mm512_cvtepi32_ps(_mm512_and_si512(ys, _mm512_set1_epi32((1 << FRACTION) - 1))),
        _mm512_set1_ps(1.0f / (float)(1 << FRACTION)));
    const __m512 one = _mm512_set1_ps(1.0f), half = _mm512_set1_ps(0.5f);
    const __m512 sixth = _mm512_set1_ps(1.0f / 6.0f), middle = _mm512_set1_ps(2.0f / 3.0f);
    const __m512 p = _mm512_sub_ps(one, q);
    const __m512 q2 = _mm512_mul_ps(q, q), p2 = _mm512_mul_ps(p, p);
    __m512 v[4];
    v[0] = _mm512_mul_ps(_mm512_mul_ps(p2, p), sixth);
    v[1] = _mm512_sub_ps(middle, _mm512_mul_ps(q2, _mm512_sub_ps(one, _mm512_mul_ps(half, q))));
    v[2] = _mm512_sub_ps(middle, _mm512_mul_ps(p2, _mm512_sub_ps(one, _mm512_mul_ps(half, p))));
    v[3] = _mm512_mul_ps(_mm512_mul_ps(q2, q), sixth);

    const int16_t *row = g->values + (top - 1) * (ptrdiff_t)g->pitch + base;
    __m512 sum = _mm512_setzero_ps();
#define ROW_VALUE()                                                                              \
    _mm512_cvtepi32_ps(_mm512_add_epi32(                                                         \
        _mm512_madd_epi16(_mm512_permutexvar_epi16(pair_a, _mm512_loadu_si512(row)), weight_a),  \
        _mm512_madd_epi16(_mm512_permutexvar_epi16(pair_b, _mm512_loadu_si512(row)), weight_b)))
    if (top == bottom) {
        for (int k = 0; k < 4; ++k, row += g->pitch) {
            sum = _mm512_add_ps(sum, _mm512_mul_ps(ROW_VALUE(), v[k]));
        }
    } else {
        const __m512i floor_y = _mm512_srai_epi32(ys, FRACTION);
        for (int r = top - 1; r <= bottom + 2; ++r, row += g->pitch) {
            const __m512 value = ROW_VALUE();
            for (int k = most(0, r + 1 - bottom); k <= least(3, r + 1 - top); ++k) {
                const __mmask16 here =
                    _mm512_cmpeq_epi32_mask(floor_y, _mm512_set1_epi32(r + 1 - k));
                sum = _mm512_mask_add_ps(sum, here, sum, _mm512_mul_ps(value, v[k]));
            }
        }
    }
#undef ROW_VALUE
    _mm512_storeu_ps(out, _mm512_mul_ps(sum, _mm512_set1_ps(g->scale)));
}

static void sample(const struct track_grid *g, float *out)
{
    const __m512i lane = _mm512_set_epi32(15, 14, 13, 12, 11, 10, 9, 8, 7, 6, 5, 4, 3, 2, 1, 0);
    const __m512i along_x = _mm512_mullo_epi32(lane, _mm512_set1_epi32(g->along_x));
    const __m512i along_y = _mm512_mullo_epi32(lane, _mm512_set1_epi32(g->along_y));
    for (int j = 0; j < g->side; ++j) {
        for (int i = 0; i < g->side; i += 16) {
            sample_block(g, g->x + j * g->down_x + i * g->along_x,
                         g->y + j * g->down_y + i * g->along_y, least(16, g->side - i), along_x,
                         along_y, out + j * g->side + i);
        }
    }
    for (int n = g->side * g->side; n < g->stride; ++n) {
        out[n] = 0.0f;
    }
}

const struct track_kernels track_avx512 = {"avx512", filter, filter_bytes, widen, sample, sums};
