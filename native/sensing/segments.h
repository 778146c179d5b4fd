/* The segments of a block: sums of readings of any type, and a fit of each segment. */
#ifndef HASELAB_SEGMENTS_H
#define HASELAB_SEGMENTS_H

#include "sensing/sense.h"

/* The build sets it to have a function compiled for several instruction sets. */
#ifndef HS_CLONES
#define HS_CLONES
#endif

/* Segments of one channel; sums over a block's basis about one reading, `first`. */
typedef struct {
    double first;
    double known_a, known_b; /* carrier that was subtracted before */
    double cosine[SENSE_ALL], sine[SENSE_ALL], level[SENSE_ALL], ramp[SENSE_ALL];
    double square[SENSE_ALL];
    /* Fit of each full segment: phasor (a cos + b sin) from its first sample, level, residual. */
    double a[SENSE_ALL], b[SENSE_ALL], height[SENSE_ALL], rest[SENSE_ALL];
} sense_channel;

/* Raw sums, one array a kind so that all segments go through one vector instruction. */
typedef struct {
    double first[SENSE_ALL], cosine[SENSE_ALL], sine[SENSE_ALL], level[SENSE_ALL];
    double ramp[SENSE_ALL], square[SENSE_ALL];
} sense_columns;

/* A carrier to subtract from the readings before they are summed, from the block's first sample. */
typedef struct {
    double a, b; /* a cos + b sin */
} sense_carrier;

/* Sums of all segments of both channels. known: what is taken off both channels, or NULL. room: as
 * sense_room() says. Returns the reasons that the readings themselves give. */
unsigned sense_sum_block(const sense_plan *plan, sense_type type, const void *v, const void *i,
                         size_t stride, size_t ahead, const sense_carrier *known, float *room,
                         sense_columns all[2]);

/* `n` readings of both channels from sample `at` on, as floats. */
void sense_load(sense_type type, const void *v, const void *i, size_t stride, size_t at, size_t n,
                float *out_v, float *out_i);

/* Full segments on their own: least squares over cos, sin, 1, ramp. */
void sense_fit_segments(const sense_plan *plan, const sense_columns *x, sense_channel *out);

/* The segments' sums about one reading and over the basis of the whole block. */
void sense_turn_segments(const sense_plan *plan, const sense_columns *x, sense_channel *out);

#endif
