#include "models/hysteresis.h"

#include <math.h> /* exp, expm1, fabs, log1p, pow */

#ifndef HS_CLONES
#define HS_CLONES
#endif

static double within(double x, double low, double high)
{
    return x < low ? low : (x > high ? high : x);
}

static void note_rate(const struct play_parameters *p, double *rate, double *last, double u)
{
    *rate += p->pull * (fabs(u - *last) * p->rate_hz - *rate);
    *last = u;
}

HS_CLONES
void play_run(const struct play_parameters *p, double *restrict state, size_t n,
              const double *restrict u, double *restrict y)
{
    const size_t count = p->count;
    const double *restrict thresholds = p->thresholds, *restrict weights = p->weights;
    double rate = state[count], last = state[count + 1];
    for (size_t k = 0; k < n; ++k) {
        const double wider = p->rate_dependence_s * rate;
        const double input = u[k];
        double sum = p->gain * input;
        for (size_t i = 0; i < count; ++i) {
            const double r = thresholds[i] + wider;
            const double low = input - r, high = input + r;
            const double risen = state[i] > low ? state[i] : low;
            const double x = risen < high ? risen : high;
            state[i] = x;
            sum += weights[i] * x;
        }
        y[k] = sum;
        note_rate(p, &rate, &last, input);
    }
    state[count] = rate;
    state[count + 1] = last;
}

void play_columns(const struct play_parameters *p, double *state, size_t n, const double *u,
                  double *plays, double *by_threshold, double *by_rate_dependence)
{
    const size_t count = p->count;
    double rate = state[count], last = state[count + 1];
    for (size_t k = 0; k < n; ++k) {
        const double wider = p->rate_dependence_s * rate;
        const size_t row = k * count;
        for (size_t i = 0; i < count; ++i) {
            const double r = p->thresholds[i] + wider;
            const double x = within(state[i], u[k] - r, u[k] + r);
            double side = k == 0 ? 0.0 : by_threshold[row - count + i];
            double reach = k == 0 ? 0.0 : by_rate_dependence[row - count + i];
            if (x != state[i]) {
                side = x > state[i] ? -1.0 : 1.0;
                reach = side * rate;
            }
            state[i] = x;
            plays[row + i] = x;
            by_threshold[row + i] = side;
            by_rate_dependence[row + i] = reach;
        }
        note_rate(p, &rate, &last, u[k]);
    }
    state[count] = rate;
    state[count + 1] = last;
}

/* The plays nest: their upper edges ascend and their lower edges descend with the threshold, so
 * the ones that move are the first few. */
static double play_solve(const struct play_parameters *p, const double *x, double wider, double y)
{
    double rest = y, slope = p->gain;
    for (size_t i = 0; i < p->count; ++i) {
        rest -= p->weights[i] * x[i];
    }
    double u = rest / slope, side = 0.0;
    for (size_t i = 0; i < p->count; ++i) {
        const double r = p->thresholds[i] + wider;
        if (i == 0) {
            side = u > x[0] + r ? 1.0 : -1.0;
        }
        if (side * (u - x[i]) <= r) {
            break;
        }
        rest += p->weights[i] * (x[i] + side * r);
        slope += p->weights[i];
        u = rest / slope;
    }
    return u;
}

void play_invert(const struct play_parameters *p, double *state, size_t n, const double *y,
                 double *u)
{
    const size_t count = p->count;
    double rate = state[count], last = state[count + 1];
    for (size_t k = 0; k < n; ++k) {
        const double wider = p->rate_dependence_s * rate;
        const double input = play_solve(p, state, wider, y[k]);
        for (size_t i = 0; i < count; ++i) {
            const double r = p->thresholds[i] + wider;
            state[i] = within(state[i], input - r, input + r);
        }
        u[k] = input;
        note_rate(p, &rate, &last, input);
    }
    state[count] = rate;
    state[count + 1] = last;
}

/* dv/dz for rising input z = sharpness u, on the branch of negative or of positive v. */
static double slope_of(const struct bouc_wen_parameters *p, double v, int negative)
{
    const double power = p->exponent == 1.0 ? fabs(v) : pow(fabs(v), p->exponent);
    return negative ? 1.0 + (2.0 * p->sigma - 1.0) * power : 1.0 - power;
}

static double kutta(const struct bouc_wen_parameters *p, double v, double h, int negative)
{
    const double a = slope_of(p, v, negative);
    const double b = slope_of(p, v + 0.5 * h * a, negative);
    const double c = slope_of(p, v + 0.5 * h * b, negative);
    const double d = slope_of(p, v + h * c, negative);
    return v + h / 6.0 * (a + 2.0 * b + 2.0 * c + d);
}

/* Part of the step h that brings v < 0 to zero. */
static double until_zero(const struct bouc_wen_parameters *p, double v, double h)
{
    double part = h < -v ? h : -v;
    for (int i = 0; i < 8; ++i) {
        const double error = kutta(p, v, part, 1);
        part -= error / slope_of(p, error, 1);
        if (fabs(error) < 1e-15) {
            break;
        }
    }
    return within(part, 0.0, h);
}

/* Step over which the slope changes by little: |v|^n is steep near 1, and has no second derivative
 * at 0 for n below 2. */
static double step_for(const struct bouc_wen_parameters *p, double v)
{
    const double size = fabs(v);
    const double near = size > 0.01 ? 0.5 * size : 0.005;
    const double kappa = v < 0.0 ? 2.0 * p->sigma - 1.0 : 1.0;
    const double change = p->exponent * kappa * pow(size, p->exponent - 1.0);
    const double smooth = change > 1.0 ? 0.1 / change : 0.1;
    return near < smooth ? near : smooth;
}

static double rise_any(const struct bouc_wen_parameters *p, double v, double z)
{
    while (z > 0.0) {
        if (v > 1.0 - 1e-15) {
            return 1.0;
        }
        double h = step_for(p, v);
        h = z < h ? z : h;
        const int negative = v < 0.0;
        double following = kutta(p, v, h, negative);
        if (negative && following > 0.0) {
            h = until_zero(p, v, h);
            following = 0.0;
        }
        v = following > 1.0 ? 1.0 : following;
        z -= h;
    }
    return v;
}

/* Exponent 1: an exponential below zero, another one above. */
static double rise_exactly(const struct bouc_wen_parameters *p, double v, double z)
{
    const double kappa = 2.0 * p->sigma - 1.0;
    if (v < 0.0) {
        const double scaled = kappa * -v;
        const double zero = scaled > 1e-12 ? log1p(scaled) / kappa : -v;
        if (z <= zero) {
            return kappa * z > 1e-12 ? v - (1.0 + scaled) * expm1(-kappa * z) / kappa
                                     : v + (1.0 + scaled) * z;
        }
        z -= zero;
        v = 0.0;
    }
    return v - (1.0 - v) * expm1(-z);
}

static double bouc_wen_step(const struct bouc_wen_parameters *p, double w, double du)
{
    const double side = du < 0.0 ? -1.0 : 1.0;
    const double z = p->sharpness * fabs(du);
    const double v = side * w;
    return side * (p->exponent == 1.0 ? rise_exactly(p, v, z) : rise_any(p, v, z));
}

void bouc_wen_run(const struct bouc_wen_parameters *p, double *state, size_t n, const double *u,
                  double *w)
{
    for (size_t k = 0; k < n; ++k) {
        state[0] = bouc_wen_step(p, state[0], u[k] - state[1]);
        state[1] = u[k];
        w[k] = state[0];
    }
}

/* Newton's method inside a bracket; the sum rises (or falls) with the input everywhere. */
static double bouc_wen_solve(const struct bouc_wen_parameters *p, double gain, double weight,
                             const double *state, double y)
{
    const double miss = (y - gain * state[1] - weight * state[0]) / gain;
    const double ratio = weight / gain;
    const double furthest = fabs(miss) + 2.0 * fabs(ratio);
    double low = miss > 0.0 ? 0.0 : -furthest, high = miss > 0.0 ? furthest : 0.0;
    double du = 0.0;
    for (int i = 0; i < 100; ++i) {
        const double w = bouc_wen_step(p, state[0], du);
        const double error = du + ratio * (w - state[0]) - miss;
        const double side = miss < 0.0 ? -1.0 : 1.0;
        const double slope = 1.0 + ratio * p->sharpness * slope_of(p, w, side * w < 0.0);
        if (error > 0.0) {
            high = du;
        } else {
            low = du;
        }
        double following = du - error / slope;
        if (!(following >= low && following <= high)) {
            following = 0.5 * (low + high);
        }
        const double moved = fabs(following - du);
        du = following;
        if (moved <= 1e-15 * (fabs(state[1]) + fabs(du))) {
            break;
        }
    }
    return state[1] + du;
}

void bouc_wen_invert(const struct bouc_wen_parameters *p, double gain, double weight,
                     double *state, size_t n, const double *y, double *u)
{
    for (size_t k = 0; k < n; ++k) {
        u[k] = bouc_wen_solve(p, gain, weight, state, y[k]);
        state[0] = bouc_wen_step(p, state[0], u[k] - state[1]);
        state[1] = u[k];
    }
}
