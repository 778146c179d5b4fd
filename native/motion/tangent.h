/* Derivatives of one stage of a step: for motion.c alone, which includes it once, after its rates. */
#ifndef MOTION_TANGENT_H
#define MOTION_TANGENT_H

enum { LENGTH, SPEED, CHARGE, LONGEST, RELAXED, HYSTERESIS = RELAXED + MOTION_BRANCHES };

/* Rows in use: without hysteresis, its derivatives are 0. */
static int32_t rows_of(const motion_parameters *p)
{
    return p->hysteresis_n > 0.0 ? MOTION_ROWS : HYSTERESIS;
}

/* Slopes that all columns share. */
typedef struct {
    double elastic, softening;  /* of the elastic force by length and by longest length */
    double pull, acting;        /* of the electric force by length and by the acting voltage */
    double square;              /* of the electric force by the square of that voltage */
    double share, stretch, width, reached; /* of the factor of softening */
    double turning, slipping;   /* of the rate of hysteresis by speed; less that by its force */
    double longest_m;
} slopes;

static slopes slopes_of(const motion_law *law, const motion_parameters *p, const motion_state *s,
                        const course *along, const rates *r)
{
    const double root = law->voltages > 1 ? sqrt(r->square) : 0.0, sign = along->sign;
    const surface pull = surface_at(law, law->pull_n_v2, &along->at, root);
    slopes d = {0};
    d.longest_m = s->length_m > s->longest_m ? s->length_m : s->longest_m;
    if (p->softening_share > 0.0) {
        const double at = (d.longest_m / p->free_length_m - p->softening_stretch);
        d.share = (r->softening - 1.0) / p->softening_share;
        d.reached = -(r->softening - 1.0) * (1.0 - d.share) / p->softening_width;
        d.stretch = -d.reached;
        d.width = -d.reached * at / p->softening_width;
    }
    d.elastic = slope_along(law, law->elastic_n, &along->at.along) * p->elastic_scale * r->softening;
    d.softening = r->elastic * d.reached / p->free_length_m;
    d.pull = r->square * pull.per_m;
    d.square = r->pull + 0.5 * root * pull.per_v;
    d.acting = 2.0 * r->acting_v * d.square;
    if (p->hysteresis_n > 0.0) {
        d.turning = (p->hysteresis_n - sign * s->hysteresis_n) / slip_m(p);
        d.slipping = sign * s->speed_m_s / slip_m(p);
    }
    return d;
}

/* What each parameter does directly, at equal states: to the forces (pull less elastic ones), to
 * the elastic force alone, and to the rates of charge and hysteresis. One value a column. */
typedef struct {
    double *force, *elastic, *charge, *hysteresis;
} direct;

static void direct_rates(const motion_law *law, const motion_parameters *p, const constants *c,
                         const motion_state *s, const motion_tangent *tangent, const rates *r,
                         const place *at, const slopes *d, const motion_input *in,
                         const direct *to)
{
    const int32_t n = tangent->columns, laws = tangent->laws;
    double *by_elastic = to->hysteresis + n, *by_pull = by_elastic + laws;
    const double softens =
        -d->reached * d->longest_m / (p->free_length_m * p->free_length_m) * r->elastic;
    int32_t j;
    memset(to->force, 0, 4 * (size_t)n * sizeof(double)); /* all four: they lie side by side */
    for (j = 0; j < n; ++j) {
        const int32_t kind = tangent->kind[j];
        if (kind <= MOTION_START) {
            continue;
        }
        if (kind >= MOTION_BRANCH_SHARE && kind < MOTION_BRANCH_S) {
            to->force[j] = s->relaxed_n[kind - MOTION_BRANCH_SHARE] - r->elastic * r->softening;
        } else if (kind == MOTION_DAMPING) {
            to->force[j] = -s->speed_m_s;
        } else if (kind == MOTION_INERTIA) {
            to->force[j] = -r->acceleration;
        } else if (kind == MOTION_SOFTENING_SHARE) {
            to->elastic[j] = d->share * r->elastic;
        } else if (kind == MOTION_SOFTENING_STRETCH) {
            to->elastic[j] = d->stretch * r->elastic;
        } else if (kind == MOTION_SOFTENING_WIDTH) {
            to->elastic[j] = d->width * r->elastic;
        } else if (kind == MOTION_CHARGE_SHARE) {
            to->force[j] = d->acting * (s->charge_v - in->volt);
        } else if (kind == MOTION_CHARGE_S) {
            to->charge[j] = -r->charge * c->per_charge_s;
        } else if (kind == MOTION_HYSTERESIS_N) {
            to->hysteresis[j] = s->speed_m_s / slip_m(p);
        } else if (kind == MOTION_HYSTERESIS_WIDTH) {
            to->hysteresis[j] = -r->hysteresis / p->hysteresis_width;
        } else if (kind == MOTION_VOLTAGE_SCALE) {
            to->force[j] = d->acting * (1.0 - p->charge_share) * in->volt;
            to->charge[j] = in->volt * c->per_charge_s;
        } else if (kind == MOTION_ELASTIC_DRIFT || kind == MOTION_ELASTIC_DRIFT_S) {
            to->elastic[j] =
                tangent->drift[kind - MOTION_ELASTIC_DRIFT] * r->elastic * r->softening;
        } else if (kind == MOTION_ELECTRIC_DRIFT || kind == MOTION_ELECTRIC_DRIFT_S) {
            const double share = tangent->drift[kind - MOTION_ELASTIC_DRIFT];
            to->force[j] = share * (0.5 * d->acting * (1.0 - p->charge_share) * in->volt +
                                    d->square * in->ripple_v2);
            to->charge[j] = 0.5 * share * in->volt * c->per_charge_s;
        }
    }
    memset(by_elastic, 0, (size_t)laws * sizeof(double));
    add_knots(at->along.weight, tangent->elastic + (int64_t)at->along.first * laws, laws,
              by_elastic);
    values_by(law, tangent->pull, laws, at, by_pull);
    for (j = 0; j < laws; ++j) {
        const int32_t column = tangent->law_column[j];
        to->elastic[column] =
            r->softening * p->elastic_scale * by_elastic[j] + softens * tangent->free_length[j];
        to->force[column] = r->square * by_pull[j];
        if (p->hysteresis_n > 0.0) {
            to->hysteresis[column] = -r->hysteresis * tangent->free_length[j] / p->free_length_m;
        }
    }
    for (j = 0; j < n; ++j) {
        to->force[j] -= c->held * to->elastic[j];
    }
}

/* Rates of the derivatives `z`. Row LONGEST of `out` has no rate: the longest length follows the
 * length. */
HS_CLONES static void linear_rates(const motion_parameters *p, const constants *c, const slopes *d,
                                   const direct *by, int above, int32_t n, const double *restrict z,
                                   double *restrict out)
{
    const double *x = z + LENGTH * n, *v = z + SPEED * n, *charge = z + CHARGE * n;
    const double *longest = above ? x : z + LONGEST * n;
    const double *force = by->force, *elastic = by->elastic, *late = by->charge;
    const double acting = d->acting * p->charge_share, damping = p->damping_n_s_m;
    const double stiff = d->pull - c->held * d->elastic, held_m = c->held * d->softening;
    const double per_kg = c->per_kg, per_charge_s = c->per_charge_s;
    const double along = d->elastic, softened = d->softening;
    double *rise = out + LENGTH * n, *pull = out + SPEED * n, *charged = out + CHARGE * n;
    int32_t j;
    int k;
    for (j = 0; j < n; ++j) {
        rise[j] = v[j];
        pull[j] = force[j] + stiff * x[j] - held_m * longest[j] - damping * v[j] +
                  acting * charge[j];
        charged[j] = late[j] - per_charge_s * charge[j];
    }
    memset(out + LONGEST * n, 0, (size_t)n * sizeof *out);
    for (k = 0; k < MOTION_BRANCHES; ++k) {
        const double *y = z + (RELAXED + k) * n;
        const double share = p->branch_share[k], rate = c->per_branch_s[k];
        double *relaxed = out + (RELAXED + k) * n;
        for (j = 0; j < n; ++j) {
            pull[j] += share * y[j];
            relaxed[j] = rate * (elastic[j] + along * x[j] + softened * longest[j] - y[j]);
        }
    }
    if (p->hysteresis_n > 0.0) {
        const double *h = z + HYSTERESIS * n, *slip = by->hysteresis;
        const double turning = d->turning, slipping = d->slipping;
        double *turned = out + HYSTERESIS * n;
        for (j = 0; j < n; ++j) {
            pull[j] -= h[j];
            turned[j] = slip[j] + turning * v[j] - slipping * h[j];
        }
    }
    for (j = 0; j < n; ++j) {
        pull[j] *= per_kg;
    }
}

/* ---- one stage of a step ---- */

HS_CLONES static void add_stage(int32_t size, const double *restrict rows,
                                const double *restrict rate, double next, double share, int first,
                                double *restrict at, double *restrict sum)
{
    int32_t j;
    for (j = 0; j < size; ++j) {
        sum[j] = (first ? rows[j] : sum[j]) + share * rate[j];
        at[j] = rows[j] + next * rate[j];
    }
}

static void tangent_stage(const motion_law *law, const motion_parameters *p, const constants *c,
                          const motion_state *s, motion_tangent *t, const rates *r, course *along,
                          const motion_input *in, int stage, double dt)
{
    static const double next[4] = {0.5, 0.5, 1.0, 0.0};
    static const double share[4] = {1.0 / 6.0, 1.0 / 3.0, 1.0 / 3.0, 1.0 / 6.0};
    const int32_t n = t->columns, size = rows_of(p) * n;
    double *rate = t->work, *at = t->work + size, *sum = t->work + 2 * size;
    const direct by = {sum + size, sum + size + n, sum + size + 2 * n, sum + size + 3 * n};
    slopes d;
    int32_t j;
    weigh(&along->at.along);
    d = slopes_of(law, p, s, along, r);
    direct_rates(law, p, c, s, t, r, &along->at, &d, in, &by);
    linear_rates(p, c, &d, &by, s->length_m > s->longest_m, n, stage == 0 ? t->rows : at, rate);
    for (j = 0; j < n; ++j) {
        const int32_t k = t->kind[j] - MOTION_BRANCH_S;
        if (k >= 0) {
            rate[(RELAXED + k) * n + j] -= r->relaxed[k] * c->per_branch_s[k];
        }
    }
    add_stage(size, t->rows, rate, dt * next[stage], dt * share[stage], stage == 0, at, sum);
    if (stage == 3) {
        memcpy(t->rows, sum, (size_t)size * sizeof *sum);
    }
}

#endif
