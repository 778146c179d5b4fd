/* Takes: readings of both monitors. Gives: sums of their segments, and a fit of each segment. */
#include "sensing/segments.h"

#include <string.h>

#define LINE 64 /* bytes that memory gives at once */

/* ---- readings of any type as floats ------------------------------------------------------- */

#if defined(__GNUC__)
#define ASK_FOR(address) __builtin_prefetch(address)
#else
#define ASK_FOR(address) (void)(address)
#endif

#define STRIP 16 /* readings between two requests for memory `ahead` bytes further on */

#define DEFINE_LOAD(type, name)                                                                    \
    HS_CLONES static void load_pairs_of_##name(const type *restrict x, size_t n, size_t ahead,     \
                                               float *restrict v, float *restrict i)               \
    {                                                                                              \
        size_t k, j;                                                                               \
        for (k = 0; k + STRIP <= n; k += STRIP) {                                                  \
            const type *from = x + 2 * k;                                                          \
            for (j = 0; j < 2 * STRIP * sizeof(type); j += LINE) {                                 \
                ASK_FOR((const char *)from + ahead + j);                                           \
            }                                                                                      \
            for (j = 0; j < STRIP; ++j) {                                                          \
                v[k + j] = (float)from[2 * j];                                                     \
                i[k + j] = (float)from[2 * j + 1];                                                 \
            }                                                                                      \
        }                                                                                          \
        for (; k < n; ++k) {                                                                       \
            v[k] = (float)x[2 * k];                                                                \
            i[k] = (float)x[2 * k + 1];                                                            \
        }                                                                                          \
    }                                                                                              \
    HS_CLONES static void load_##name(const type *restrict x, size_t n, size_t ahead,              \
                                      float *restrict out)                                         \
    {                                                                                              \
        size_t k, j;                                                                               \
        for (k = 0; k + STRIP <= n; k += STRIP) {                                                  \
            for (j = 0; j < STRIP * sizeof(type); j += LINE) {                                     \
                ASK_FOR((const char *)(x + k) + ahead + j);                                        \
            }                                                                                      \
            for (j = 0; j < STRIP; ++j) {                                                          \
                out[k + j] = (float)x[k + j];                                                      \
            }                                                                                      \
        }                                                                                          \
        for (; k < n; ++k) {                                                                       \
            out[k] = (float)x[k];                                                                  \
        }                                                                                          \
    }

DEFINE_LOAD(int16_t, codes)
DEFINE_LOAD(float, floats)
DEFINE_LOAD(double, doubles)

static const void *later(sense_type type, const void *x, size_t samples)
{
    static const size_t size[] = {sizeof(int16_t), sizeof(float), sizeof(double)};
    return (const char *)x + size[type] * samples;
}

/* `n` readings of both channels. */
static void load(sense_type type, const void *v, const void *i, size_t stride, size_t n,
                 size_t ahead, float *out_v, float *out_i)
{
    if (stride == 2) { /* current follows voltage */
        if (type == SENSE_INT16) {
            load_pairs_of_codes(v, n, ahead, out_v, out_i);
        } else if (type == SENSE_FLOAT) {
            load_pairs_of_floats(v, n, ahead, out_v, out_i);
        } else {
            load_pairs_of_doubles(v, n, ahead, out_v, out_i);
        }
    } else if (type == SENSE_INT16) {
        load_codes(v, n, ahead, out_v);
        load_codes(i, n, ahead, out_i);
    } else if (type == SENSE_FLOAT) {
        load_floats(v, n, ahead, out_v);
        load_floats(i, n, ahead, out_i);
    } else {
        load_doubles(v, n, ahead, out_v);
        load_doubles(i, n, ahead, out_i);
    }
}

void sense_load(sense_type type, const void *v, const void *i, size_t stride, size_t at, size_t n,
                float *out_v, float *out_i)
{
    load(type, later(type, v, stride * at), later(type, i, stride * at), stride, n, 0, out_v,
         out_i);
}

/* Largest reading without its sign, as bits: those of positive floats are in the values' order. */
HS_CLONES static int32_t largest(const float *x, size_t n, int32_t most)
{
    size_t k;
    for (k = 0; k < n; ++k) {
        int32_t size;
        memcpy(&size, &x[k], sizeof size);
        size &= 0x7fffffff;
        most = size > most ? size : most;
    }
    return most;
}

/* ---- sums ---------------------------------------------------------------------------------- */

static void keep_all(const sense_plan *plan, const hs_sums *sums, sense_columns *all,
                     unsigned *reason)
{
    static const hs_sums none = {0.0f, 0.0f, 0.0f, 0.0f, 0.0f, 0.0f};
    const size_t segments = (plan->samples + plan->segment - 1) / plan->segment;
    size_t p;
    for (p = 0; p < plan->padded; ++p) {
        const hs_sums *one = p < segments ? &sums[p] : &none;
        all->first[p] = (double)one->first;
        all->cosine[p] = (double)one->cosine;
        all->sine[p] = (double)one->sine;
        all->level[p] = (double)one->level;
        all->ramp[p] = (double)one->ramp;
        all->square[p] = (double)one->square;
        *reason |= one->square <= HS_LARGEST ? 0u : HS_NOT_FINITE;
    }
}

HS_CLONES static void take_off(const sense_plan *plan, const sense_carrier *known, size_t p,
                               float *x, size_t n)
{
    const float a = (float)(known->a * plan->turn_cos[p] + known->b * plan->turn_sin[p]);
    const float b = (float)(known->b * plan->turn_cos[p] - known->a * plan->turn_sin[p]);
    size_t k;
    for (k = 0; k < n; ++k) {
        x[k] -= a * plan->cosine[k] + b * plan->sine[k];
    }
}

unsigned sense_sum_block(const sense_plan *plan, sense_type type, const void *v, const void *i,
                         size_t stride, size_t ahead, const sense_carrier *known, float *room,
                         sense_columns all[2])
{
    const int limited = plan->full_scale <= HS_LARGEST || plan->current_limit <= HS_LARGEST;
    const int as_they_are = type == SENSE_FLOAT && stride == 1 && known == NULL;
    float *rooms[2] = {room, room + plan->segment};
    hs_sums sums[2][SENSE_ALL];
    int32_t bits[2] = {0, 0};
    float most[2];
    unsigned reason = 0;
    size_t j, p, from;

    for (p = 0, from = 0; from < plan->samples; ++p, from += plan->segment) {
        const size_t left = plan->samples - from, n = left < plan->segment ? left : plan->segment;
        const void *at[2] = {later(type, v, stride * from), later(type, i, stride * from)};
        const float *x[2] = {rooms[0], rooms[1]};
        if (as_they_are) {
            x[0] = at[0];
            x[1] = at[1];
        } else {
            load(type, at[0], at[1], stride, n, ahead, rooms[0], rooms[1]);
        }
        for (j = 0; j < 2; ++j) {
            bits[j] = limited ? largest(x[j], n, bits[j]) : 0;
            if (known != NULL) {
                take_off(plan, &known[j], p, rooms[j], n);
            }
            plan->sum(x[j], n, plan->cosine, plan->sine, plan->segment, as_they_are ? ahead : 0,
                      &sums[j][p]);
        }
    }
    keep_all(plan, sums[0], &all[0], &reason);
    keep_all(plan, sums[1], &all[1], &reason);
    memcpy(most, bits, sizeof most);
    if (most[0] >= plan->full_scale || most[1] >= plan->full_scale) {
        reason |= HS_CLIPPED;
    }
    if (most[1] >= plan->current_limit) {
        reason |= HS_CURRENT_LIMIT;
    }
    return reason;
}

/* ---- each segment ---------------------------------------------------------------------------- */

HS_CLONES void sense_fit_segments(const sense_plan *plan, const sense_columns *x, sense_channel *out)
{
    const double m = (double)plan->segment, middle = 0.5 * (m - 1.0), first = x->first[plan->start];
    const double(*w)[4] = plan->local_inverse;
    size_t p;
    for (p = 0; p < plan->padded; ++p) {
        const double c = x->cosine[p], s = x->sine[p], l = x->level[p];
        const double u = (x->ramp[p] - middle * l) / m;
        const double a = w[0][0] * c + w[0][1] * s + w[0][2] * l + w[0][3] * u;
        const double b = w[1][0] * c + w[1][1] * s + w[1][2] * l + w[1][3] * u;
        const double h = w[2][0] * c + w[2][1] * s + w[2][2] * l + w[2][3] * u;
        const double g = w[3][0] * c + w[3][1] * s + w[3][2] * l + w[3][3] * u;
        out->a[p] = a;
        out->b[p] = b;
        out->height[p] = h + x->first[p] - first;
        out->rest[p] = x->square[p] - a * c - b * s - h * l - g * u;
    }
}

HS_CLONES void sense_turn_segments(const sense_plan *plan, const sense_columns *x, sense_channel *out)
{
    const double m = (double)plan->segment, n = (double)plan->samples, first = x->first[plan->start];
    const size_t rest = plan->samples - plan->segments * plan->segment;
    size_t p;
    for (p = 0; p < plan->padded; ++p) {
        const double size = p < plan->segments ? m : (double)rest;
        const double *table = plan->table[p < plan->segments ? 0 : 1];
        const double shift = x->first[p] - first;
        const double c = x->cosine[p] + shift * table[0], s = x->sine[p] + shift * table[1];
        const double l = x->level[p] + shift * size;
        const double r = x->ramp[p] + shift * 0.5 * size * (size - 1.0);
        out->cosine[p] = plan->turn_cos[p] * c - plan->turn_sin[p] * s;
        out->sine[p] = plan->turn_sin[p] * c + plan->turn_cos[p] * s;
        out->level[p] = l;
        out->ramp[p] = (r + (m * (double)p - 0.5 * (n - 1.0)) * l) / n;
        out->square[p] = x->square[p] + shift * (2.0 * x->level[p] + shift * size);
    }
    out->first = first;
    out->known_a = out->known_b = 0.0;
}
