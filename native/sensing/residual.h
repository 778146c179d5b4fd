/* Test whether the residuals of a block's plain model are white noise. */
#ifndef HASELAB_RESIDUAL_H
#define HASELAB_RESIDUAL_H

#include "sensing/segments.h"

/* The plain model of one channel: carrier, level, slope, and a step at skipped segments. */
typedef struct {
    double a, b;          /* carrier, from the block's first sample */
    double level, slope;  /* in the block's middle, unit of the readings; per block */
    double step;          /* of the segments after an update */
    double turn;          /* phase advance of the carrier from its nominal frequency, rad per segment */
} sense_model;

/* Sums over the residual r of the samples that are used. */
typedef struct {
    double square[2];      /* sum of r^2, voltage and current */
    double next[2];        /* sum of r[k] r[k + 1] */
    double third_re[2];    /* amplitude of the carrier's third harmonic, re cos - im sin, ... */
    double third_im[2];    /* ... from the block's first sample */
    double most[2];        /* largest |r| */
    double cross;          /* sum of r_v r_i */
    double samples;
} sense_residual;

/* One more pass over the readings of the segments that are used. */
void sense_sum_residual(const sense_plan *plan, sense_type type, const void *v, const void *i,
                        size_t stride, const sense_choice *choice, const sense_model model[2],
                        sense_residual *out);

#endif
