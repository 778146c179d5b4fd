/* One evaluation of a transfer function: its columns at searched numbers, the factors that are
 * solved for, the sensitivities to the numbers. What transfer.c searches with. */
#ifndef TRANSFER_EVALUATION_H
#define TRANSFER_EVALUATION_H

#include "identification/transfer_poles.h"

/* Columns in the work space, each of all outputs one record after the other. */
typedef struct {
    int64_t total;
    held_states forced[TRANSFER_POLES], decay[TRANSFER_POLES];
    double *held;                      /* the input */
    double *own[TRANSFER_FACTORS];     /* orthonormal within each record */
    double *shared[TRANSFER_FACTORS];  /* freed of own */
    double *ortho[TRANSFER_FACTORS];   /* orthonormal, freed of own */
    double *slopes[TRANSFER_NUMBERS];  /* sensitivities to the searched numbers, freed of own */
    double *bare[TRANSFER_NUMBERS];    /* the same, freed of shared too */
    double *target, *scratch;
    /* Of each record: the triangle of its own functions, and each common one along them. */
    double (*triangles)[TRANSFER_FACTORS][TRANSFER_FACTORS];
    double (*shared_along[TRANSFER_FACTORS])[TRANSFER_FACTORS];
} transfer_layout;

/* What one set of numbers means. */
typedef struct {
    double full[TRANSFER_NUMBERS];
    double factors[TRANSFER_FACTORS]; /* known and solved ones */
    transfer_poles set;
    transfer_residues shared[TRANSFER_FACTORS], own[TRANSFER_FACTORS];
} transfer_evaluation;

/* The places of the columns in the problem's work space. */
transfer_layout transfer_laid_out(const transfer_problem *p);

/* Poles, residues and states at searched numbers. */
void transfer_begin(const transfer_problem *p, const transfer_layout *w, const double *search,
                    transfer_evaluation *e);

/* Factors and cost at `solution->search`; leaves residuals in target, columns in own, shared and
 * ortho. */
void transfer_evaluate(const transfer_problem *p, const transfer_layout *w, transfer_evaluation *e,
                       transfer_solution *solution);

/* Sensitivities to the searched numbers, freed of own: `slopes`. */
void transfer_differentiate(const transfer_problem *p, const transfer_layout *w,
                            const transfer_evaluation *e, const transfer_solution *solution);

/* A common function, with the response to the input since ever before t = 0; one of the records'
 * own. */
void transfer_shared_column(const transfer_problem *p, const transfer_layout *w,
                            const transfer_evaluation *e, int32_t index, double *out);
void transfer_own_column(const transfer_problem *p, const transfer_layout *w,
                         const transfer_evaluation *e, int32_t index, double *out);

#endif
