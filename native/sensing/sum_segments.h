/* hs_sum_segments by vectors: the same bits, several times faster. */
#ifndef HASELAB_SUM_SEGMENTS_H
#define HASELAB_SUM_SEGMENTS_H

#include <stddef.h>

#include "hs.h"

#ifdef __cplusplus
extern "C" {
#endif

/* As hs_sum_segments. ahead: memory so many bytes further on is prefetched, 0 for none. */
typedef void (*sum_segments_fn)(const float *x, size_t n, const float *cosine, const float *sine,
                              size_t segment, size_t ahead, hs_sums *out);

/* Widest vectors of this machine, up to `bits`: 512, 256, 128, or 0 for none. */
int sum_segments_bits(int bits);

/* The sums by these vectors; by the core's own code for 0. */
sum_segments_fn sum_segments_by(int bits);

#ifdef __cplusplus
}
#endif

#endif
