/* The reference study's own chain, rows S6 to S9, sample by sample: for comparison. */
#ifndef HASELAB_PAPER_H
#define HASELAB_PAPER_H

#include <stddef.h>

#ifdef __cplusplus
extern "C" {
#endif

typedef struct {
    double b[2][3], a[2][2]; /* two sections of second order; a0 = 1 */
} paper_filter;

/* Delays of the transposed direct form II: section, delay, channel. */
typedef struct {
    double z[2][2][2];
} paper_state;

/* Of one channel. */
typedef struct {
    double peak_to_peak;
    double re, im;  /* fundamental of the mean period, peak */
    double scatter; /* variance of one quadrature of it, from the scatter of the periods */
    double most;    /* largest reading, without its sign */
} paper_result;

/* One block of both channels.
 * x:       n pairs of readings; n is a whole number of periods, two at least.
 * period:  samples of one.
 * wave:    2 * period numbers, cosines and then sines of one period, each times 2 / period.
 * mean, fundamentals: room for 2 * period numbers, and for 4 a period of the block.
 */
void paper_block(const paper_filter *filter, paper_state *state, const double *x, size_t n,
                 size_t period, const double *wave, double *mean, double *fundamentals,
                 paper_result out[2]);

#ifdef __cplusplus
}
#endif

#endif
