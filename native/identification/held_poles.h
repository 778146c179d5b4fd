/* Poles driven by a held input: states and sensitivities at the times of an output, exact.
 *
 * x' = p x + u(t), u held from edge to edge (zero order) or drawn straight between the edges
 * (first order). Inputs are relative to the input before t = 0, so all states start at 0. Desktop
 * only, double precision; the caller owns all memory.
 */
#ifndef HELD_POLES_H
#define HELD_POLES_H

#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

typedef struct {
    double re, im;
} held_complex;

/* One experiment. An output at time t is `phase[group]` of a period after edge `edge`. */
typedef struct {
    const double *u; /* n_edges inputs less `before`; the last one repeated to the end */
    int32_t n_edges;
    int32_t first_order; /* 1: straight between the edges, 0: held */
    double period_s;
    double before;     /* constant input before t = 0 */
    const double *y;   /* n outputs */
    int32_t n;
    const int32_t *edge, *group; /* n each */
    const double *phase;         /* n_groups, in [0, 1) */
    int32_t n_groups;
    int32_t in_step; /* 1: one group and the edges follow each other */
} held_record;

/* States of one pole at the outputs, real and imaginary parts apart; n values each. */
typedef struct {
    double *re, *im;           /* x */
    double *slope_re, *slope_im; /* dx/dp */
} held_states;

/* Doubles of scratch that one call needs. */
int64_t held_scratch(const held_record *record);

/* States and their derivatives by the pole for an output that is `delay_s` late. */
void held_forced(const held_record *record, held_complex pole, double delay_s, double *scratch,
                 held_states out);

/* e^{p t} and t e^{p t} at the outputs. */
void held_free(const held_record *record, held_complex pole, double *scratch, held_states out);

/* The input at the outputs, `delay_s` late; n values. */
void held_input(const held_record *record, double delay_s, double *out);

#ifdef __cplusplus
}
#endif

#endif
