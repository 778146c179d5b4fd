/* Poles and residues of a transfer function, with their derivatives by the searched numbers. For C
 * alone: C++ has no such complex numbers. */
#ifndef TRANSFER_POLES_H
#define TRANSFER_POLES_H

#include <complex.h>

#include "identification/transfer.h"

typedef struct {
    int32_t n, numbers;
    double complex value[TRANSFER_POLES];
    double complex slope[TRANSFER_POLES][TRANSFER_NUMBERS]; /* by the searched form of a number */
    int32_t counts[TRANSFER_POLES]; /* how often the real part of a response counts: 0, 1 or 2 */
    double delay_s;
} transfer_poles;

/* Poles with a common denominator: the fast part, or one slow branch. */
typedef struct {
    int32_t first, order;
} transfer_section;

/* Residues of a function of one section, and their derivatives by the searched numbers. */
typedef struct {
    transfer_section part;
    double complex value[TRANSFER_POLES];
    double complex slope[TRANSFER_POLES][TRANSFER_NUMBERS];
} transfer_residues;

transfer_poles transfer_poles_of(const transfer_structure *s, const double *numbers);

/* Common functions: s^power of the fast part from 0 to the zeros, then the slow branches. */
transfer_residues transfer_shared_residues(const transfer_structure *s, const transfer_poles *set,
                                           int32_t index);

/* Free decays: s^power of each section, one for each of its poles. */
transfer_residues transfer_own_residues(const transfer_structure *s, const transfer_poles *set,
                                        int32_t index);

#endif
