/* hs_sum_pieces by vectors: the same bits, several times faster. */
#ifndef HASELAB_SUM_PIECES_H
#define HASELAB_SUM_PIECES_H

#include <stddef.h>

#include "hs.h"

#ifdef __cplusplus
extern "C" {
#endif

/* As hs_sum_pieces. ahead: memory so many bytes further on is prefetched, 0 for none. */
typedef void (*sum_pieces_fn)(const float *x, size_t n, const float *cosine, const float *sine,
                              size_t piece, size_t ahead, hs_sums *out);

/* Widest vectors of this machine, up to `bits`: 512, 256, 128, or 0 for none. */
int sum_pieces_bits(int bits);

/* The sums by these vectors; by the core's own code for 0. */
sum_pieces_fn sum_pieces_by(int bits);

#ifdef __cplusplus
}
#endif

#endif
