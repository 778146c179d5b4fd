/* Takes: records, a structure, numbers. Gives: columns, factors, cost, sensitivities. */
#include "identification/transfer_evaluation.h"

#include <string.h>

#include "identification/vectors.h"

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
    return columns * output_count(records, n_records) + scratch +
           2 * TRANSFER_FACTORS * TRANSFER_FACTORS * (int64_t)n_records;
}

transfer_layout transfer_laid_out(const transfer_problem *p)
{
    const transfer_structure *s = p->structure;
    transfer_layout w;
    double *at = p->work;
    int32_t i, k;
    memset(&w, 0, sizeof w);
    w.total = output_count(p->records, p->n_records);
#define TAKE(place) ((place) = at, at += w.total)
    for (i = 0; i < pole_count(s); ++i) {
        held_states *both[2] = {&w.forced[i], &w.decay[i]};
        for (k = 0; k < 2; ++k) {
            TAKE(both[k]->re);
            TAKE(both[k]->im);
            TAKE(both[k]->slope_re);
            TAKE(both[k]->slope_im);
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
    w.triangles = (double(*)[TRANSFER_FACTORS][TRANSFER_FACTORS])at;
    at += TRANSFER_FACTORS * TRANSFER_FACTORS * p->n_records;
    for (i = 0; i < TRANSFER_FACTORS; ++i) {
        w.shared_along[i] = (double(*)[TRANSFER_FACTORS])at;
        at += TRANSFER_FACTORS * p->n_records;
    }
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
                         const held_states *states, int64_t from, int64_t n)
{
    int32_t i;
    for (i = w->part.first; i < w->part.first + w->part.order; ++i) {
        add_part(out + from, set->counts[i] * w->value[i], states[i].re + from, states[i].im + from,
                 n);
    }
}

/* out += derivative of it by a searched number. */
static void add_slope(double *out, const transfer_poles *set, const transfer_residues *w,
                      double factor, int32_t j, const held_states *states, int64_t from, int64_t n)
{
    int32_t i;
    for (i = w->part.first; i < w->part.first + w->part.order; ++i) {
        const double weight = factor * set->counts[i];
        if (weight != 0.0) {
            add_part(out + from, weight * w->slope[i][j], states[i].re + from, states[i].im + from,
                     n);
            add_part(out + from, weight * w->value[i] * set->slope[i][j], states[i].slope_re + from,
                     states[i].slope_im + from, n);
        }
    }
}

/* out -= derivative of it by time, which is its derivative by the delay. */
static void add_delay_slope(double *out, const transfer_poles *set, const transfer_residues *w,
                            double factor, const transfer_layout *work)
{
    int32_t i;
    for (i = w->part.first; i < w->part.first + w->part.order; ++i) {
        const double complex weight = -factor * set->counts[i] * w->value[i];
        if (set->counts[i]) {
            add_part(out, weight * set->value[i], work->forced[i].re, work->forced[i].im,
                     work->total);
            vector_add(out, creal(weight), work->held, work->total);
        }
    }
}

/* ---- one evaluation ----------------------------------------------------------------------- */

static held_states states_from(const held_states *states, int64_t from)
{
    const held_states out = {states->re + from, states->im + from, states->slope_re + from,
                             states->slope_im + from};
    return out;
}

static void fill_states(const transfer_problem *p, const transfer_layout *w,
                        const transfer_poles *set)
{
    const transfer_structure *s = p->structure;
    int64_t from = 0;
    int32_t r, i;
    for (r = 0; r < p->n_records; ++r) {
        const held_record *record = &p->records[r];
        for (i = 0; i < set->n; ++i) {
            const held_complex pole = {creal(set->value[i]), cimag(set->value[i])};
            const held_states forced = states_from(&w->forced[i], from);
            const held_states decay = states_from(&w->decay[i], from);
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
void transfer_shared_column(const transfer_problem *p, const transfer_layout *w,
                            const transfer_evaluation *e, int32_t index, double *out)
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

void transfer_own_column(const transfer_problem *p, const transfer_layout *w,
                         const transfer_evaluation *e, int32_t index, double *out)
{
    const int32_t states = p->structure->initial_state ? pole_count(p->structure) : 0;
    vector_fill(out, index < states ? 0.0 : 1.0, w->total);
    if (index < states) {
        add_function(out, &e->set, &e->own[index], w->decay, 0, w->total);
    }
}

void transfer_begin(const transfer_problem *p, const transfer_layout *w, const double *search,
                    transfer_evaluation *e)
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
static void free_of_own(const transfer_problem *p, const transfer_layout *w, double *column,
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
static void solve_own(const transfer_problem *p, const transfer_layout *w,
                      double target[][TRANSFER_FACTORS], int32_t n_shared,
                      transfer_solution *solution)
{
    const int32_t n_own = transfer_own(p->structure);
    int32_t r, q, f;
    for (r = 0; r < p->n_records; ++r) {
        double right[TRANSFER_FACTORS];
        for (q = 0; q < n_own; ++q) {
            right[q] = target[r][q];
            for (f = 0; f < n_shared; ++f) {
                right[q] -= w->shared_along[f][r][q] * solution->shared[f];
            }
        }
        vector_back_substitute(w->triangles[r], right, n_own, solution->own[r]);
    }
}

/* Target less what known factors give. */
static void fill_target(const transfer_problem *p, const transfer_layout *w, transfer_evaluation *e)
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
            transfer_shared_column(p, w, e, i, w->held); /* the input is filled later */
            vector_add(w->target, -s->factors[i], w->held, w->total);
        }
    }
}

/* Factors and cost; leaves residuals in target, columns in own, shared and ortho. */
void transfer_evaluate(const transfer_problem *p, const transfer_layout *w, transfer_evaluation *e,
                       transfer_solution *solution)
{
    const transfer_structure *s = p->structure;
    const int32_t n_own = transfer_own(s), n_shared = transfer_shared(s);
    double along[TRANSFER_RECORDS][TRANSFER_FACTORS];
    double triangle[TRANSFER_FACTORS][TRANSFER_FACTORS], right[TRANSFER_FACTORS];
    int64_t from = 0;
    int32_t r, i, f = 0;
    transfer_begin(p, w, solution->search, e);
    for (i = 0; i < n_own; ++i) {
        transfer_own_column(p, w, e, i, w->own[i]);
    }
    for (r = 0; r < p->n_records; ++r) {
        for (i = 0; i < n_own; ++i) {
            vector_orthonormal(w->own[i], w->own, i, from, p->records[r].n, w->triangles[r][i]);
        }
        from += p->records[r].n;
    }
    fill_target(p, w, e);
    free_of_own(p, w, w->target, along);
    for (i = 0; i < factor_count(s); ++i) {
        if (s->factors[i] != s->factors[i]) {
            transfer_shared_column(p, w, e, i, w->shared[f]);
            free_of_own(p, w, w->shared[f], w->shared_along[f]);
            memcpy(w->ortho[f], w->shared[f], (size_t)w->total * sizeof(double));
            vector_orthonormal(w->ortho[f], w->ortho, f, 0, w->total, triangle[f]);
            right[f] = vector_dot(w->ortho[f], w->target, w->total);
            vector_add(w->target, -right[f], w->ortho[f], w->total);
            ++f;
        }
    }
    vector_back_substitute(triangle, right, n_shared, solution->shared);
    solve_own(p, w, along, n_shared, solution);
    for (i = 0, f = 0; i < factor_count(s); ++i) {
        if (s->factors[i] != s->factors[i]) {
            e->factors[i] = solution->shared[f++];
        }
    }
    solution->cost = vector_dot(w->target, w->target, w->total);
}

/* Sensitivities to the searched numbers, freed of own. */
void transfer_differentiate(const transfer_problem *p, const transfer_layout *w,
                            const transfer_evaluation *e, const transfer_solution *solution)
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
