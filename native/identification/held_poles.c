/* Takes: an input on its edges, a pole, a delay. Gives: states at the output's times. */
#include "identification/held_poles.h"

#include "identification/quotient.h"

#include <complex.h>
#include <math.h>

#define SNAP 1e-9 /* of a period: an output this short before an edge counts as on it */
#define SERIES 0.25
#define NOTHING 1e-140 /* a state that has decayed so far is 0: numbers near the smallest are slow */

/* What a stretch of r seconds does: decay, and the push of a constant and of a ramp, each with its
 * derivative by the pole. */
typedef struct {
    double r;
    held_complex decay, push, push_slope, ramp, ramp_slope;
} stretch;

static held_complex plain(double complex z)
{
    const held_complex out = {creal(z), cimag(z)};
    return out;
}

/* 1/n! */
static const double INVERSE[15] = {1.0,
                                   1.0,
                                   1.0 / 2.0,
                                   1.0 / 6.0,
                                   1.0 / 24.0,
                                   1.0 / 120.0,
                                   1.0 / 720.0,
                                   1.0 / 5040.0,
                                   1.0 / 40320.0,
                                   1.0 / 362880.0,
                                   1.0 / 3628800.0,
                                   1.0 / 39916800.0,
                                   1.0 / 479001600.0,
                                   1.0 / 6227020800.0,
                                   1.0 / 87178291200.0};

/* (e^z - 1)/z, (its value - 1)/z and their derivatives by z. */
static void phi(double complex z, double complex e, double complex out[4])
{
    if (cabs(z) < SERIES) {
        const double re = creal(z), im = cimag(z);
        double power_re = 1.0, power_im = 0.0, sums[8] = {0.0};
        int32_t k, i;
        for (k = 0; k < 12; ++k) {
            const double weights[4] = {INVERSE[k + 1], INVERSE[k + 2], (k + 1) * INVERSE[k + 2],
                                       (k + 1) * INVERSE[k + 3]};
            const double old = power_re;
            for (i = 0; i < 4; ++i) {
                sums[i] += weights[i] * power_re;
                sums[4 + i] += weights[i] * power_im;
            }
            power_re = power_re * re - power_im * im;
            power_im = power_im * re + old * im;
        }
        for (i = 0; i < 4; ++i) {
            out[i] = sums[i] + sums[4 + i] * I;
        }
        return;
    }
    out[0] = quotient(e - 1.0, z);
    out[1] = quotient(out[0] - 1.0, z);
    out[2] = quotient(e - out[0], z);
    out[3] = quotient(out[2] - out[1], z);
}

static stretch stretch_of(held_complex pole, double r)
{
    const double complex p = pole.re + pole.im * I, z = p * r, e = cexp(z);
    double complex f[4];
    stretch out;
    phi(z, e, f);
    out.r = r;
    out.decay = plain(e);
    out.push = plain(r * f[0]);
    out.push_slope = plain(r * r * f[2]);
    out.ramp = plain(r * r * f[1]);
    out.ramp_slope = plain(r * r * r * f[3]);
    return out;
}

int64_t held_scratch(const held_record *record)
{
    return 5 * (int64_t)record->n_edges +
           (int64_t)(sizeof(stretch) / sizeof(double) + 1) * record->n_groups;
}

/* Edges by which an output of the group is later than its own, and the rest of a period. */
static int32_t shifted(const held_record *record, int32_t group, double delay_s, double *rest_s)
{
    const double at = record->phase[group] - delay_s / record->period_s;
    const double whole = floor(at + SNAP);
    *rest_s = fmax(at - whole, 0.0) * record->period_s;
    return (int32_t)whole;
}

static int32_t bounded(const held_record *record, int32_t k)
{
    return k < record->n_edges ? k : record->n_edges - 1;
}

static double slope_at(const held_record *record, int32_t k)
{
    if (!record->first_order || k + 1 >= record->n_edges) {
        return 0.0;
    }
    return (record->u[k + 1] - record->u[k]) / record->period_s;
}

static int32_t decayed(double a, double b) { return fabs(a) + fabs(b) < NOTHING; }

typedef struct {
    double *re, *im, *slope_re, *slope_im, *ramp;
} edge_states;

static void run(const held_record *record, held_complex pole, edge_states x)
{
    const stretch s = stretch_of(pole, record->period_s);
    double re = 0.0, im = 0.0, slope_re = 0.0, slope_im = 0.0;
    int32_t k;
    for (k = 0; k < record->n_edges; ++k) {
        const double u = record->u[k], ramp = slope_at(record, k);
        const double turned_re = s.decay.re * re - s.decay.im * im;
        const double turned_im = s.decay.re * im + s.decay.im * re;
        const double moved_re = s.decay.re * slope_re - s.decay.im * slope_im;
        const double moved_im = s.decay.re * slope_im + s.decay.im * slope_re;
        x.re[k] = re;
        x.im[k] = im;
        x.slope_re[k] = slope_re;
        x.slope_im[k] = slope_im;
        x.ramp[k] = ramp;
        re = turned_re + (s.push.re * u + s.ramp.re * ramp);
        im = turned_im + (s.push.im * u + s.ramp.im * ramp);
        slope_re = moved_re + (s.r * turned_re + (s.push_slope.re * u + s.ramp_slope.re * ramp));
        slope_im = moved_im + (s.r * turned_im + (s.push_slope.im * u + s.ramp_slope.im * ramp));
        if (decayed(re, im) && decayed(slope_re, slope_im)) {
            re = im = slope_re = slope_im = 0.0;
        }
    }
}

static void sample(const held_record *record, edge_states x, const stretch *s, int32_t k,
                   held_states out, int32_t m)
{
    const double u = record->u[k], ramp = x.ramp[k];
    const double re = s->decay.re * x.re[k] - s->decay.im * x.im[k];
    const double im = s->decay.re * x.im[k] + s->decay.im * x.re[k];
    const double moved_re = s->decay.re * x.slope_re[k] - s->decay.im * x.slope_im[k];
    const double moved_im = s->decay.re * x.slope_im[k] + s->decay.im * x.slope_re[k];
    out.re[m] = re + (s->push.re * u + s->ramp.re * ramp);
    out.im[m] = im + (s->push.im * u + s->ramp.im * ramp);
    out.slope_re[m] = moved_re + (s->r * re + (s->push_slope.re * u + s->ramp_slope.re * ramp));
    out.slope_im[m] = moved_im + (s->r * im + (s->push_slope.im * u + s->ramp_slope.im * ramp));
}

static void rest(held_states out, int32_t m)
{
    out.re[m] = out.im[m] = out.slope_re[m] = out.slope_im[m] = 0.0;
}

void held_forced(const held_record *record, held_complex pole, double delay_s, double *scratch,
                 held_states out)
{
    const int32_t edges = record->n_edges;
    const edge_states x = {scratch, scratch + edges, scratch + 2 * (int64_t)edges,
                           scratch + 3 * (int64_t)edges, scratch + 4 * (int64_t)edges};
    stretch *const parts = (stretch *)(void *)(scratch + 5 * (int64_t)edges);
    int32_t *const shift = (int32_t *)(void *)(parts + record->n_groups);
    int32_t g, m;
    run(record, pole, x);
    for (g = 0; g < record->n_groups; ++g) {
        double rest_s;
        shift[g] = shifted(record, g, delay_s, &rest_s);
        parts[g] = stretch_of(pole, rest_s);
    }
    if (record->in_step) {
        const stretch part = parts[0];
        const int32_t first = record->edge[0] + shift[0];
        for (m = 0; m < record->n && first + m < 0; ++m) {
            rest(out, m);
        }
        for (; m < record->n && first + m < edges; ++m) {
            sample(record, x, &part, first + m, out, m);
        }
        for (; m < record->n; ++m) {
            sample(record, x, &part, edges - 1, out, m);
        }
        return;
    }
    for (m = 0; m < record->n; ++m) {
        const int32_t k = record->edge[m] + shift[record->group[m]];
        if (k < 0) {
            rest(out, m);
        } else {
            sample(record, x, &parts[record->group[m]], bounded(record, k), out, m);
        }
    }
}

void held_free(const held_record *record, held_complex pole, double *scratch, held_states out)
{
    const double complex p = pole.re + pole.im * I;
    const held_complex step = plain(cexp(p * record->period_s));
    held_complex *const powers = (held_complex *)(void *)scratch;
    held_complex *const parts = powers + record->n_edges;
    double re = 1.0, im = 0.0;
    int32_t k, g, m;
    for (k = 0; k < record->n_edges; ++k) {
        const double old = re;
        powers[k].re = re;
        powers[k].im = im;
        re = step.re * re - step.im * im;
        im = step.re * im + step.im * old;
        if (decayed(re, im)) {
            re = im = 0.0;
        }
    }
    for (g = 0; g < record->n_groups; ++g) {
        parts[g] = plain(cexp(p * record->phase[g] * record->period_s));
    }
    for (m = 0; m < record->n; ++m) {
        const int32_t at = record->edge[m];
        const held_complex part = parts[record->group[m]];
        const double t = (at + record->phase[record->group[m]]) * record->period_s;
        const held_complex whole =
            at >= 0 && at < record->n_edges ? powers[at] : plain(cexp(p * record->period_s * at));
        out.re[m] = whole.re * part.re - whole.im * part.im;
        out.im[m] = whole.re * part.im + whole.im * part.re;
        out.slope_re[m] = t * out.re[m];
        out.slope_im[m] = t * out.im[m];
    }
}

void held_input(const held_record *record, double delay_s, double *out)
{
    int32_t m;
    for (m = 0; m < record->n; ++m) {
        double rest_s;
        const int32_t k = record->edge[m] + shifted(record, record->group[m], delay_s, &rest_s);
        const int32_t at = bounded(record, k);
        out[m] = k < 0 ? 0.0 : record->u[at] + slope_at(record, at) * rest_s;
    }
}
