/* Takes: records, a structure, searched numbers. Gives: the fit, its sensitivities, its output. */
#include "identification/transfer.h"

#include <math.h>
#include <string.h>

#include "identification/transfer_evaluation.h"
#include "identification/vectors.h"

#define SMALLEST_STEP 1e-9
#define CRAWL 1e-6 /* of the cost: several steps of less mean the bottom of a flat valley */
#define CRAWLING 20

void transfer_project(const transfer_problem *problem, transfer_solution *solution)
{
    const transfer_layout w = transfer_laid_out(problem);
    transfer_evaluation e;
    transfer_evaluate(problem, &w, &e, solution);
}

/* ---- the search --------------------------------------------------------------------------- */

typedef struct {
    int32_t n;
    double gram[TRANSFER_NUMBERS][TRANSFER_NUMBERS], gradient[TRANSFER_NUMBERS];
} normal_equations;

static normal_equations normal_of(const transfer_problem *p, const transfer_layout *w)
{
    normal_equations out;
    int32_t i, j, f;
    memset(&out, 0, sizeof out);
    out.n = transfer_searched(p->structure);
    for (i = 0; i < out.n; ++i) {
        memcpy(w->bare[i], w->slopes[i], (size_t)w->total * sizeof(double));
        for (f = 0; f < transfer_shared(p->structure); ++f) {
            const double along = vector_dot(w->ortho[f], w->bare[i], w->total);
            vector_add(w->bare[i], -along, w->ortho[f], w->total);
        }
        out.gradient[i] = vector_dot(w->bare[i], w->target, w->total);
        for (j = 0; j <= i; ++j) {
            out.gram[i][j] = out.gram[j][i] = vector_dot(w->bare[i], w->bare[j], w->total);
        }
    }
    return out;
}

/* Damped step by Cholesky's factors of the scaled matrix; a direction without effect, or one that
 * is held, stays. */
static void step_of(const normal_equations *normal, const int32_t *held, double damping,
                    double *step)
{
    double a[TRANSFER_NUMBERS][TRANSFER_NUMBERS], unit[TRANSFER_NUMBERS];
    const int32_t n = normal->n;
    int32_t i, j, k;
    for (i = 0; i < n; ++i) {
        const int32_t moves = !held[i] && normal->gram[i][i] > 0.0;
        unit[i] = moves ? 1.0 / sqrt(normal->gram[i][i]) : 0.0;
    }
    for (i = 0; i < n; ++i) {
        for (j = 0; j <= i; ++j) {
            double sum = normal->gram[i][j] * unit[i] * unit[j];
            sum += i == j ? damping + 1e-13 + (unit[i] == 0.0 ? 1.0 : 0.0) : 0.0;
            for (k = 0; k < j; ++k) {
                sum -= a[i][k] * a[j][k];
            }
            a[i][j] = i == j ? sqrt(sum > 1e-15 ? sum : 1e-15) : sum / a[j][j];
        }
    }
    for (i = 0; i < n; ++i) {
        step[i] = normal->gradient[i] * unit[i];
        for (k = 0; k < i; ++k) {
            step[i] -= a[i][k] * step[k];
        }
        step[i] /= a[i][i];
    }
    for (i = n - 1; i >= 0; --i) {
        for (k = i + 1; k < n; ++k) {
            step[i] -= a[k][i] * step[k];
        }
        step[i] /= a[i][i];
    }
    for (i = 0; i < n; ++i) {
        step[i] *= unit[i];
    }
}

typedef struct {
    double trial[TRANSFER_NUMBERS];
    double largest; /* part of the step */
    double gained;  /* of the cost, by the quadratic model */
    int32_t cut;    /* whether a bound shortened it */
} bounded_step;

/* A step inside the bounds; a number at a bound that would leave it is fixed there. */
static bounded_step step_inside(const normal_equations *normal, const double *low,
                                const double *high, double damping, const double *at)
{
    bounded_step out;
    double step[TRANSFER_NUMBERS];
    int32_t held[TRANSFER_NUMBERS] = {0};
    int32_t i, j, round, again = 1;
    memset(&out, 0, sizeof out);
    for (round = 0; again && round <= normal->n; ++round) {
        step_of(normal, held, damping, step);
        again = 0;
        for (i = 0; i < normal->n; ++i) {
            const int32_t leaves = (at[i] <= low[i] && step[i] < 0.0) ||
                                   (at[i] >= high[i] && step[i] > 0.0);
            if (leaves && !held[i]) {
                held[i] = again = 1;
            }
        }
    }
    for (i = 0; i < normal->n; ++i) {
        out.trial[i] = fmin(fmax(at[i] + step[i], low[i]), high[i]);
        out.cut |= out.trial[i] != at[i] + step[i];
        step[i] = out.trial[i] - at[i];
        out.largest = fmax(out.largest, fabs(step[i]));
    }
    for (i = 0; i < normal->n; ++i) {
        out.gained += 2.0 * step[i] * normal->gradient[i];
        for (j = 0; j < normal->n; ++j) {
            out.gained -= step[i] * normal->gram[i][j] * step[j];
        }
    }
    return out;
}

void transfer_minimise(const transfer_problem *problem, const double *low, const double *high,
                       int32_t iterations, double gain, transfer_solution *solution)
{
    const transfer_layout w = transfer_laid_out(problem);
    transfer_evaluation e;
    normal_equations normal;
    transfer_solution trial;
    double damping = 1e-3;
    int32_t k, crawled = 0;
    transfer_evaluate(problem, &w, &e, solution);
    solution->settled = 1;
    if (transfer_searched(problem->structure) == 0 || !(solution->cost > 0.0)) {
        return;
    }
    transfer_differentiate(problem, &w, &e, solution);
    normal = normal_of(problem, &w);
    trial = *solution;
    for (k = 0; k < iterations && damping < 1e8; ++k) {
        const bounded_step step = step_inside(&normal, low, high, damping, solution->search);
        if (!(step.largest > SMALLEST_STEP) ||
            (damping < 1.0 && !step.cut && step.gained < gain * solution->cost)) {
            return;
        }
        memcpy(trial.search, step.trial, sizeof trial.search);
        transfer_evaluate(problem, &w, &e, &trial);
        if (trial.cost < solution->cost) {
            const double won = (solution->cost - trial.cost) / solution->cost;
            *solution = trial;
            solution->settled = 1;
            damping = fmax(damping / 10.0, 1e-12);
            crawled = won < CRAWL ? crawled + 1 : 0;
            if (won < gain || crawled >= CRAWLING || !(trial.cost > 0.0)) {
                return;
            }
            transfer_differentiate(problem, &w, &e, solution);
            normal = normal_of(problem, &w);
        } else {
            damping *= 10.0;
        }
    }
    solution->settled = damping >= 1e8;
}

void transfer_columns(const transfer_problem *problem, const transfer_solution *solution,
                      double *residuals, double *columns)
{
    const transfer_layout w = transfer_laid_out(problem);
    const int32_t n_searched = transfer_searched(problem->structure);
    const int32_t n_shared = transfer_shared(problem->structure);
    const int32_t n_own = transfer_own(problem->structure);
    const size_t bytes = (size_t)w.total * sizeof(double);
    transfer_solution again = *solution;
    transfer_evaluation e;
    int32_t i;
    transfer_evaluate(problem, &w, &e, &again);
    transfer_differentiate(problem, &w, &e, &again);
    memcpy(residuals, w.target, bytes);
    for (i = 0; i < n_searched; ++i) {
        memcpy(columns + i * w.total, w.slopes[i], bytes);
    }
    for (i = 0; i < n_shared; ++i) {
        memcpy(columns + (n_searched + i) * w.total, w.shared[i], bytes);
    }
    for (i = 0; i < n_own; ++i) {
        memcpy(columns + (n_searched + n_shared + i) * w.total, w.own[i], bytes);
    }
}

void transfer_predict(const transfer_problem *problem, const transfer_solution *solution,
                      double *output)
{
    const transfer_structure *s = problem->structure;
    const int32_t n_factors = s->zeros + 1 + s->slow;
    const transfer_layout w = transfer_laid_out(problem);
    transfer_evaluation e;
    int64_t from = 0;
    int32_t r, i, f = 0;
    transfer_begin(problem, &w, solution->search, &e);
    vector_fill(output, 0.0, w.total);
    for (i = 0; i < n_factors; ++i) {
        const int32_t open = s->factors[i] != s->factors[i];
        transfer_shared_column(problem, &w, &e, i, w.held);
        vector_add(output, open ? solution->shared[f] : s->factors[i], w.held, w.total);
        f += open;
    }
    for (i = 0; i < transfer_own(s); ++i) {
        transfer_own_column(problem, &w, &e, i, w.held);
        for (r = 0, from = 0; r < problem->n_records; ++r) {
            vector_add(output + from, solution->own[r][i], w.held + from, problem->records[r].n);
            from += problem->records[r].n;
        }
    }
}
