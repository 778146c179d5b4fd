#include "identification/oscillator.h"

#include <math.h>

#ifndef HS_CLONES
#define HS_CLONES
#endif

#define N OSCILLATOR_NUMBERS
#define STEP 0.12 /* of a radian of the fastest motion: relative error of its frequency 2e-6 */
#define NOTHING 1e-140 /* numbers near the smallest are slow */

typedef struct {
    double x, v;
    double dx[N], dv[N]; /* by each number */
} state;

typedef struct {
    double damping, stiffness, gain, q2, q3; /* 2 zeta w, w^2 */
} plant;

/* Rates of change under the input u, whose derivative by the delay is `late`. */
static void rates(const plant *p, const state *s, double u, double late, state *out) {
    const double x = s->x, v = s->v;
    const double spring = x * (1.0 + x * (p->q2 + x * p->q3));
    const double slope = p->stiffness * (1.0 + x * (2.0 * p->q2 + 3.0 * x * p->q3));
    out->x = v;
    out->v = p->stiffness * (p->gain * u - spring) - p->damping * v;
    for (int k = 0; k < N; ++k) {
        out->dx[k] = s->dv[k];
        out->dv[k] = -p->damping * s->dv[k] - slope * s->dx[k];
    }
    out->dv[OSCILLATOR_LOG_OMEGA] += 2.0 * p->stiffness * (p->gain * u - spring) - p->damping * v;
    out->dv[OSCILLATOR_LOG_ZETA] -= p->damping * v;
    out->dv[OSCILLATOR_GAIN] += p->stiffness * u;
    out->dv[OSCILLATOR_Q2] -= p->stiffness * x * x;
    out->dv[OSCILLATOR_Q3] -= p->stiffness * x * x * x;
    out->dv[OSCILLATOR_DELAY] += p->stiffness * p->gain * late;
}

static void moved(const state *s, const state *rate, double h, state *out) {
    out->x = s->x + h * rate->x;
    out->v = s->v + h * rate->v;
    for (int k = 0; k < N; ++k) {
        out->dx[k] = s->dx[k] + h * rate->dx[k];
        out->dv[k] = s->dv[k] + h * rate->dv[k];
    }
}

/* One step; the input is u at its begin and goes on with `slope`. */
static void step(const plant *p, state *s, double h, double u, double slope) {
    const double half = u + 0.5 * h * slope, end = u + h * slope;
    state a, b, c, d, at;
    rates(p, s, u, -slope, &a);
    moved(s, &a, 0.5 * h, &at);
    rates(p, &at, half, -slope, &b);
    moved(s, &b, 0.5 * h, &at);
    rates(p, &at, half, -slope, &c);
    moved(s, &c, h, &at);
    rates(p, &at, end, -slope, &d);
    const double w = h / 6.0;
    s->x += w * (a.x + 2.0 * (b.x + c.x) + d.x);
    s->v += w * (a.v + 2.0 * (b.v + c.v) + d.v);
    for (int k = 0; k < N; ++k) {
        s->dx[k] += w * (a.dx[k] + 2.0 * (b.dx[k] + c.dx[k]) + d.dx[k]);
        s->dv[k] += w * (a.dv[k] + 2.0 * (b.dv[k] + c.dv[k]) + d.dv[k]);
    }
}

static double edge_value(const oscillator_record *r, int64_t edge) {
    if (edge < 0) return r->before;
    return r->u[edge < r->n_edges ? edge : r->n_edges - 1];
}

/* Value just after an edge and slope up to the next one. */
static void piece(const oscillator_record *r, int64_t edge, double *u, double *slope) {
    *u = edge_value(r, edge);
    *slope = r->first_order && edge >= 0 ? (edge_value(r, edge + 1) - *u) / r->period_s : 0.0;
}

HS_CLONES
int32_t oscillator_simulate(const oscillator_record *record, const double *numbers, double largest,
                            double *x, double *by_number) {
    const double omega = exp(numbers[OSCILLATOR_LOG_OMEGA]);
    const double zeta = exp(numbers[OSCILLATOR_LOG_ZETA]);
    const double delay = numbers[OSCILLATOR_DELAY], period = record->period_s;
    const plant p = {2.0 * zeta * omega, omega * omega, numbers[OSCILLATOR_GAIN],
                     numbers[OSCILLATOR_Q2], numbers[OSCILLATOR_Q3]};
    state s = {0};
    s.x = numbers[OSCILLATOR_START];
    s.v = numbers[OSCILLATOR_RATE];
    s.dx[OSCILLATOR_START] = 1.0;
    s.dv[OSCILLATOR_RATE] = 1.0;
    int64_t edge = (int64_t)floor(-delay / period);
    if (edge < -1) edge = -1;
    double t = 0.0, from = (double)edge * period + delay, u, slope;
    piece(record, edge, &u, &slope);
    for (int32_t m = 0; m < record->n; ++m) {
        const double end = record->time_s[m];
        while (t < end) {
            double next = (double)(edge + 1) * period + delay;
            const int at_edge = next <= end && edge < record->n_edges;
            if (!at_edge) next = end;
            const double span = next - t;
            if (span > 0.0) {
                const double reached = 1.0 + fabs(s.x * (2.0 * p.q2 + 3.0 * s.x * p.q3));
                const double fastest = omega * (sqrt(reached) + 2.0 * (zeta > 1.0 ? zeta : 0.0));
                const double wanted = ceil(fastest * span / STEP);
                if (!(wanted < 1e6)) return 0;
                const int32_t steps = wanted < 1.0 ? 1 : (int32_t)wanted;
                const double h = span / steps;
                for (int32_t k = 0; k < steps; ++k)
                    step(&p, &s, h, u + slope * (t - from + k * h), slope);
                t = next;
                if (!(fabs(s.x) < largest)) return 0;
            }
            if (at_edge) {
                const double old = u + slope * (next - from);
                from = next;
                piece(record, ++edge, &u, &slope);
                /* a later jump pushes later */
                s.dv[OSCILLATOR_DELAY] += p.stiffness * p.gain * (old - u);
                if (t < next) t = next;
            }
        }
        x[m] = s.x;
        for (int k = 0; k < N; ++k) {
            if (fabs(s.dx[k]) + fabs(s.dv[k]) < NOTHING) s.dx[k] = s.dv[k] = 0.0;
            by_number[(int64_t)k * record->n + m] = s.dx[k];
        }
    }
    return 1;
}
