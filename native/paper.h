/* The reference study's own chain, rows S6 to S9, sample by sample: for comparison. */
#ifndef HASELAB_PAPER_H
#define HASELAB_PAPER_H

#include <stddef.h>

#ifdef __cplusplus
extern "C" {
#endif

#define PAPER_SECTIONS 2 /* of second order: a Butterworth of fourth order */

typedef struct {
    double b[PAPER_SECTIONS][3], a[PAPER_SECTIONS][2]; /* a0 = 1 */
} paper_filter;

/* Of one channel; delays of the transposed direct form II. */
typedef struct {
    double z[PAPER_SECTIONS][2];
} paper_state;

typedef struct {
    double peak_to_peak;
    double re, im;  /* fundamental of the mean period, peak */
    double scatter; /* variance of one quadrature of it, from the scatter of the periods */
} paper_result;

/* One block of one channel.
 * x:       n readings, `stride` apart; n is a whole number of periods, two at least.
 * period:  samples of one.
 * wave:    2 * period numbers, cosines and then sines of one period, each times 2 / period.
 * mean:    room for `period` numbers; holds the mean period afterwards.
 */
void paper_block(const paper_filter *filter, paper_state *state, const double *x, size_t stride,
                 size_t n, size_t period, const double *wave, double *mean, paper_result *out);

#ifdef __cplusplus
}
#endif

#endif
