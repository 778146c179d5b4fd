/* Takes: what acts on an actuator, interval by interval. Gives: its lengths and mean capacitances. */
#include "motion/record.h"

#include <math.h>
#include <stddef.h>
#include <string.h>

#ifndef HS_CLONES
#define HS_CLONES
#endif

/* Where nobody looks and nothing swings any more, only slow creep is left: long steps follow it. A
 * swing of that speed decays by the same number of steps, without growing. */
#define SLOW_M_S 1e-4
#define LONG_PHASE 0.6
#define LONG_STEP_S 0.05
/* Beyond the table, forces are constant, and an actuator that has collapsed gets faster and faster.
 * A hysteresis would have to be followed in ever shorter steps, so there it stops: at that share of
 * the table's range outside. */
#define STOP_SHARE 0.01

/* Weights of Hermite's cubic at a share of a step of dt: lengths and speeds of both ends. */
typedef struct {
    double from_m, from_m_s, to_m, to_m_s;
} ends;

static ends hermite(double t, double dt)
{
    const double u = 1.0 - t;
    const ends e = {u * u * (1.0 + 2.0 * t), u * u * t * dt, t * t * (1.0 + 2.0 * u),
                    -t * t * u * dt};
    return e;
}

static ends hermite_slope(double t, double dt)
{
    const double bump = 6.0 * t * (1.0 - t) / dt;
    const ends e = {-bump, 1.0 - t * (4.0 - 3.0 * t), bump, t * (3.0 * t - 2.0)};
    return e;
}

static double blend(const ends *e, const motion_state *a, const motion_state *b)
{
    return e->from_m * a->length_m + e->from_m_s * a->speed_m_s + e->to_m * b->length_m +
           e->to_m_s * b->speed_m_s;
}

/* The step from a to b that was just made. */
typedef struct {
    const motion_state *a, *b;
    double start_s, dt;
} step;

HS_CLONES static void blend_rows(const ends *e, int32_t n, const double *restrict kept,
                                 const double *restrict rows, double *restrict out)
{
    const double from_m = e->from_m, from_m_s = e->from_m_s, to_m = e->to_m, to_m_s = e->to_m_s;
    int32_t j;
    for (j = 0; j < n; ++j) {
        out[j] = from_m * kept[j] + from_m_s * kept[n + j] + to_m * rows[j] + to_m_s * rows[n + j];
    }
}

static void stop_outside(const motion_law *law, const motion_parameters *p, motion_state *s,
                         motion_tangent *t)
{
    const double range_m = (double)(law->lengths - 1) / law->per_step_m;
    const double low_m = law->low_m - STOP_SHARE * range_m;
    const double stop_m = fmax(low_m, fmin(s->length_m, law->low_m + (1.0 + STOP_SHARE) * range_m));
    if (!(p->hysteresis_n > 0.0) || isnan(s->length_m) || s->length_m == stop_m) {
        return;
    }
    s->length_m = stop_m;
    s->speed_m_s = 0.0;
    if (t != NULL) {
        memset(t->rows, 0, 2 * (size_t)t->columns * sizeof(double));
    }
}

static int32_t sample(const step *now, const motion_tangent *t, const motion_record *record,
                      const motion_output *output, int32_t next, double until_s)
{
    for (; next < record->times && record->time_s[next] <= until_s; ++next) {
        const double share = (record->time_s[next] - now->start_s) / now->dt;
        const ends e = hermite(share, now->dt), slope = hermite_slope(share, now->dt);
        output->length_m[next] = blend(&e, now->a, now->b);
        output->speed_m_s[next] = blend(&slope, now->a, now->b);
        if (t != NULL) {
            blend_rows(&e, t->columns, output->kept, t->rows,
                       output->length_by + (int64_t)next * t->columns);
        }
    }
    return next;
}

/* Factor of a drift; `by`: its relative derivatives by rate and time constant. */
static double drifted(const double d[2], double time_s, double by[2])
{
    const double share = d[1] > 0.0 ? time_s / d[1] : 0.0;
    const double gone = d[1] > 0.0 ? -expm1(-share) : 0.0;
    const double factor = 1.0 + d[0] * d[1] * gone;
    by[0] = d[1] * gone / factor;
    by[1] = d[0] * (gone - share * (1.0 - gone)) / factor;
    return factor;
}

/* Voltage on which the capacitance depends. */
static double root_v(const motion_input *in)
{
    return sqrt(in->volt * in->volt + in->ripple_v2);
}

/* Adds the integral of the capacitance over the step by Simpson's rule; `scale` multiplies it. `by`:
 * derivatives of the interval, of which there may be none. */
static void integrate(const motion_law *law, const step *now, const motion_tangent *t,
                      double scale, const motion_input *in, const motion_output *output,
                      int32_t interval, double *by)
{
    const double volt = root_v(in);
    static const double at[3] = {0.0, 0.5, 1.0}, weight[3] = {1.0 / 6.0, 2.0 / 3.0, 1.0 / 6.0};
    int i;
    for (i = 0; i < 3; ++i) {
        const ends e = hermite(at[i], now->dt);
        const double length_m = blend(&e, now->a, now->b);
        const double share = scale * now->dt * weight[i];
        if (t == NULL) {
            output->mean_f[interval] += share * motion_capacitance(law, length_m, volt);
        } else {
            double *rows = output->kept + 2 * t->columns, *own = rows + t->columns;
            const motion_capacitance_slopes c =
                motion_capacitance_by(law, t, length_m, volt, own);
            int32_t j;
            output->mean_f[interval] += share * c.value;
            blend_rows(&e, t->columns, output->kept, t->rows, rows);
            for (j = 0; j < t->columns; ++j) {
                by[j] += share * c.per_m * rows[j];
            }
            for (j = 0; j < t->laws; ++j) {
                by[t->law_column[j]] += share * own[j];
            }
            for (j = 0; volt > 0.0 && c.per_v != 0.0 && j < t->columns; ++j) {
                by[j] += t->kind[j] == MOTION_VOLTAGE_SCALE ? share * c.per_v * in->volt * in->volt / volt : 0.0;
            }
            for (j = 0; j < t->columns; ++j) {
                const int32_t k = t->kind[j] - MOTION_ELECTRIC_DRIFT;
                if (k == 0 || k == 1) {
                    by[j] += share * t->drift[2 + k] * (c.value + 0.5 * c.per_v * volt);
                }
            }
        }
    }
}

void motion_play(const motion_law *law, const motion_parameters *p, motion_state *s,
                 motion_tangent *tangent, const motion_record *record, const motion_output *output)
{
    motion_parameters moving = *p;
    double *mean_by = output->mean_by;
    int32_t k, next = 0;
    for (k = 0; k < record->intervals; ++k) {
        const double from_s = record->edge_s[k], to_s = record->edge_s[k + 1];
        const double volt = root_v(&record->input[k]);
        double before_f = 0.0, at_s = from_s, drift[4];
        int32_t j;
        moving.inertia_kg = p->inertia_kg + record->mass_kg[k];
        output->mean_f[k] = output->drift_f_s[k] = 0.0;
        if (record->sensed[k]) {
            const double scale = drifted(p->electric_drift, from_s - record->edge_s[0], drift + 2);
            before_f = scale * motion_capacitance(law, s->length_m, volt * sqrt(scale));
            if (tangent != NULL) {
                memset(mean_by, 0, (size_t)tangent->columns * sizeof(double));
            }
        }
        while (at_s < to_s) {
            const double next_s =
                next < record->times && record->time_s[next] < to_s ? record->time_s[next] : to_s;
            const int unseen = !record->sensed[k] && next_s > at_s && fabs(s->speed_m_s) < SLOW_M_S;
            const double end_s = unseen ? next_s : to_s;
            const motion_state start = *s;
            step now = {&start, s, at_s, 0.0};
            motion_input in = record->input[k];
            double until_s, middle_s, scale;
            moving.phase = unseen ? LONG_PHASE : p->phase;
            moving.step_s = unseen ? LONG_STEP_S : p->step_s;
            now.dt = (end_s - at_s) / (double)motion_steps(law, &moving, s, end_s - at_s);
            until_s = end_s - at_s - now.dt > 1e-9 * now.dt ? at_s + now.dt : end_s;
            middle_s = at_s + 0.5 * now.dt - record->edge_s[0];
            moving.elastic_scale = p->elastic_scale * drifted(p->elastic_drift, middle_s, drift);
            scale = drifted(p->electric_drift, middle_s, drift + 2);
            in.volt *= sqrt(scale);
            in.ripple_v2 *= scale;
            if (tangent != NULL) {
                const size_t n = (size_t)tangent->columns;
                memcpy(tangent->drift, drift, sizeof drift);
                memcpy(output->kept, tangent->rows, 2 * n * sizeof(double));
            }
            motion_step(law, &moving, s, tangent, &in, now.dt);
            stop_outside(law, p, s, tangent);
            next = sample(&now, tangent, record, output, next, until_s);
            if (record->sensed[k]) {
                integrate(law, &now, tangent, scale, &in, output, k, mean_by);
            }
            at_s = until_s;
        }
        if (record->sensed[k]) {
            const double scale = drifted(p->electric_drift, to_s - record->edge_s[0], drift + 2);
            const double after_f = scale * motion_capacitance(law, s->length_m, volt * sqrt(scale));
            output->drift_f_s[k] = (after_f - before_f) / (to_s - from_s);
            output->mean_f[k] /= to_s - from_s;
            for (j = 0; tangent != NULL && j < tangent->columns; ++j) {
                mean_by[j] /= to_s - from_s;
            }
            mean_by += tangent != NULL ? tangent->columns : 0;
        }
    }
}
