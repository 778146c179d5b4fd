/* Takes: records, a structure, searched numbers. Gives: factors, cost, sensitivities, the fit. */
#include "identification/transfer.h"

#include <math.h>
#include <string.h>

#include "identification/transfer_poles.h"
#include "identification/vectors.h"

#define SMALLEST_STEP 1e-9
#define CRAWL 1e-6 /* of the cost: so many steps of less are the floor of a flat valley */
#define CRAWLING 20

/* ---- sizes and places --------------------------------------------------------------------- */

static int32_t fast_order(const transfer_structure *s) { return 2 * s->pairs + s->reals; }
static int32_t pole_count(const transfer_structure *s) { return fast_order(s) + s->slow; }
static int32_t number_count(const transfer_structure *s) { return pole_count(s) + 1; }
static int32_t factor_count(const transfer_structure *s) { return s->zeros + 1 + s->slow; }

static int32_t open_count(const double *values, int32_t n)
{
    int32_t count = 0, i;
    for (i = 0; i < n; ++i) {
        count += values[i] != values[i];
    }
    return count;
}

int32_t transfer_searched(const transfer_structure *s)
{
    return open_count(s->numbers, number_count(s));
}

int32_t transfer_shared(const transfer_structure *s)
{
    return open_count(s->factors, factor_count(s));
}

int32_t transfer_own(const transfer_structure *s)
{
    return (s->initial_state ? pole_count(s) : 0) + (s->offset ? 1 : 0);
}

static int64_t output_count(const held_record *records, int32_t n_records)
{
    int64_t total = 0;
    int32_t r;
    for (r = 0; r < n_records; ++r) {
        total += records[r].n;
    }
    return total;
}

/* Columns in the work space, each of all outputs one record after the other. */
typedef struct {
    int64_t total;
    double *forced[TRANSFER_POLES][4], *decay[TRANSFER_POLES][4];
    double *held;                      /* the input */
    double *own[TRANSFER_FACTORS];     /* orthonormal within each record */
    double *shared[TRANSFER_FACTORS];  /* freed of own */
    double *ortho[TRANSFER_FACTORS];   /* orthonormal, freed of own */
    double *slopes[TRANSFER_NUMBERS];  /* sensitivities to the searched numbers, freed of own */
    double *bare[TRANSFER_NUMBERS];    /* the same, freed of shared too */
    double *target, *scratch;
} columns_of_work;

int64_t transfer_work(const transfer_structure *s, const held_record *records, int32_t n_records)
{
    const int32_t poles = pole_count(s);
    int64_t scratch = 0;
    int32_t r, columns;
    if (poles > TRANSFER_POLES || factor_count(s) > TRANSFER_FACTORS ||
        n_records > TRANSFER_RECORDS) {
        return 0;
    }
    for (r = 0; r < n_records; ++r) {
        const int64_t wanted = held_scratch(&records[r]);
        scratch = wanted > scratch ? wanted : scratch;
    }
    columns = 8 * poles + 2 + transfer_own(s) + 2 * transfer_shared(s) + 2 * transfer_searched(s);
    return columns * output_count(records, n_records) + scratch;
}

static columns_of_work laid_out(const transfer_problem *p)
{
    const transfer_structure *s = p->structure;
    columns_of_work w;
    double *at = p->work;
    int32_t i, k;
    memset(&w, 0, sizeof w);
    w.total = output_count(p->records, p->n_records);
#define TAKE(place) ((place) = at, at += w.total)
    for (i = 0; i < pole_count(s); ++i) {
        for (k = 0; k < 4; ++k) {
            TAKE(w.forced[i][k]);
            TAKE(w.decay[i][k]);
        }
    }
    TAKE(w.held);
    TAKE(w.target);
    for (i = 0; i < transfer_own(s); ++i) {
        TAKE(w.own[i]);
    }
    for (i = 0; i < transfer_shared(s); ++i) {
        TAKE(w.shared[i]);
        TAKE(w.ortho[i]);
    }
    for (i = 0; i < transfer_searched(s); ++i) {
        TAKE(w.slopes[i]);
        TAKE(w.bare[i]);
    }
#undef TAKE
    w.scratch = at;
    return w;
}

/* ---- functions of time -------------------------------------------------------------------- */

static void add_part(double *out, double complex factor, const double *re, const double *im,
                     int64_t n)
{
    vector_add_real(out, creal(factor), cimag(factor), re, im, n);
}

/* out += real part of the weighted sum of states. */
static void add_function(double *out, const transfer_poles *set, const transfer_residues *w,
                         double *const states[][4], int64_t from, int64_t n)
{
    int32_t i;
    for (i = w->part.first; i < w->part.first + w->part.order; ++i) {
        add_part(out + from, set->counts[i] * w->value[i], states[i][0] + from, states[i][1] + from,
                 n);
    }
}

/* out += derivative of it by a searched number. */
static void add_slope(double *out, const transfer_poles *set, const transfer_residues *w,
                      double factor, int32_t j, double *const states[][4], int64_t from, int64_t n)
{
    int32_t i;
    for (i = w->part.first; i < w->part.first + w->part.order; ++i) {
        const double weight = factor * set->counts[i];
        if (weight != 0.0) {
            add_part(out + from, weight * w->slope[i][j], states[i][0] + from, states[i][1] + from,
                     n);
            add_part(out + from, weight * w->value[i] * set->slope[i][j], states[i][2] + from,
                     states[i][3] + from, n);
        }
    }
}

/* out -= derivative of it by time, which is its derivative by the delay. */
static void add_delay_slope(double *out, const transfer_poles *set, const transfer_residues *w,
                            double factor, const columns_of_work *work)
{
    int32_t i;
    for (i = w->part.first; i < w->part.first + w->part.order; ++i) {
        const double complex weight = -factor * set->counts[i] * w->value[i];
        if (set->counts[i]) {
            add_part(out, weight * set->value[i], work->forced[i][0], work->forced[i][1],
                     work->total);
            vector_add(out, creal(weight), work->held, work->total);
        }
    }
}

/* ---- one evaluation ----------------------------------------------------------------------- */

typedef struct {
    double full[TRANSFER_NUMBERS];
    double factors[TRANSFER_FACTORS]; /* known and solved ones */
    transfer_poles set;
    transfer_residues shared[TRANSFER_FACTORS], own[TRANSFER_FACTORS];
} evaluation;

static void fill_states(const transfer_problem *p, const columns_of_work *w,
                        const transfer_poles *set)
{
    const transfer_structure *s = p->structure;
    int64_t from = 0;
    int32_t r, i;
    for (r = 0; r < p->n_records; ++r) {
        const held_record *record = &p->records[r];
        for (i = 0; i < set->n; ++i) {
            const complex_number pole = {creal(set->value[i]), cimag(set->value[i])};
            const held_states forced = {w->forced[i][0] + from, w->forced[i][1] + from,
                                        w->forced[i][2] + from, w->forced[i][3] + from};
            const held_states decay = {w->decay[i][0] + from, w->decay[i][1] + from,
                                       w->decay[i][2] + from, w->decay[i][3] + from};
            if (set->counts[i] == 0) {
                continue;
            }
            held_forced(record, pole, set->delay_s, w->scratch, forced);
            if (s->initial_state) {
                held_free(record, pole, w->scratch, decay);
            }
        }
        from += record->n;
    }
}

/* A common function, with the response to the input since ever before t = 0. */
static void shared_column(const transfer_problem *p, const columns_of_work *w,
                          const evaluation *e, int32_t index, double *out)
{
    const int32_t settles = index == 0 || index > p->structure->zeros;
    int64_t from = 0;
    int32_t r;
    for (r = 0; r < p->n_records; ++r) {
        vector_fill(out + from, settles ? p->records[r].before : 0.0, p->records[r].n);
        if (index == fast_order(p->structure) && !settles) { /* s^n/A = 1 + proper fractions */
            held_input(&p->records[r], e->set.delay_s, out + from);
        }
        from += p->records[r].n;
    }
    add_function(out, &e->set, &e->shared[index], w->forced, 0, w->total);
}

static void own_column(const transfer_problem *p, const columns_of_work *w, const evaluation *e,
                       int32_t index, double *out)
{
    const int32_t states = p->structure->initial_state ? pole_count(p->structure) : 0;
    vector_fill(out, index < states ? 0.0 : 1.0, w->total);
    if (index < states) {
        add_function(out, &e->set, &e->own[index], w->decay, 0, w->total);
    }
}

static void begin(const transfer_problem *p, const columns_of_work *w, const double *search,
                  evaluation *e)
{
    const transfer_structure *s = p->structure;
    const int32_t states = s->initial_state ? pole_count(s) : 0;
    int32_t i, k = 0;
    for (i = 0; i < number_count(s); ++i) {
        const int32_t open = s->numbers[i] != s->numbers[i];
        e->full[i] = open ? search[k] : s->numbers[i];
        k += open;
    }
    e->set = transfer_poles_of(s, e->full);
    for (i = 0; i < factor_count(s); ++i) {
        e->shared[i] = transfer_shared_residues(s, &e->set, i);
    }
    for (i = 0; i < states; ++i) {
        e->own[i] = transfer_own_residues(s, &e->set, i);
    }
    fill_states(p, w, &e->set);
}

/* Frees a column of the record's own functions; coefficients a record, or NULL. */
static void free_of_own(const transfer_problem *p, const columns_of_work *w, double *column,
                        double coefficients[][TRANSFER_FACTORS])
{
    int64_t from = 0;
    int32_t r, q;
    for (r = 0; r < p->n_records; ++r) {
        for (q = 0; q < transfer_own(p->structure); ++q) {
            const double along = vector_dot(w->own[q] + from, column + from, p->records[r].n);
            vector_add(column + from, -along, w->own[q] + from, p->records[r].n);
            if (coefficients != NULL) {
                coefficients[r][q] = along;
            }
        }
        from += p->records[r].n;
    }
}

/* Own factors of each record from what is left for them. */
static void solve_own(const transfer_problem *p,
                      double triangles[][TRANSFER_FACTORS][TRANSFER_FACTORS],
                      double target[][TRANSFER_FACTORS],
                      double shared[][TRANSFER_RECORDS][TRANSFER_FACTORS], int32_t n_shared,
                      transfer_solution *solution)
{
    const int32_t n_own = transfer_own(p->structure);
    int32_t r, q, f;
    for (r = 0; r < p->n_records; ++r) {
        double right[TRANSFER_FACTORS];
        for (q = 0; q < n_own; ++q) {
            right[q] = target[r][q];
            for (f = 0; f < n_shared; ++f) {
                right[q] -= shared[f][r][q] * solution->shared[f];
            }
        }
        vector_back_substitute(triangles[r], right, n_own, solution->own[r]);
    }
}

/* Target less what known factors give. */
static void fill_target(const transfer_problem *p, const columns_of_work *w, evaluation *e)
{
    const transfer_structure *s = p->structure;
    int64_t from = 0;
    int32_t r, i;
    for (r = 0; r < p->n_records; ++r) {
        memcpy(w->target + from, p->records[r].y, (size_t)p->records[r].n * sizeof(double));
        from += p->records[r].n;
    }
    for (i = 0; i < factor_count(s); ++i) {
        e->factors[i] = s->factors[i];
        if (s->factors[i] == s->factors[i]) {
            shared_column(p, w, e, i, w->held); /* the input is filled later */
            vector_add(w->target, -s->factors[i], w->held, w->total);
        }
    }
}

/* Factors and cost; leaves residuals in target, columns in own, shared and ortho. */
static void project(const transfer_problem *p, const columns_of_work *w, evaluation *e,
                    transfer_solution *solution)
{
    const transfer_structure *s = p->structure;
    const int32_t n_own = transfer_own(s), n_shared = transfer_shared(s);
    double triangles[TRANSFER_RECORDS][TRANSFER_FACTORS][TRANSFER_FACTORS];
    double along[TRANSFER_RECORDS][TRANSFER_FACTORS];
    double shared_along[TRANSFER_FACTORS][TRANSFER_RECORDS][TRANSFER_FACTORS];
    double triangle[TRANSFER_FACTORS][TRANSFER_FACTORS], right[TRANSFER_FACTORS];
    int64_t from = 0;
    int32_t r, i, f = 0;
    begin(p, w, solution->search, e);
    for (i = 0; i < n_own; ++i) {
        own_column(p, w, e, i, w->own[i]);
    }
    for (r = 0; r < p->n_records; ++r) {
        for (i = 0; i < n_own; ++i) {
            vector_orthonormal(w->own[i], w->own, i, from, p->records[r].n, triangles[r][i]);
        }
        from += p->records[r].n;
    }
    fill_target(p, w, e);
    free_of_own(p, w, w->target, along);
    for (i = 0; i < factor_count(s); ++i) {
        if (s->factors[i] != s->factors[i]) {
            shared_column(p, w, e, i, w->shared[f]);
            free_of_own(p, w, w->shared[f], shared_along[f]);
            memcpy(w->ortho[f], w->shared[f], (size_t)w->total * sizeof(double));
            vector_orthonormal(w->ortho[f], w->ortho, f, 0, w->total, triangle[f]);
            right[f] = vector_dot(w->ortho[f], w->target, w->total);
            vector_add(w->target, -right[f], w->ortho[f], w->total);
            ++f;
        }
    }
    vector_back_substitute(triangle, right, n_shared, solution->shared);
    solve_own(p, triangles, along, shared_along, n_shared, solution);
    for (i = 0, f = 0; i < factor_count(s); ++i) {
        if (s->factors[i] != s->factors[i]) {
            e->factors[i] = solution->shared[f++];
        }
    }
    solution->cost = vector_dot(w->target, w->target, w->total);
}

/* Sensitivities to the searched numbers, freed of own. */
static void differentiate(const transfer_problem *p, const columns_of_work *w, const evaluation *e,
                          const transfer_solution *solution)
{
    const transfer_structure *s = p->structure;
    const int32_t states = s->initial_state ? pole_count(s) : 0, last = number_count(s) - 1;
    int32_t r, j, i, k = 0;
    for (j = 0; j <= last; ++j) {
        double *out = w->slopes[k];
        int64_t from = 0;
        if (s->numbers[j] == s->numbers[j]) {
            continue;
        }
        vector_fill(out, 0.0, w->total);
        if (j == last) {
            for (r = 0; r < p->n_records; ++r) {
                held_input(&p->records[r], e->set.delay_s, w->held + from);
                from += p->records[r].n;
            }
        }
        for (i = 0; i < factor_count(s); ++i) {
            if (j == last) {
                add_delay_slope(out, &e->set, &e->shared[i], e->factors[i], w);
            } else {
                add_slope(out, &e->set, &e->shared[i], e->factors[i], j, w->forced, 0, w->total);
            }
        }
        for (r = 0, from = 0; r < p->n_records && j < last; ++r) {
            for (i = 0; i < states; ++i) {
                add_slope(out, &e->set, &e->own[i], solution->own[r][i], j, w->decay, from,
                          p->records[r].n);
            }
            from += p->records[r].n;
        }
        free_of_own(p, w, out, NULL);
        ++k;
    }
}

void transfer_project(const transfer_problem *problem, transfer_solution *solution)
{
    const columns_of_work w = laid_out(problem);
    evaluation e;
    project(problem, &w, &e, solution);
}

/* ---- the search --------------------------------------------------------------------------- */

typedef struct {
    int32_t n;
    double gram[TRANSFER_NUMBERS][TRANSFER_NUMBERS], gradient[TRANSFER_NUMBERS];
} normal_equations;

static normal_equations normal_of(const transfer_problem *p, const columns_of_work *w)
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

/* A step inside the bounds; a number that stands on one and would leave it is held there. */
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
    const columns_of_work w = laid_out(problem);
    evaluation e;
    normal_equations normal;
    transfer_solution trial;
    double damping = 1e-3;
    int32_t k, crawled = 0;
    project(problem, &w, &e, solution);
    solution->settled = 1;
    if (transfer_searched(problem->structure) == 0 || !(solution->cost > 0.0)) {
        return;
    }
    differentiate(problem, &w, &e, solution);
    normal = normal_of(problem, &w);
    trial = *solution;
    for (k = 0; k < iterations && damping < 1e8; ++k) {
        const bounded_step step = step_inside(&normal, low, high, damping, solution->search);
        if (!(step.largest > SMALLEST_STEP) ||
            (damping < 1.0 && !step.cut && step.gained < gain * solution->cost)) {
            return;
        }
        memcpy(trial.search, step.trial, sizeof trial.search);
        project(problem, &w, &e, &trial);
        if (trial.cost < solution->cost) {
            const double won = (solution->cost - trial.cost) / solution->cost;
            *solution = trial;
            solution->settled = 1;
            damping = fmax(damping / 10.0, 1e-12);
            crawled = won < CRAWL ? crawled + 1 : 0;
            if (won < gain || crawled >= CRAWLING || !(trial.cost > 0.0)) {
                return;
            }
            differentiate(problem, &w, &e, solution);
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
    const columns_of_work w = laid_out(problem);
    const int32_t n_searched = transfer_searched(problem->structure);
    const int32_t n_shared = transfer_shared(problem->structure);
    const int32_t n_own = transfer_own(problem->structure);
    const size_t bytes = (size_t)w.total * sizeof(double);
    transfer_solution again = *solution;
    evaluation e;
    int32_t i;
    project(problem, &w, &e, &again);
    differentiate(problem, &w, &e, &again);
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
    const columns_of_work w = laid_out(problem);
    evaluation e;
    int64_t from = 0;
    int32_t r, i, f = 0;
    begin(problem, &w, solution->search, &e);
    vector_fill(output, 0.0, w.total);
    for (i = 0; i < factor_count(s); ++i) {
        const int32_t open = s->factors[i] != s->factors[i];
        shared_column(problem, &w, &e, i, w.held);
        vector_add(output, open ? solution->shared[f] : s->factors[i], w.held, w.total);
        f += open;
    }
    for (i = 0; i < transfer_own(s); ++i) {
        own_column(problem, &w, &e, i, w.held);
        for (r = 0, from = 0; r < problem->n_records; ++r) {
            vector_add(output + from, solution->own[r][i], w.held + from, problem->records[r].n);
            from += problem->records[r].n;
        }
    }
}
