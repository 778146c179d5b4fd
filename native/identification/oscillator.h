/* One resonance with a nonlinear spring and a delay, with the sensitivities of its motion.
 *
 * x'' + 2 zeta w x' + w^2 (x + q2 x^2 + q3 x^3) = gain w^2 u(t - delay), u held from edge to edge
 * or drawn straight between the edges. Runge-Kutta steps of fourth order end at each edge and each
 * output, so a jump of the input costs no accuracy. Desktop only; the caller owns all memory.
 */
#ifndef OSCILLATOR_H
#define OSCILLATOR_H

#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

/* Places of the numbers; x and x' at t = 0 are the last. */
enum {
    OSCILLATOR_LOG_OMEGA,
    OSCILLATOR_LOG_ZETA,
    OSCILLATOR_GAIN,
    OSCILLATOR_Q2,
    OSCILLATOR_Q3,
    OSCILLATOR_DELAY,
    OSCILLATOR_START,
    OSCILLATOR_RATE,
    OSCILLATOR_NUMBERS
};

typedef struct {
    const double *u;
    int32_t n_edges;
    int32_t first_order; /* 1: straight between the edges, 0: held */
    double period_s;
    double before;        /* input before t = 0 */
    const double *time_s; /* n outputs, rising, not below 0 */
    int32_t n;
} oscillator_record;

/* Motion and its derivatives by the parameters, one after the other: `x` has n values, `by_number`
 * OSCILLATOR_NUMBERS times n. Returns 0 if the motion exceeds `largest`. */
int32_t oscillator_simulate(const oscillator_record *record, const double *numbers, double largest,
                            double *x, double *by_number);

#ifdef __cplusplus
}
#endif

#endif
