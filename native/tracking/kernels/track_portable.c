/* The kernels for any machine; the others give the same bits. */
#include "tracking/kernels/track_kernels.h"

/* (a * b) / 2^15, rounded; pmulhrsw of the other kernels. */
#define SCALED(a, b) ((int16_t)((((((int32_t)(a)) * (b)) >> 14) + 1) >> 1))

/* out = middle + (before + after) * factor / 2^15 */
static void tap_scaled(const int16_t *before, const int16_t *middle, const int16_t *after,
                       int factor, int16_t *restrict out)
{
    for (int i = 0; i < 32; ++i) {
        out[i] = (int16_t)(middle[i] + SCALED(before[i] + after[i], factor));
    }
}

/* out = 4 middle - (before + after) */
static void tap_widening(const int16_t *before, const int16_t *middle, const int16_t *after,
                         int16_t *restrict out)
{
    for (int i = 0; i < 32; ++i) {
        out[i] = (int16_t)(4 * middle[i] - (before[i] + after[i]));
    }
}

/* tap_widening of 32 bytes from `in` on, as pixels of 10 bits less 512. */
static void tap_bytes(const unsigned char *in, int16_t *restrict out)
{
    for (int i = 0; i < 32; ++i) {
        out[i] = (int16_t)(16 * in[i + 1] - 4 * (in[i] + in[i + 2]) - 1024);
    }
}

enum { ROW_COLUMNS = 0 };
static void filter_row(const unsigned char *in, int16_t *out) { (void)in, (void)out; }

#define WIDTH 4
#include "tracking/kernels/track_body.h" /* filter, widen, sums */

/* Weights of the cubic B-spline along x, in 1 / 32768. */
static void weights_along(int t, int32_t *restrict w)
{
    const int s = 32767 - t;
    const int t2 = SCALED(t, t), t3 = SCALED(t2, t), s2 = SCALED(s, s), s3 = SCALED(s2, s);
    w[0] = SCALED(s3, 5461);
    w[1] = 21845 - t2 + (t3 >> 1);
    w[2] = 21845 - s2 + (s3 >> 1);
    w[3] = SCALED(t3, 5461);
}

static void weights_down(float t, float *restrict v)
{
    const float s = 1.0f - t, t2 = t * t, s2 = s * s;
    v[0] = s2 * s * (1.0f / 6.0f);
    v[1] = (2.0f / 3.0f) - t2 * (1.0f - 0.5f * t);
    v[2] = (2.0f / 3.0f) - s2 * (1.0f - 0.5f * s);
    v[3] = t2 * t * (1.0f / 6.0f);
}

static void sample(const struct track_grid *g, float *restrict out)
{
    const int32_t one = 1 << TRACK_FRACTION_BITS;
    for (int j = 0; j < g->side; ++j) {
        for (int i = 0; i < g->side; ++i) {
            const int32_t x = g->x + j * g->down_x + i * g->along_x;
            const int32_t y = g->y + j * g->down_y + i * g->along_y;
            const int16_t *c = g->values + ((y >> TRACK_FRACTION_BITS) - 1) * (ptrdiff_t)g->pitch +
                               (x >> TRACK_FRACTION_BITS) - 1;
            int32_t w[4];
            float v[4], sum = 0.0f;
            weights_along((x >> (TRACK_FRACTION_BITS - 15)) & 32767, w);
            weights_down((float)(y & (one - 1)) * (1.0f / (float)one), v);
            for (int k = 0; k < 4; ++k, c += g->pitch) {
                const int32_t row = (c[0] * w[0] + c[1] * w[1]) + (c[2] * w[2] + c[3] * w[3]);
                sum += (float)row * v[k];
            }
            out[j * g->side + i] = sum * g->scale;
        }
    }
    for (int n = g->side * g->side; n < g->stride; ++n) {
        out[n] = 0.0f;
    }
}

const struct track_kernels track_portable = {"portable", filter, filter_bytes, widen, sample, sums};
