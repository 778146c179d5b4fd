/* Takes: readings of both monitors and their plain model. Gives: sums over what it leaves. */
#include "residual.h"

#include <math.h>
#include <string.h>

#define LANES 16
#define STRIP 512 /* samples at a time: both residuals stay in the first cache */

typedef struct {
    float square, next, third_cos, third_sin, most;
} strip_sums;

static float add_lanes(const float *x)
{
    float sum = 0.0f;
    size_t j;
    for (j = 0; j < LANES; ++j) {
        sum += x[j];
    }
    return sum;
}

/* x less carrier, level and slope. */
HS_CLONES static void leave(const float *x, const float *cosine, const float *sine, size_t n,
                            float a, float b, float level, float slope, float *out)
{
    size_t k;
    for (k = 0; k < n; ++k) {
        out[k] = x[k] - (a * cosine[k] + b * sine[k]) - (level + slope * (float)(int)k);
    }
}

/* r: n residuals, and one more for the product with the next. */
HS_CLONES static void sum_strip(const float *r, const float *cosine3, const float *sine3, size_t n,
                                strip_sums *out)
{
    float q[LANES] = {0}, p[LANES] = {0}, c[LANES] = {0}, s[LANES] = {0}, m[LANES] = {0};
    size_t k, j;
    for (k = 0; k + LANES <= n; k += LANES) {
        for (j = 0; j < LANES; ++j) {
            const float d = r[k + j], size = fabsf(d);
            q[j] += d * d;
            p[j] += d * r[k + j + 1];
            c[j] += d * cosine3[k + j];
            s[j] += d * sine3[k + j];
            m[j] = size > m[j] ? size : m[j];
        }
    }
    out->square = add_lanes(q);
    out->next = add_lanes(p);
    out->third_cos = add_lanes(c);
    out->third_sin = add_lanes(s);
    out->most = 0.0f;
    for (j = 0; j < LANES; ++j) {
        out->most = m[j] > out->most ? m[j] : out->most;
    }
    for (; k < n; ++k) {
        out->square += r[k] * r[k];
        out->next += r[k] * r[k + 1];
        out->third_cos += r[k] * cosine3[k];
        out->third_sin += r[k] * sine3[k];
        out->most = fabsf(r[k]) > out->most ? fabsf(r[k]) : out->most;
    }
}

HS_CLONES static float sum_cross(const float *x, const float *y, size_t n)
{
    float c[LANES] = {0}, sum;
    size_t k, j;
    for (k = 0; k + LANES <= n; k += LANES) {
        for (j = 0; j < LANES; ++j) {
            c[j] += x[k + j] * y[k + j];
        }
    }
    sum = add_lanes(c);
    for (; k < n; ++k) {
        sum += x[k] * y[k];
    }
    return sum;
}

/* The carrier's table a piece further on, the model's constants at sample `from` of piece p. */
static void leave_strip(const sense_plan *plan, const plain_model *model, size_t p, size_t from,
                        double after, const float *x, size_t n, float *out)
{
    const double size = (double)plan->samples, start = (double)(p * plan->piece + from);
    const double ahead = model->turn * ((double)p - 0.5 * (double)(plan->pieces - 1));
    const double c = model->turn == 0.0 ? 1.0 : cos(ahead), s = model->turn == 0.0 ? 0.0 : sin(ahead);
    const double turn_cos = plan->turn_cos[p] * c - plan->turn_sin[p] * s;
    const double turn_sin = plan->turn_sin[p] * c + plan->turn_cos[p] * s;
    const double a = model->a * turn_cos + model->b * turn_sin;
    const double b = model->b * turn_cos - model->a * turn_sin;
    const double level = model->level + after * model->step +
                         model->slope * (start - 0.5 * (size - 1.0)) / size;
    leave(x, plan->cosine + from, plan->sine + from, n, (float)a, (float)b, (float)level,
          (float)(model->slope / size), out);
}

void sum_residual(const sense_plan *plan, sense_type type, const void *v, const void *i,
                  size_t stride, const sense_choice *choice, const plain_model model[2],
                  residual *out)
{
    float readings[2][STRIP], rest[2][STRIP + 1];
    size_t p, j, from;

    memset(out, 0, sizeof *out);
    for (p = 0; p < plan->pieces; ++p) {
        /* cos and sin of three times the angle at which the piece begins */
        const double c = plan->turn_cos[p], s = plan->turn_sin[p];
        const double c3 = (4.0 * c * c - 3.0) * c, s3 = (3.0 - 4.0 * s * s) * s;
        if (choice->used[p] == 0.0) {
            continue;
        }
        for (from = 0; from < plan->piece; from += STRIP) {
            const size_t left = plan->piece - from, n = left < STRIP ? left : STRIP;
            const size_t at = p * plan->piece + from;
            load_readings(type, v, i, stride, at, n, readings[0], readings[1]);
            for (j = 0; j < 2; ++j) {
                strip_sums sums;
                leave_strip(plan, &model[j], p, from, choice->after[p], readings[j], n, rest[j]);
                rest[j][n] = 0.0f;
                sum_strip(rest[j], plan->cosine3 + from, plan->sine3 + from, n, &sums);
                out->square[j] += (double)sums.square;
                out->next[j] += (double)sums.next;
                out->third_re[j] += (double)sums.third_cos * c3 - (double)sums.third_sin * s3;
                out->third_im[j] -= (double)sums.third_cos * s3 + (double)sums.third_sin * c3;
                out->most[j] = (double)sums.most > out->most[j] ? (double)sums.most : out->most[j];
            }
            out->cross += (double)sum_cross(rest[0], rest[1], n);
            out->samples += (double)n;
        }
    }
    for (j = 0; j < 2 && out->samples > 0.0; ++j) {
        out->third_re[j] *= 2.0 / out->samples;
        out->third_im[j] *= 2.0 / out->samples;
    }
}
