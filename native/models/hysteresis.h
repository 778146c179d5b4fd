/* Hysteresis operators in time: play operators with thresholds that grow with the input's rate
 * (Prandtl-Ishlinskii) and the normalised Bouc-Wen oscillator's memory, both with their inverses.
 * The caller owns all memory; functions read a state and write the new one back. */
#ifndef HASELAB_HYSTERESIS_H
#define HASELAB_HYSTERESIS_H

#include <stddef.h> /* size_t */

#ifdef __cplusplus
#define restrict __restrict
#endif

/* y = gain u + sum_i weights[i] x_i, x_i the play operator of threshold
 * thresholds[i] + rate_dependence_s * rate, where rate is |du/dt| behind a first-order filter:
 * rate += pull (|u - last| rate_hz - rate), after the sample, so that a sample's own thresholds
 * are known before it. thresholds ascend. */
struct play_parameters {
    size_t count;
    const double *thresholds;
    const double *weights;
    double gain;
    double rate_dependence_s;
    double pull;
    double rate_hz;
};

/* Layout of a state of `count` operators: count plays, filtered rate, last input. */
#define PLAY_STATE_SIZE(count) ((count) + 2)

/* y[k] for n inputs. */
void play_run(const struct play_parameters *p, double *restrict state, size_t n,
              const double *restrict u, double *restrict y);

/* The plays themselves, row by row n x count, with their derivatives by the threshold (-1 where a
 * play last moved up, 1 down, 0 not yet) and by rate_dependence_s. */
void play_columns(const struct play_parameters *p, double *state, size_t n, const double *u,
                  double *plays, double *by_threshold, double *by_rate_dependence);

/* u[k] for which play_run gives y[k], exactly. The sums gain + weights[0] + ... + weights[m] all
 * have the sign of gain, and the plays of the state come from play_run or play_invert. */
void play_invert(const struct play_parameters *p, double *state, size_t n, const double *y,
                 double *u);

/* dw/du = sharpness (1 - sigma s |w|^(n-1) w + (sigma - 1) |w|^n), s the sign of du:
 * |w| stays below 1. State: w, last input. */
struct bouc_wen_parameters {
    double sharpness; /* rho, per unit of u */
    double sigma;     /* at least 1/2 */
    double exponent;  /* n, at least 1 */
};

#define BOUC_WEN_STATE_SIZE 2

/* w[k] for n inputs: exact for exponent 1, else Runge-Kutta steps with an error near 1e-7. */
void bouc_wen_run(const struct bouc_wen_parameters *p, double *state, size_t n, const double *u,
                  double *w);

/* u[k] for which gain u + weight w gives y[k]; gain + weight dw/du keeps the sign of gain. */
void bouc_wen_invert(const struct bouc_wen_parameters *p, double gain, double weight,
                     double *state, size_t n, const double *y, double *u);

#endif
