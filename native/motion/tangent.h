/* Derivatives of one stage of a step: for motion.c alone, which includes it once, after its rates. */
#ifndef MOTION_TANGENT_H
#define MOTION_TANGENT_H

enum { LENGTH, SPEED, CHARGE, LONGEST, RELAXED, HYSTERESIS = RELAXED + MOTION_BRANCHES };

/* Slopes that all columns share. */
typedef struct {
    double elastic, softening;  /* of the elastic force by length and by longest length */
    double pull, acting;        /* of the electric force by length and by the acting voltage */
    double square;              /* of the electric force by the square of that voltage */
    softening_slopes softens;
    double turning, slipping;   /* of the rate of hysteresis by speed; less that by its force */
} slopes;

/* Those of the factor of softening; it is constant in a step until the length is the longest. */
static softening_slopes softening_by(const motion_parameters *p, double softening, double longest_m)
{
    softening_slopes d = {longest_m, 0.0, 0.0, 0.0, 0.0};
    if (p->softening_share > 0.0) {
        const double at = (longest_m / p->free_length_m - p->softening_stretch);
        d.share = (softening - 1.0) / p->softening_share;
        d.reached = -(softening - 1.0) * (1.0 - d.share) / p->softening_width;
        d.stretch = -d.reached;
        d.width = -d.reached * at / p->softening_width;
    }
    return d;
}

static slopes slopes_of(const motion_law *law, const motion_parameters *p, const motion_state *s,
                        const course *along, const rates *r)
{
    const double root = law->voltages > 1 ? sqrt(r->square) : 0.0, sign = along->sign;
    const surface pull = surface_at(law, law->pull_n_v2, &along->at, root);
    slopes d = {0};
    d.softens = s->length_m > s->longest_m ? softening_by(p, r->softening, s->length_m)
                                           : along->softens;
    d.elastic = slope_along(law, law->elastic_n, &along->at.along) * p->elastic_scale * r->softening;
    d.softening = r->elastic * d.softens.reached / p->free_length_m;
    d.pull = r->square * pull.per_m;
    d.square = r->pull + 0.5 * root * pull.per_v;
    d.acting = 2.0 * r->acting_v * d.square;
    if (p->hysteresis_n > 0.0) {
        d.turning = (p->hysteresis_n - sign * s->hysteresis_n) / slip_m(p);
        d.slipping = sign * s->speed_m_s / slip_m(p);
    }
    return d;
}

/* What each parameter does directly, at equal states: to the forces but the elastic one, to that one, to
 * the rates of charge and hysteresis, and to those of the branches. One value a column. */
enum {
    FORCE,
    ELASTIC,
    OF_CHARGE,
    OF_HYSTERESIS,
    OF_BRANCH,
    DIRECT_ROWS = OF_BRANCH + MOTION_BRANCHES
};

static void direct_rates(const motion_law *law, const motion_parameters *p, const constants *c,
                         const motion_state *s, const motion_tangent *tangent, const rates *r,
                         const place *at, const slopes *d, const motion_input *in,
                         double *direct)
{
    const int32_t n = tangent->columns, laws = tangent->laws;
    double *force = direct + FORCE * n, *elastic = direct + ELASTIC * n;
    double *charge = direct + OF_CHARGE * n, *hysteresis = direct + OF_HYSTERESIS * n;
    double *by_elastic = direct + DIRECT_ROWS * n, *by_pull = by_elastic + laws;
    const double softens =
        -d->softens.reached * d->softens.longest_m / (p->free_length_m * p->free_length_m) *
        r->elastic;
    int32_t i, j;
    memset(direct, 0, DIRECT_ROWS * (size_t)n * sizeof(double));
    for (i = 0; i < tangent->others; ++i) {
        const int32_t kind = tangent->kind[j = tangent->other_column[i]];
        if (kind >= MOTION_BRANCH_S) {
            const int32_t k = kind - MOTION_BRANCH_S;
            direct[(OF_BRANCH + k) * n + j] = r->relaxed[k] * c->per_branch_s[k];
        } else if (kind >= MOTION_BRANCH_SHARE) {
            force[j] = s->relaxed_n[kind - MOTION_BRANCH_SHARE] - r->elastic * r->softening;
        } else if (kind == MOTION_DAMPING) {
            force[j] = -s->speed_m_s;
        } else if (kind == MOTION_INERTIA) {
            force[j] = -r->acceleration;
        } else if (kind == MOTION_SOFTENING_SHARE) {
            elastic[j] = d->softens.share * r->elastic;
        } else if (kind == MOTION_SOFTENING_STRETCH) {
            elastic[j] = d->softens.stretch * r->elastic;
        } else if (kind == MOTION_SOFTENING_WIDTH) {
            elastic[j] = d->softens.width * r->elastic;
        } else if (kind == MOTION_CHARGE_SHARE) {
            force[j] = d->acting * (s->charge_v - in->volt);
        } else if (kind == MOTION_CHARGE_S) {
            charge[j] = -r->charge * c->per_charge_s;
        } else if (kind == MOTION_HYSTERESIS_N) {
            hysteresis[j] = s->speed_m_s / slip_m(p);
        } else if (kind == MOTION_HYSTERESIS_WIDTH) {
            hysteresis[j] = -r->hysteresis / p->hysteresis_width;
        } else if (kind == MOTION_VOLTAGE_SCALE) {
            force[j] = d->acting * (1.0 - p->charge_share) * in->volt;
            charge[j] = in->volt * c->per_charge_s;
        } else if (kind == MOTION_ELASTIC_DRIFT || kind == MOTION_ELASTIC_DRIFT_S) {
            elastic[j] = tangent->drift[kind - MOTION_ELASTIC_DRIFT] * r->elastic * r->softening;
        } else if (kind == MOTION_ELECTRIC_DRIFT || kind == MOTION_ELECTRIC_DRIFT_S) {
            const double share = tangent->drift[kind - MOTION_ELASTIC_DRIFT];
            force[j] = share * (0.5 * d->acting * (1.0 - p->charge_share) * in->volt +
                                d->square * in->ripple_v2);
            charge[j] = 0.5 * share * in->volt * c->per_charge_s;
        }
    }
    memset(by_elastic, 0, (size_t)laws * sizeof(double));
    add_knots(at->along.weight, tangent->elastic + (int64_t)at->along.first * laws, laws,
              by_elastic);
    values_by(law, tangent->pull, laws, at, by_pull);
    for (j = 0; j < laws; ++j) {
        const int32_t column = tangent->law_column[j];
        elastic[column] =
            r->softening * p->elastic_scale * by_elastic[j] + softens * tangent->free_length[j];
        force[column] = r->square * by_pull[j];
        if (p->hysteresis_n > 0.0) {
            hysteresis[column] = -r->hysteresis * tangent->free_length[j] / p->free_length_m;
        }
    }
}

/* Rates of the derivatives `z`, added at once to the `rows` at the begin of the step, which gives
 * those `at` the next stage, and to their `sum` at its end. Row LONGEST has no rate: the longest length
 * follows the length. `late`, `drags`: whether voltage may act late, and whether there is hysteresis, as
 * numbers that the compiler knows. */
ALWAYS void linear_rates(const motion_parameters *p, const constants *c, const slopes *d, int above,
                         int32_t n, const double *restrict direct, const double *restrict rows,
                         const double *restrict z, double next, double share, double *restrict at,
                         double *restrict sum, int late, int drags)
{
    const double *force = direct + FORCE * n, *elastic = direct + ELASTIC * n;
    const double *own = direct + OF_BRANCH * n;
    const double *longest = above ? z + LENGTH * n : rows + LONGEST * n;
    const double *charge = late ? z + CHARGE * n : rows + CHARGE * n;
    const double acting = d->acting * p->charge_share, damping = p->damping_n_s_m;
    const double stiff = d->pull - c->held * d->elastic, held_m = c->held * d->softening;
    const double per_kg = c->per_kg, per_charge_s = c->per_charge_s;
    const double along = d->elastic, softened = d->softening;
    const double turning = d->turning, slipping = d->slipping;
    int32_t j;
#define ADD(row, rate) \
    { \
        const double rated = (rate); \
        sum[(row) * n + j] += share * rated; \
        at[(row) * n + j] = rows[(row) * n + j] + next * rated; \
    }
#define RELAX(k) \
    { \
        const double y = z[(RELAXED + (k)) * n + j]; \
        pull += p->branch_share[k] * y; \
        ADD(RELAXED + (k), c->per_branch_s[k] * (forced - y) - own[(k) * n + j]) \
    }
#if defined(__GNUC__) && !defined(__clang__)
#pragma GCC ivdep /* the rows of one array do not overlap */
#endif
    for (j = 0; j < n; ++j) {
        const double x = z[LENGTH * n + j], v = z[SPEED * n + j];
        const double forced = elastic[j] + along * x + softened * longest[j];
        double pull = force[j] - c->held * elastic[j] + stiff * x - held_m * longest[j] -
                      damping * v + acting * charge[j];
        RELAX(0)
        RELAX(1)
        RELAX(2)
        RELAX(3)
        if (drags) {
            const double h = z[HYSTERESIS * n + j];
            pull -= h;
            ADD(HYSTERESIS, direct[OF_HYSTERESIS * n + j] + turning * v - slipping * h)
        }
        if (late) {
            ADD(CHARGE, direct[OF_CHARGE * n + j] - per_charge_s * charge[j])
        }
        ADD(LENGTH, v)
        ADD(SPEED, pull * per_kg)
    }
#undef RELAX
#undef ADD
}

#define RATES(name, late, drags) \
    HS_CLONES static void name(const motion_parameters *p, const constants *c, const slopes *d, \
                               int above, int32_t n, const double *restrict direct, \
                               const double *restrict rows, const double *restrict z, double next, \
                               double share, double *restrict at, double *restrict sum) \
    { \
        linear_rates(p, c, d, above, n, direct, rows, z, next, share, at, sum, late, drags); \
    }
RATES(usual_rates, 0, 0)
RATES(late_rates, 1, 0)
RATES(dragging_rates, 0, 1)
RATES(all_rates, 1, 1)
#undef RATES

/* ---- one stage of a step ---- */

static void tangent_stage(const motion_law *law, const motion_parameters *p, const constants *c,
                          const motion_state *s, motion_tangent *t, const rates *r, course *along,
                          const motion_input *in, int stage, double dt)
{
    static const double next[4] = {0.5, 0.5, 1.0, 0.0};
    static const double share[4] = {1.0 / 6.0, 1.0 / 3.0, 1.0 / 3.0, 1.0 / 6.0};
    const int32_t n = t->columns, size = MOTION_ROWS * n;
    const size_t bytes = (size_t)size * sizeof *t->rows;
    double *odd = t->work, *even = odd + size, *sum = even + size, *direct = sum + size;
    /* the first stage reads the state itself, then these two take turns */
    const double *z = stage == 0 ? t->rows : stage == 2 ? even : odd;
    double *at = stage == 1 || stage == 3 ? even : odd;
    slopes d;
    if (stage == 0) {
        along->softens = softening_by(p, along->softening, s->longest_m);
        memcpy(sum, t->rows, bytes);
    }
    weigh(&along->at.along);
    d = slopes_of(law, p, s, along, r);
    direct_rates(law, p, c, s, t, r, &along->at, &d, in, direct);
    (c->is_late ? c->drags ? all_rates : late_rates : c->drags ? dragging_rates : usual_rates)(
        p, c, &d, s->length_m > s->longest_m, n, direct, t->rows, z, dt * next[stage],
        dt * share[stage], at, sum);
    if (stage == 3) {
        memcpy(t->rows, sum, bytes);
    }
}

#endif
