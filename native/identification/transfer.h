/* Output-error fit of a transfer function by variable projection.
 *
 * The output is a sum of pole responses with linear factors: B(s)/A(s) and slow branches driven by
 * the held input, free decays and a constant for each record. The factors are solved for, the
 * poles and the delay are searched by Levenberg-Marquardt with Kaufman's Jacobian. Numbers are
 * searched as logarithms, the delay in seconds. Desktop only; the caller owns all memory.
 */
#ifndef TRANSFER_H
#define TRANSFER_H

#include "identification/held_poles.h"

#ifdef __cplusplus
extern "C" {
#endif

#define TRANSFER_POLES 9    /* fast and slow together */
#define TRANSFER_NUMBERS 10 /* one a pole, and the delay */
#define TRANSFER_FACTORS 10 /* of one kind */
#define TRANSFER_RECORDS 64

typedef struct {
    int32_t pairs, reals; /* of the fast part */
    int32_t zeros;        /* of the fast part; as many as poles: feed-through, delay known */
    int32_t slow;         /* branches of one pole beside it */
    int32_t initial_state, offset;
    double numbers[TRANSFER_NUMBERS]; /* known ones; NaN: searched. The delay is the last */
    double factors[TRANSFER_FACTORS]; /* known ones; NaN: solved for */
} transfer_structure;

typedef struct {
    const transfer_structure *structure;
    const held_record *records;
    int32_t n_records;
    double *work; /* transfer_work() doubles */
} transfer_problem;

/* Best factors at searched numbers. Columns are as long as all outputs together. */
typedef struct {
    double search[TRANSFER_NUMBERS];
    double shared[TRANSFER_FACTORS]; /* free factors in order */
    double own[TRANSFER_RECORDS][TRANSFER_FACTORS];
    double cost;
    int32_t settled;
} transfer_solution;

/* Free numbers, free factors and factors a record. */
int32_t transfer_searched(const transfer_structure *structure);
int32_t transfer_shared(const transfer_structure *structure);
int32_t transfer_own(const transfer_structure *structure);

/* Doubles of work space; 0 where the structure or the number of records is beyond the limits. */
int64_t transfer_work(const transfer_structure *structure, const held_record *records,
                      int32_t n_records);

/* Cost and factors at `solution->search`. */
void transfer_project(const transfer_problem *problem, transfer_solution *solution);

/* Search from `solution->search` inside the bounds until a step would gain less than `gain` of the
 * cost. */
void transfer_minimise(const transfer_problem *problem, const double *low, const double *high,
                       int32_t iterations, double gain, transfer_solution *solution);

/* Residuals (all outputs), then column after column: sensitivities to the searched numbers and the
 * shared factors, freed of each record's own functions, and these, orthonormal, at a solution. */
void transfer_columns(const transfer_problem *problem, const transfer_solution *solution,
                      double *residuals, double *columns);

/* Output of the model with the numbers and factors of a solution. */
void transfer_predict(const transfer_problem *problem, const transfer_solution *solution,
                      double *output);

#ifdef __cplusplus
}
#endif

#endif
