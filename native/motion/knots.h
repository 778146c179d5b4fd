/* Values of a law between its knots, by cubics: for motion.c alone, which includes it once. */
#ifndef MOTION_KNOTS_H
#define MOTION_KNOTS_H

#include "motion/motion.h"
#include <math.h>
#include <stddef.h>
#include <string.h>

typedef struct {
    int32_t first;
    double weight[4], slope[4]; /* slope: of the weights, per knot */
} cubic;

/* Lagrange's cubic through the four knots about `at`, counted in knots; constant beyond the ends. */
static cubic cubic_at(double at, int32_t knots)
{
    const double last = (double)(knots - 1);
    const double inside = at > 0.0 ? (at < last ? at : last) : 0.0;
    int32_t i = (int32_t)inside;
    cubic c;
    double t, u, v, w;
    i = i < 1 ? 1 : i > knots - 3 ? knots - 3 : i;
    t = inside - (double)i;
    u = t - 1.0;
    v = t - 2.0;
    w = t + 1.0;
    c.first = i - 1;
    c.weight[0] = -t * u * v / 6.0;
    c.weight[1] = w * u * v / 2.0;
    c.weight[2] = -w * t * v / 2.0;
    c.weight[3] = w * t * u / 6.0;
    c.slope[0] = -(u * v + t * v + t * u) / 6.0;
    c.slope[1] = (u * v + w * v + w * u) / 2.0;
    c.slope[2] = -(t * v + w * v + w * t) / 2.0;
    c.slope[3] = (t * u + w * u + w * t) / 6.0;
    return c;
}

static double dot4(const double *w, const double *v)
{
    return w[0] * v[0] + w[1] * v[1] + w[2] * v[2] + w[3] * v[3];
}

static cubic at_length(const motion_law *law, double length_m)
{
    return cubic_at((length_m - law->low_m) / law->step_m, law->lengths);
}

/* Where a length and a voltage lie in the tables. */
typedef struct {
    cubic along, across; /* across: unused where nothing depends on the voltage */
} place;

static place place_at(const motion_law *law, double length_m, double voltage_v)
{
    place at = {at_length(law, length_m), {0, {0.0}, {0.0}}};
    if (law->voltages > 1) {
        at.across = cubic_at(fabs(voltage_v) / law->step_v, law->voltages);
    }
    return at;
}

/* Value of rows of `stride` knots each. */
static double value_at(const motion_law *law, const double *rows, int64_t stride, const place *at)
{
    const double *first = rows + at->along.first;
    double sum = 0.0;
    int k;
    if (law->voltages == 1) {
        return dot4(at->along.weight, first);
    }
    for (k = 0; k < 4; ++k) {
        sum += at->across.weight[k] * dot4(at->along.weight, first + (at->across.first + k) * stride);
    }
    return sum;
}

/* Values of `n` tables whose knots lie side by side. */
HS_CLONES static void add_knots(const double *weight, const double *first, int32_t n, double *out)
{
    int32_t j;
    for (j = 0; j < n; ++j) {
        out[j] += weight[0] * first[j] + weight[1] * first[n + j] + weight[2] * first[2 * n + j] +
                  weight[3] * first[3 * n + j];
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
    int k;
    if (law->voltages == 1) {
        s.value = dot4(at->along.weight, rows[0] + at->along.first);
        s.per_m = dot4(at->along.slope, rows[0] + at->along.first) / law->step_m;
        return s;
    }
    for (k = 0; k < 4; ++k) {
        const double *values = rows[at->across.first + k] + at->along.first;
        const double along = dot4(at->along.weight, values);
        s.value += at->across.weight[k] * along;
        s.per_m += at->across.weight[k] * dot4(at->along.slope, values) / law->step_m;
        s.per_v += at->across.slope[k] * along / law->step_v;
    }
    s.per_v = voltage_v < 0.0 ? -s.per_v : s.per_v;
    return s;
}

#endif
