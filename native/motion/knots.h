/* Values of a law between its knots, by cubics: for motion.c alone, which includes it once. */
#ifndef MOTION_KNOTS_H
#define MOTION_KNOTS_H

#include "motion/motion.h"
#include <math.h>
#include <stddef.h>
#include <string.h>

/* Of the four knots from `first`; `t`: from the second of them, in knots. */
typedef struct {
    int32_t first;
    double t, weight[4];
} cubic;

/* Lagrange's cubic through the four knots about `at`, counted in knots; constant beyond the ends. */
static inline void locate(double at, int32_t knots, cubic *c)
{
    const double last = (double)(knots - 1);
    const double inside = at > 0.0 ? (at < last ? at : last) : 0.0;
    int32_t i = (int32_t)inside;
    i = i < 1 ? 1 : i > knots - 3 ? knots - 3 : i;
    c->first = i - 1;
    c->t = inside - (double)i;
}

static inline void weigh(cubic *c)
{
    const double t = c->t, u = t - 1.0, v = t - 2.0, w = t + 1.0;
    c->weight[0] = (-1.0 / 6.0 * t) * (u * v);
    c->weight[1] = (0.5 * w) * (u * v);
    c->weight[2] = (-0.5 * v) * (w * t);
    c->weight[3] = (1.0 / 6.0 * u) * (w * t);
}

/* Slopes of the weights, per knot. */
static void slopes_at(const cubic *c, double slope[4])
{
    const double t = c->t, u = t - 1.0, v = t - 2.0, w = t + 1.0;
    slope[0] = -1.0 / 6.0 * (u * v + t * v + t * u);
    slope[1] = 0.5 * (u * v + w * v + w * u);
    slope[2] = -0.5 * (t * v + w * v + w * t);
    slope[3] = 1.0 / 6.0 * (t * u + w * u + w * t);
}

static inline double dot4(const double *w, const double *v)
{
    return (w[0] * v[0] + w[1] * v[1]) + (w[2] * v[2] + w[3] * v[3]);
}

static inline void locate_length(const motion_law *law, double length_m, cubic *c)
{
    locate((length_m - law->low_m) * law->per_step_m, law->lengths, c);
}

/* Where nothing depends on the voltage, all is 0. */
static inline void locate_voltage(const motion_law *law, double voltage_v, cubic *c)
{
    memset(c, 0, sizeof *c);
    if (law->voltages > 1) {
        locate(fabs(voltage_v) * law->per_step_v, law->voltages, c);
        weigh(c);
    }
}

/* Slope of a table over the length. */
static double slope_along(const motion_law *law, const double *values, const cubic *along)
{
    double slope[4];
    slopes_at(along, slope);
    return dot4(slope, values + along->first) * law->per_step_m;
}

/* Where a length and a voltage lie in the tables. */
typedef struct {
    cubic along, across; /* across: unused where nothing depends on the voltage */
} place;

static inline void place_at(const motion_law *law, double length_m, double voltage_v, place *at)
{
    locate_length(law, length_m, &at->along);
    weigh(&at->along);
    locate_voltage(law, voltage_v, &at->across);
}

/* The four values along the length, between rows of MOTION_LENGTHS knots each. */
static inline void blend_rows(const motion_law *law, const double rows[][MOTION_LENGTHS],
                              int32_t first, const cubic *across, double values[4])
{
    const double *w = across->weight, *knot = rows[across->first] + first;
    int i;
    if (law->voltages == 1) {
        memcpy(values, knot, 4 * sizeof *values);
        return;
    }
    for (i = 0; i < 4; ++i) {
        values[i] = (w[0] * knot[i] + w[1] * knot[MOTION_LENGTHS + i]) +
                    (w[2] * knot[2 * MOTION_LENGTHS + i] + w[3] * knot[3 * MOTION_LENGTHS + i]);
    }
}

static inline double value_at(const motion_law *law, const double rows[][MOTION_LENGTHS],
                              const place *at)
{
    double values[4];
    blend_rows(law, rows, at->along.first, &at->across, values);
    return dot4(at->along.weight, values);
}

/* The same cubic between two knots as a polynomial of t. */
typedef struct {
    double c0, c1, c2, c3;
} polynomial;

static inline polynomial through(const double values[4])
{
    const double turn = 0.5 * (values[1] - values[2]);
    const double rise = 1.0 / 6.0 * (values[3] - values[0]);
    const double bend = 0.5 * (values[0] + values[2]) - values[1];
    const polynomial f = {values[1], values[2] - values[1] - bend - (turn + rise), bend,
                          turn + rise};
    return f;
}

static inline double polynomial_at(const polynomial *f, double t)
{
    return (f->c0 + f->c1 * t) + t * t * (f->c2 + f->c3 * t);
}

/* Values of `n` tables whose knots lie side by side. */
HS_CLONES static void add_knots(const double *weight, const double *restrict first, int32_t n,
                                double *restrict out)
{
    const double a = weight[0], b = weight[1], c = weight[2], d = weight[3];
    int32_t j;
    for (j = 0; j < n; ++j) {
        out[j] += a * first[j] + b * first[n + j] + c * first[2 * n + j] + d * first[3 * n + j];
    }
}

static void values_by(const motion_law *law, const double *tables, int32_t n, const place *at,
                      double *out)
{
    const int64_t row = (int64_t)law->lengths * n;
    const double *first = tables + (int64_t)at->along.first * n;
    int k, i;
    memset(out, 0, (size_t)n * sizeof *out);
    if (law->voltages == 1) {
        add_knots(at->along.weight, first, n, out);
        return;
    }
    for (k = 0; k < 4; ++k) {
        double weight[4];
        for (i = 0; i < 4; ++i) {
            weight[i] = at->across.weight[k] * at->along.weight[i];
        }
        add_knots(weight, first + (at->across.first + k) * row, n, out);
    }
}

/* Value of a table of the law, and its slopes. */
typedef struct {
    double value, per_m, per_v;
} surface;

static surface surface_at(const motion_law *law, const double rows[][MOTION_LENGTHS],
                          const place *at, double voltage_v)
{
    surface s = {0.0, 0.0, 0.0};
    double along[4], across[4];
    int k;
    slopes_at(&at->along, along);
    if (law->voltages == 1) {
        s.value = dot4(at->along.weight, rows[0] + at->along.first);
        s.per_m = dot4(along, rows[0] + at->along.first) * law->per_step_m;
        return s;
    }
    slopes_at(&at->across, across);
    for (k = 0; k < 4; ++k) {
        const double *values = rows[at->across.first + k] + at->along.first;
        const double here = dot4(at->along.weight, values);
        s.value += at->across.weight[k] * here;
        s.per_m += at->across.weight[k] * dot4(along, values) * law->per_step_m;
        s.per_v += across[k] * here * law->per_step_v;
    }
    s.per_v = voltage_v < 0.0 ? -s.per_v : s.per_v;
    return s;
}

#endif
