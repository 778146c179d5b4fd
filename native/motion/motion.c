/* Takes: a law's table, parameters, a state and what acts on it. Gives: the state a step later. */
#include "motion/motion.h"

#include <math.h>
#include <stddef.h>
#include <string.h>

#define KINK_SHARE 1e-6 /* of a step: a kink nearer to its ends does not cut it */
#define TURNING_STEPS 3

#ifndef HS_CLONES
#define HS_CLONES
#endif

#include "motion/knots.h"

/* ---- the law ---- */

double motion_elastic(const motion_law *law, double length_m)
{
    const cubic c = at_length(law, length_m);
    return dot4(c.weight, law->elastic_n + c.first);
}

double motion_gap(const motion_law *law, double length_m)
{
    const cubic c = at_length(law, length_m);
    return dot4(c.weight, law->gap_m + c.first);
}

double motion_capacitance(const motion_law *law, double length_m, double voltage_v)
{
    const place at = place_at(law, length_m, voltage_v);
    return value_at(law, law->capacitance_f[0], MOTION_LENGTHS, &at);
}

motion_capacitance_slopes motion_capacitance_by(const motion_law *law, const motion_tangent *t,
                                                double length_m, double voltage_v, double *by)
{
    const place at = place_at(law, length_m, voltage_v);
    const surface found = surface_at(law, law->capacitance_f, &at, voltage_v);
    const motion_capacitance_slopes slopes = {found.value, found.per_m, found.per_v};
    values_by(law, t->capacitance, t->laws, &at, by);
    return slopes;
}

double motion_softening(const motion_parameters *p, double longest_m)
{
    const double reached = longest_m / p->free_length_m;
    if (!(p->softening_share > 0.0)) {
        return 1.0;
    }
    return 1.0 + p->softening_share /
                     (1.0 + exp((reached - p->softening_stretch) / p->softening_width));
}

void motion_rest(const motion_law *law, const motion_parameters *p, motion_state *s,
                 double length_m, double longest_m)
{
    int k;
    memset(s, 0, sizeof *s);
    s->length_m = length_m;
    s->longest_m = longest_m > length_m ? longest_m : length_m;
    for (k = 0; k < MOTION_BRANCHES; ++k) {
        s->relaxed_n[k] = motion_elastic(law, length_m) * motion_softening(p, s->longest_m);
    }
}

/* ---- rates ---- */

/* What a step takes from the parameters again and again. */
typedef struct {
    double held;                       /* 1 + all branch shares */
    double per_branch_s[MOTION_BRANCHES]; /* 0 where there is no branch */
    double per_kg, per_charge_s;       /* per_charge_s: 0 where no voltage acts late */
} constants;

static constants constants_of(const motion_parameters *p)
{
    constants c = {1.0, {0.0}, 1.0 / p->inertia_kg, 0.0};
    int k;
    for (k = 0; k < MOTION_BRANCHES; ++k) {
        if (p->branch_share[k] > 0.0) {
            c.held += p->branch_share[k];
            c.per_branch_s[k] = 1.0 / p->branch_s[k];
        }
    }
    c.per_charge_s = p->charge_share > 0.0 ? 1.0 / p->charge_s : 0.0;
    return c;
}

/* Length over which the hysteretic force follows a reversal. */
static double slip_m(const motion_parameters *p) { return p->hysteresis_width * p->free_length_m; }

/* Rates of the state, and what their derivatives need. */
typedef struct {
    double speed, acceleration, relaxed[MOTION_BRANCHES], charge, hysteresis;
    place at;
    double elastic, softening; /* their product is the elastic force */
    double pull;               /* electric force over the voltage squared */
    double square;             /* mean square of the voltage that acts */
    double acting_v;
} rates;

/* What one smooth step takes for granted: softening at its begin, and the sign of the speed. */
typedef struct {
    double softening, sign;
} course;

static rates rates_of(const motion_law *law, const motion_parameters *p, const constants *c,
                      const motion_state *s, const course *along, const motion_input *in)
{
    double force;
    rates r;
    int k;
    r.softening =
        s->length_m > s->longest_m ? motion_softening(p, s->length_m) : along->softening;
    r.acting_v = (1.0 - p->charge_share) * in->volt + p->charge_share * s->charge_v;
    r.square = r.acting_v * r.acting_v + in->ripple_v2;
    r.at = place_at(law, s->length_m, law->voltages > 1 ? sqrt(r.square) : 0.0);
    r.elastic = p->elastic_scale * dot4(r.at.along.weight, law->elastic_n + r.at.along.first);
    r.pull = value_at(law, law->pull_n_v2[0], MOTION_LENGTHS, &r.at);
    force = r.elastic * r.softening;
    r.acceleration = in->load_n + r.square * r.pull - p->damping_n_s_m * s->speed_m_s;
    for (k = 0; k < MOTION_BRANCHES; ++k) {
        r.acceleration += p->branch_share[k] * s->relaxed_n[k];
        r.relaxed[k] = (force - s->relaxed_n[k]) * c->per_branch_s[k];
    }
    r.hysteresis = 0.0;
    if (p->hysteresis_n > 0.0) {
        r.acceleration -= s->hysteresis_n;
        r.hysteresis = (p->hysteresis_n - along->sign * s->hysteresis_n) * s->speed_m_s / slip_m(p);
    }
    r.acceleration = (r.acceleration - c->held * force) * c->per_kg;
    r.speed = s->speed_m_s;
    r.charge = (in->volt - s->charge_v) * c->per_charge_s;
    return r;
}

static motion_state moved(const motion_state *s, const rates *r, double dt)
{
    motion_state m = *s;
    int k;
    m.length_m += dt * r->speed;
    m.speed_m_s += dt * r->acceleration;
    for (k = 0; k < MOTION_BRANCHES; ++k) {
        m.relaxed_n[k] += dt * r->relaxed[k];
    }
    m.charge_v += dt * r->charge;
    m.hysteresis_n += dt * r->hysteresis;
    return m;
}

/* ---- derivatives ---- */

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
                        const rates *r, double sign)
{
    const double root = law->voltages > 1 ? sqrt(r->square) : 0.0;
    const surface pull = surface_at(law, law->pull_n_v2, &r->at, root);
    slopes d = {0};
    d.longest_m = s->length_m > s->longest_m ? s->length_m : s->longest_m;
    if (p->softening_share > 0.0) {
        const double at = (d.longest_m / p->free_length_m - p->softening_stretch);
        d.share = (r->softening - 1.0) / p->softening_share;
        d.reached = -(r->softening - 1.0) * (1.0 - d.share) / p->softening_width;
        d.stretch = -d.reached;
        d.width = -d.reached * at / p->softening_width;
    }
    d.elastic = dot4(r->at.along.slope, law->elastic_n + r->at.along.first) / law->step_m;
    d.elastic *= p->elastic_scale * r->softening;
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
                         const slopes *d, const motion_input *in, const direct *to)
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
    add_knots(r->at.along.weight, tangent->elastic + (int64_t)r->at.along.first * laws, laws,
              by_elastic);
    values_by(law, tangent->pull, laws, &r->at, by_pull);
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
                                   const direct *by, int above, int32_t n, const double *z,
                                   double *out)
{
    const double *x = z + LENGTH * n, *v = z + SPEED * n, *charge = z + CHARGE * n;
    const double *longest = above ? x : z + LONGEST * n;
    const double acting = d->acting * p->charge_share, damping = p->damping_n_s_m;
    const double stiff = d->pull - c->held * d->elastic, held_m = c->held * d->softening;
    const double per_kg = c->per_kg;
    int32_t j;
    int k;
    for (j = 0; j < n; ++j) {
        out[LENGTH * n + j] = v[j];
        out[SPEED * n + j] = by->force[j] + stiff * x[j] - held_m * longest[j] - damping * v[j] +
                             acting * charge[j];
        out[CHARGE * n + j] = by->charge[j] - c->per_charge_s * charge[j];
        out[LONGEST * n + j] = 0.0;
    }
    for (k = 0; k < MOTION_BRANCHES; ++k) {
        const double *y = z + (RELAXED + k) * n;
        const double share = p->branch_share[k], rate = c->per_branch_s[k];
        for (j = 0; j < n; ++j) {
            out[SPEED * n + j] += share * y[j];
            out[(RELAXED + k) * n + j] =
                rate * (by->elastic[j] + d->elastic * x[j] + d->softening * longest[j] - y[j]);
        }
    }
    if (p->hysteresis_n > 0.0) {
        const double *h = z + HYSTERESIS * n;
        for (j = 0; j < n; ++j) {
            out[SPEED * n + j] -= h[j];
            out[HYSTERESIS * n + j] =
                by->hysteresis[j] + d->turning * v[j] - d->slipping * h[j];
        }
    }
    for (j = 0; j < n; ++j) {
        out[SPEED * n + j] *= per_kg;
    }
}

/* ---- steps ---- */

HS_CLONES static void add_stage(int32_t size, const double *rows, const double *rate, double next,
                                double share, int first, double *at, double *sum)
{
    const double *before = first ? rows : sum;
    int32_t j;
    for (j = 0; j < size; ++j) {
        sum[j] = before[j] + share * rate[j];
        at[j] = rows[j] + next * rate[j];
    }
}

static void tangent_stage(const motion_law *law, const motion_parameters *p, const constants *c,
                          const motion_state *s, motion_tangent *t, const rates *r, double sign,
                          const motion_input *in, int stage, double dt)
{
    static const double next[4] = {0.5, 0.5, 1.0, 0.0};
    static const double share[4] = {1.0 / 6.0, 1.0 / 3.0, 1.0 / 3.0, 1.0 / 6.0};
    const int32_t n = t->columns, size = rows_of(p) * n;
    double *rate = t->work, *at = t->work + size, *sum = t->work + 2 * size;
    const direct by = {sum + size, sum + size + n, sum + size + 2 * n, sum + size + 3 * n};
    const slopes d = slopes_of(law, p, s, r, sign);
    int32_t j;
    direct_rates(law, p, c, s, t, r, &d, in, &by);
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

/* One step without looking for events, in which the speed has a sign; the state's longest length
 * follows at the end. */
static void smooth_step(const motion_law *law, const motion_parameters *p, motion_state *s,
                        motion_tangent *tangent, double sign, const motion_input *in, double dt)
{
    static const double to[4] = {0.5, 0.5, 1.0, 0.0};
    const course along = {motion_softening(p, s->longest_m), sign};
    const constants c = constants_of(p);
    const motion_state start = *s;
    motion_state at = *s;
    rates r[4];
    int stage, k;
    for (stage = 0; stage < 4; ++stage) {
        r[stage] = rates_of(law, p, &c, &at, &along, in);
        if (tangent != NULL) {
            tangent_stage(law, p, &c, &at, tangent, &r[stage], sign, in, stage, dt);
        }
        at = moved(&start, &r[stage], dt * to[stage]);
    }
#define MEAN(field) ((r[0].field + 2.0 * (r[1].field + r[2].field) + r[3].field) * (dt / 6.0))
    s->length_m += MEAN(speed);
    s->speed_m_s += MEAN(acceleration);
    for (k = 0; k < MOTION_BRANCHES; ++k) {
        s->relaxed_n[k] += MEAN(relaxed[k]);
    }
    s->charge_v += MEAN(charge);
    s->hysteresis_n += MEAN(hysteresis);
#undef MEAN
    if (s->length_m > s->longest_m) {
        s->longest_m = s->length_m;
        if (tangent != NULL) {
            const size_t n = (size_t)tangent->columns;
            memcpy(tangent->rows + LONGEST * n, tangent->rows + LENGTH * n, n * sizeof(double));
        }
    }
}

double motion_between(const motion_state *a, const motion_state *b, double dt, double share)
{
    const double t = share, u = 1.0 - share;
    return u * u * ((1.0 + 2.0 * t) * a->length_m + t * dt * a->speed_m_s) +
           t * t * ((1.0 + 2.0 * u) * b->length_m - u * dt * b->speed_m_s);
}

/* Share of the step from a to b at which the length passes the longest one (`turns` 0), or at which
 * it turns. */
static double share_before(const motion_state *a, const motion_state *b, double dt, int turns)
{
    double low = 0.0, high = 1.0;
    int k;
    for (k = 0; k < 40; ++k) {
        const double middle = 0.5 * (low + high);
        const double near = motion_between(a, b, dt, middle - 1e-4);
        const double far = motion_between(a, b, dt, middle + 1e-4);
        const int grows = a->speed_m_s < 0.0 ? far < near : far > near;
        const int before = turns ? grows : 0.5 * (near + far) < a->longest_m;
        low = before ? middle : low;
        high = before ? high : middle;
    }
    return 0.5 * (low + high);
}

/* Share at which the softening begins or ends; 1 where it does neither inside. */
static double softening_between(const motion_state *a, const motion_state *b, double dt)
{
    const int above = !(a->length_m < a->longest_m) && a->speed_m_s > 0.0;
    if (above ? b->speed_m_s >= 0.0 : !(a->length_m < a->longest_m && b->length_m > a->longest_m)) {
        return 1.0;
    }
    return share_before(a, b, dt, above);
}

/* Share of the step to b at which the speed is 0, by the secant from where Hermite's cubic turns. */
static double turning_between(const motion_law *law, const motion_parameters *p,
                              const motion_state *a, const motion_state *b, double sign,
                              const motion_input *in, double dt)
{
    double share = share_before(a, b, dt, 1), last = 1.0, last_m_s = b->speed_m_s;
    int k;
    for (k = 0; k < TURNING_STEPS && share > 0.0 && share < 1.0; ++k) {
        motion_state at = *a;
        double next;
        smooth_step(law, p, &at, NULL, sign, in, share * dt);
        if (at.speed_m_s == last_m_s) {
            break;
        }
        next = share - at.speed_m_s * (share - last) / (at.speed_m_s - last_m_s);
        last = share;
        last_m_s = at.speed_m_s;
        share = next;
    }
    return share;
}

/* One step, cut where the softening or the hysteresis has a kink. */
static void cut_step(const motion_law *law, const motion_parameters *p, motion_state *s,
                     motion_tangent *tangent, const motion_input *in, double dt)
{
    const double sign = s->speed_m_s < 0.0 ? -1.0 : 1.0;
    double after = sign, share = 1.0;
    motion_state end = *s;
    smooth_step(law, p, &end, NULL, sign, in, dt);
    if (p->softening_share > 0.0) {
        share = softening_between(s, &end, dt);
    }
    if (p->hysteresis_n > 0.0 && sign * end.speed_m_s < 0.0) {
        const double turns = turning_between(law, p, s, &end, sign, in, dt);
        if (s->length_m < s->longest_m && share < turns && share > KINK_SHARE) {
            smooth_step(law, p, s, tangent, sign, in, share * dt);
            cut_step(law, p, s, tangent, in, (1.0 - share) * dt);
            return;
        }
        share = turns; /* which is also where the softening ends, beyond the longest length */
        after = -sign;
    }
    if (share > KINK_SHARE && share < 1.0 - KINK_SHARE) {
        smooth_step(law, p, s, tangent, sign, in, share * dt);
        smooth_step(law, p, s, tangent, after, in, (1.0 - share) * dt);
    } else if (tangent == NULL && (after == sign || share > 0.5)) {
        *s = end;
    } else {
        smooth_step(law, p, s, tangent, share < 0.5 ? after : sign, in, dt);
    }
}

void motion_step(const motion_law *law, const motion_parameters *p, motion_state *s,
                 motion_tangent *tangent, const motion_input *in, double dt)
{
    if (p->hysteresis_n > 0.0 ||
        (p->softening_share > 0.0 && s->length_m + 2.0 * dt * fabs(s->speed_m_s) > s->longest_m)) {
        cut_step(law, p, s, tangent, in, dt);
    } else {
        smooth_step(law, p, s, tangent, 1.0, in, dt);
    }
}

int32_t motion_steps(const motion_law *law, const motion_parameters *p, const motion_state *s,
                     double duration_s)
{
    const cubic c = at_length(law, s->length_m);
    double taut = 1.0 + p->softening_share, stiffness, fastest, step_s = p->step_s, wanted;
    int k;
    fastest = p->damping_n_s_m / p->inertia_kg;
    for (k = 0; k < MOTION_BRANCHES; ++k) {
        if (p->branch_share[k] > 0.0) {
            taut += p->branch_share[k];
            fastest = fastest > 1.0 / p->branch_s[k] ? fastest : 1.0 / p->branch_s[k];
        }
    }
    stiffness = fabs(dot4(c.slope, law->elastic_n + c.first)) / law->step_m * taut;
    if (p->hysteresis_n > 0.0) {
        stiffness += 2.0 * p->hysteresis_n / slip_m(p);
        fastest = fmax(fastest, fabs(s->speed_m_s) / slip_m(p));
    }
    fastest = fmax(fastest, sqrt(stiffness / p->inertia_kg));
    step_s = fmin(step_s, p->phase / fastest);
    wanted = ceil(duration_s / step_s - 1e-9);
    return wanted > 1.0 ? (int32_t)fmin(wanted, 1e9) : 1;
}

void motion_advance(const motion_law *law, const motion_parameters *p, motion_state *s,
                    motion_tangent *tangent, const motion_input *in, double duration_s)
{
    const int32_t steps = motion_steps(law, p, s, duration_s);
    int32_t k;
    for (k = 0; k < steps; ++k) {
        motion_step(law, p, s, tangent, in, duration_s / (double)steps);
    }
}
