/* Takes: readings of both monitors and their plain model. Gives: sums over what it leaves. */
#include "sensing/residual.h"

#include <math.h>
#include <string.h>

#define STRIP 512 /* samples at a time: both residuals stay in the first cache */

typedef struct {
    float square, next, third_cos, third_sin, most;
} strip_sums;

/* Eight floats in a vector register, or in two: the compiler keeps sums of this type out of memory. */
#define LANES 8
typedef float lanes __attribute__((vector_size(4 * LANES)));
typedef int32_t bits __attribute__((vector_size(4 * LANES)));

#define LOAD(x, from) memcpy(&(x), (from), sizeof(x))

static float add_lanes(const lanes *x)
{
    float sum = 0.0f;
    size_t j;
    for (j = 0; j < LANES; ++j) {
        sum += (*x)[j];
    }
    return sum;
}

/* x less carrier, level and slope, and its sums. */
HS_CLONES static void sum_strip(const float *x, const float *cosine, const float *sine,
                                const float *cosine3, const float *sine3, size_t n, float a,
                                float b, float level, float slope, float *rest, strip_sums *out)
{
    /* Two sets of sums: an addition takes longer than the loop has to wait for one. */
    lanes q[2] = {{0}}, c[2] = {{0}}, s[2] = {{0}}, at = {0, 1, 2, 3, 4, 5, 6, 7}, size;
    bits most[2] = {{0}}, more;
    size_t k, j;
#define STEP(h)                                                                                    \
    do {                                                                                           \
        lanes d, wc, ws;                                                                           \
        bits here;                                                                                 \
        LOAD(d, x + k + LANES * h);                                                                \
        LOAD(wc, cosine + k + LANES * h);                                                          \
        LOAD(ws, sine + k + LANES * h);                                                            \
        d = d - (a * wc + b * ws) - (level + slope * at);                                          \
        memcpy(rest + k + LANES * h, &d, sizeof d);                                                \
        at += (float)LANES;                                                                        \
        LOAD(wc, cosine3 + k + LANES * h);                                                         \
        LOAD(ws, sine3 + k + LANES * h);                                                           \
        q[h] += d * d;                                                                             \
        c[h] += d * wc;                                                                            \
        s[h] += d * ws;                                                                            \
        here = (bits)d & 0x7fffffff; /* positive floats are in the order of their bits */          \
        more = here > most[h];                                                                     \
        most[h] = (here & more) | (most[h] & ~more);                                               \
    } while (0)
    for (k = 0; k + 2 * LANES <= n; k += 2 * LANES) {
        STEP(0);
        STEP(1);
    }
    q[0] += q[1];
    c[0] += c[1];
    s[0] += s[1];
    more = most[1] > most[0];
    most[0] = (most[1] & more) | (most[0] & ~more);
    out->square = add_lanes(&q[0]);
    out->third_cos = add_lanes(&c[0]);
    out->third_sin = add_lanes(&s[0]);
    out->most = 0.0f;
    size = (lanes)most[0];
    for (j = 0; j < LANES; ++j) {
        out->most = size[j] > out->most ? size[j] : out->most;
    }
    for (; k < n; ++k) {
        const float d = x[k] - (a * cosine[k] + b * sine[k]) - (level + slope * (float)(int)k);
        rest[k] = d;
        out->square += d * d;
        out->third_cos += d * cosine3[k];
        out->third_sin += d * sine3[k];
        out->most = fabsf(d) > out->most ? fabsf(d) : out->most;
    }
}

/* Products of both residuals with the next ones, and with each other; one more reading lies behind. */
HS_CLONES static float sum_products(const float *v, const float *i, size_t n, float *next_v,
                                    float *next_i)
{
    lanes p = {0}, q = {0}, c = {0};
    float sum;
    size_t k;
    for (k = 0; k + LANES <= n; k += LANES) {
        lanes x, y, after;
        LOAD(x, v + k);
        LOAD(y, i + k);
        c += x * y;
        LOAD(after, v + k + 1);
        p += x * after;
        LOAD(after, i + k + 1);
        q += y * after;
    }
    sum = add_lanes(&c);
    *next_v = add_lanes(&p);
    *next_i = add_lanes(&q);
    for (; k < n; ++k) {
        sum += v[k] * i[k];
        *next_v += v[k] * v[k + 1];
        *next_i += i[k] * i[k + 1];
    }
    return sum;
}

/* The carrier's table for segment p, and the model's constants at its sample `from`. */
static void leave_strip(const sense_plan *plan, const sense_model *model, size_t p, size_t from,
                        double after, const float *x, size_t n, float *rest, strip_sums *out)
{
    const double size = (double)plan->samples, start = (double)(p * plan->segment + from);
    const double ahead = model->turn * ((double)p - 0.5 * (double)(plan->segments - 1));
    const double c = model->turn == 0.0 ? 1.0 : cos(ahead), s = model->turn == 0.0 ? 0.0 : sin(ahead);
    const double turn_cos = plan->turn_cos[p] * c - plan->turn_sin[p] * s;
    const double turn_sin = plan->turn_sin[p] * c + plan->turn_cos[p] * s;
    const double a = model->a * turn_cos + model->b * turn_sin;
    const double b = model->b * turn_cos - model->a * turn_sin;
    const double level = model->level + after * model->step +
                         model->slope * (start - 0.5 * (size - 1.0)) / size;
    sum_strip(x, plan->cosine + from, plan->sine + from, plan->cosine3 + from,
              plan->sine3 + from, n, (float)a, (float)b, (float)level,
              (float)(model->slope / size), rest, out);
    rest[n] = 0.0f;
}

void sense_sum_residual(const sense_plan *plan, sense_type type, const void *v, const void *i,
                        size_t stride, const sense_choice *choice, const sense_model model[2],
                        sense_residual *out)
{
    float readings[2][STRIP], rest[2][STRIP + 1];
    strip_sums sums[2];
    size_t p, j, from;

    memset(out, 0, sizeof *out);
    for (p = 0; p < plan->segments; ++p) {
        /* cos and sin of three times the angle at which the segment begins */
        const double c = plan->turn_cos[p], s = plan->turn_sin[p];
        const double c3 = (4.0 * c * c - 3.0) * c, s3 = (3.0 - 4.0 * s * s) * s;
        if (choice->used[p] == 0.0) {
            continue;
        }
        for (from = 0; from < plan->segment; from += STRIP) {
            const size_t left = plan->segment - from, n = left < STRIP ? left : STRIP;
            const size_t at = p * plan->segment + from;
            sense_load(type, v, i, stride, at, n, readings[0], readings[1]);
            for (j = 0; j < 2; ++j) {
                leave_strip(plan, &model[j], p, from, choice->after[p], readings[j], n, rest[j],
                            &sums[j]);
            }
            out->cross += (double)sum_products(rest[0], rest[1], n, &sums[0].next, &sums[1].next);
            for (j = 0; j < 2; ++j) {
                out->square[j] += (double)sums[j].square;
                out->next[j] += (double)sums[j].next;
                out->third_re[j] += (double)sums[j].third_cos * c3 - (double)sums[j].third_sin * s3;
                out->third_im[j] -= (double)sums[j].third_cos * s3 + (double)sums[j].third_sin * c3;
                out->most[j] =
                    (double)sums[j].most > out->most[j] ? (double)sums[j].most : out->most[j];
            }
            out->samples += (double)n;
        }
    }
    for (j = 0; j < 2 && out->samples > 0.0; ++j) {
        out->third_re[j] *= 2.0 / out->samples;
        out->third_im[j] *= 2.0 / out->samples;
    }
}
