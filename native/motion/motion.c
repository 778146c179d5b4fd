/* Takes: a law's table, parameters, a state and what acts on it. Gives: the state a step later. */
#include "motion/motion.h"

#include <math.h>
#include <stddef.h>
#include <string.h>

#ifndef HS_CLONES
#define HS_CLONES
#endif

/* ---- the law between its knots ---- */

typedef struct {
    int32_t first;
    double weight[4], slope[4]; /* slope: of the weights, per knot */
} cubic;

/* Lagrange's cubic through the four knots about `at`, counted in knots; constant beyond the ends. */
static cubic cubic_at(double at, int32_t knots)
{
    const double last = (double)(knots - 1);
    const double inside = at > 0.0 ? (at < last ? at : last) : 0.0;
    int32_t i = (int32_t)inside;
    cubic c;
    double t, u, v, w;
    i = i < 1 ? 1 : i > knots - 3 ? knots - 3 : i;
    t = inside - (double)i;
    u = t - 1.0;
    v = t - 2.0;
    w = t + 1.0;
    c.first = i - 1;
    c.weight[0] = -t * u * v / 6.0;
    c.weight[1] = w * u * v / 2.0;
    c.weight[2] = -w * t * v / 2.0;
    c.weight[3] = w * t * u / 6.0;
    c.slope[0] = -(u * v + t * v + t * u) / 6.0;
    c.slope[1] = (u * v + w * v + w * u) / 2.0;
    c.slope[2] = -(t * v + w * v + w * t) / 2.0;
    c.slope[3] = (t * u + w * u + w * t) / 6.0;
    return c;
}

static double dot4(const double *w, const double *v)
{
    return w[0] * v[0] + w[1] * v[1] + w[2] * v[2] + w[3] * v[3];
}

static cubic at_length(const motion_law *law, double length_m)
{
    return cubic_at((length_m - law->low_m) / law->step_m, law->lengths);
}

/* Where a length and a voltage lie in the tables. */
typedef struct {
    cubic along, across; /* across: unused where nothing depends on the voltage */
} place;

static place place_at(const motion_law *law, double length_m, double voltage_v)
{
    place at = {at_length(law, length_m), {0, {0.0}, {0.0}}};
    if (law->voltages > 1) {
        at.across = cubic_at(fabs(voltage_v) / law->step_v, law->voltages);
    }
    return at;
}

/* Value of rows of `stride` knots each. */
static double value_at(const motion_law *law, const double *rows, int64_t stride, const place *at)
{
    const double *first = rows + at->along.first;
    double sum = 0.0;
    int k;
    if (law->voltages == 1) {
        return dot4(at->along.weight, first);
    }
    for (k = 0; k < 4; ++k) {
        sum += at->across.weight[k] * dot4(at->along.weight, first + (at->across.first + k) * stride);
    }
    return sum;
}

/* Values of `n` tables whose knots lie side by side. */
HS_CLONES static void add_knots(const double *weight, const double *first, int32_t n, double *out)
{
    int32_t j;
    for (j = 0; j < n; ++j) {
        out[j] += weight[0] * first[j] + weight[1] * first[n + j] + weight[2] * first[2 * n + j] +
                  weight[3] * first[3 * n + j];
    }
}

static void values_by(const motion_law *law, const double *tables, int32_t n, const place *at,
                      double *out)
{
    const int64_t row = (int64_t)law->lengths * n;
    const double *first = tables + (int64_t)at->along.first * n;
    int k, i;
    memset(out, 0, (size_t)n * sizeof *out);
    if (law->voltages == 1) {
        add_knots(at->along.weight, first, n, out);
        return;
    }
    for (k = 0; k < 4; ++k) {
        double weight[4];
        for (i = 0; i < 4; ++i) {
            weight[i] = at->across.weight[k] * at->along.weight[i];
        }
        add_knots(weight, first + (at->across.first + k) * row, n, out);
    }
}

/* Value of a table of the law, and its slopes. */
typedef struct {
    double value, per_m, per_v;
} surface;

static surface surface_at(const motion_law *law, const double rows[][MOTION_LENGTHS],
                          const place *at, double voltage_v)
{
    surface s = {0.0, 0.0, 0.0};
    int k;
    if (law->voltages == 1) {
        s.value = dot4(at->along.weight, rows[0] + at->along.first);
        s.per_m = dot4(at->along.slope, rows[0] + at->along.first) / law->step_m;
        return s;
    }
    for (k = 0; k < 4; ++k) {
        const double *values = rows[at->across.first + k] + at->along.first;
        const double along = dot4(at->along.weight, values);
        s.value += at->across.weight[k] * along;
        s.per_m += at->across.weight[k] * dot4(at->along.slope, values) / law->step_m;
        s.per_v += at->across.slope[k] * along / law->step_v;
    }
    s.per_v = voltage_v < 0.0 ? -s.per_v : s.per_v;
    return s;
}

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

/* Rates of the state, and what their derivatives need. */
typedef struct {
    double speed, acceleration, relaxed[MOTION_BRANCHES], charge;
    place at;
    double elastic, softening; /* their product is the elastic force */
    double pull;               /* electric force over the voltage squared */
    double square;             /* mean square of the voltage that acts */
    double acting_v;
} rates;

static rates rates_of(const motion_law *law, const motion_parameters *p, const constants *c,
                      const motion_state *s, double softening, const motion_input *in)
{
    double force;
    rates r;
    int k;
    r.softening =
        s->length_m > s->longest_m ? motion_softening(p, s->length_m) : softening;
    r.acting_v = (1.0 - p->charge_share) * in->volt + p->charge_share * s->charge_v;
    r.square = r.acting_v * r.acting_v + in->ripple_v2;
    r.at = place_at(law, s->length_m, law->voltages > 1 ? sqrt(r.square) : 0.0);
    r.elastic = dot4(r.at.along.weight, law->elastic_n + r.at.along.first);
    r.pull = value_at(law, law->pull_n_v2[0], MOTION_LENGTHS, &r.at);
    force = r.elastic * r.softening;
    r.acceleration = in->load_n + r.square * r.pull - p->damping_n_s_m * s->speed_m_s;
    for (k = 0; k < MOTION_BRANCHES; ++k) {
        r.acceleration += p->branch_share[k] * s->relaxed_n[k];
        r.relaxed[k] = (force - s->relaxed_n[k]) * c->per_branch_s[k];
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
    return m;
}

/* ---- derivatives ---- */

enum { LENGTH, SPEED, CHARGE, LONGEST, RELAXED };

/* Slopes that all columns share. */
typedef struct {
    double elastic, softening;  /* of the elastic force by length and by longest length */
    double pull, acting;        /* of the electric force by length and by the acting voltage */
    double share, stretch, width, reached; /* of the factor of softening */
    double longest_m;
} slopes;

static slopes slopes_of(const motion_law *law, const motion_parameters *p, const motion_state *s,
                        const rates *r)
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
    d.elastic *= r->softening;
    d.softening = r->elastic * d.reached / p->free_length_m;
    d.pull = r->square * pull.per_m;
    d.acting = 2.0 * r->acting_v * (r->pull + 0.5 * root * pull.per_v);
    return d;
}

/* What each parameter does directly, at equal states: to the forces (pull less elastic ones), to
 * the elastic force alone, and to the rate of the charge. One value a column. */
typedef struct {
    double *force, *elastic, *charge;
} direct;

static void direct_rates(const motion_law *law, const motion_parameters *p, const constants *c,
                         const motion_state *s, const motion_tangent *tangent, const rates *r,
                         const slopes *d, const motion_input *in, const direct *to)
{
    const int32_t n = tangent->columns, laws = tangent->laws;
    double *by_elastic = to->charge + n, *by_pull = by_elastic + laws;
    const double softens =
        -d->reached * d->longest_m / (p->free_length_m * p->free_length_m) * r->elastic;
    int32_t j;
    memset(to->force, 0, 3 * (size_t)n * sizeof(double)); /* all three: they lie side by side */
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
        } else if (kind == MOTION_VOLTAGE_SCALE) {
            to->force[j] = d->acting * (1.0 - p->charge_share) * in->volt;
            to->charge[j] = in->volt * c->per_charge_s;
        }
    }
    memset(by_elastic, 0, (size_t)laws * sizeof(double));
    add_knots(r->at.along.weight, tangent->elastic + (int64_t)r->at.along.first * laws, laws,
              by_elastic);
    values_by(law, tangent->pull, laws, &r->at, by_pull);
    for (j = 0; j < laws; ++j) {
        const int32_t column = tangent->law_column[j];
        to->elastic[column] = r->softening * by_elastic[j] + softens * tangent->free_length[j];
        to->force[column] = r->square * by_pull[j];
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
                          const motion_state *s, motion_tangent *t, const rates *r,
                          const motion_input *in, int stage, double dt)
{
    static const double next[4] = {0.5, 0.5, 1.0, 0.0};
    static const double share[4] = {1.0 / 6.0, 1.0 / 3.0, 1.0 / 3.0, 1.0 / 6.0};
    const int32_t n = t->columns, size = MOTION_ROWS * n;
    double *rate = t->work, *at = t->work + size, *sum = t->work + 2 * size;
    const direct by = {sum + size, sum + size + n, sum + size + 2 * n};
    const slopes d = slopes_of(law, p, s, r);
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

/* One step without looking for events; the state's longest length follows at the end. */
static void smooth_step(const motion_law *law, const motion_parameters *p, motion_state *s,
                        motion_tangent *tangent, const motion_input *in, double dt)
{
    static const double to[4] = {0.5, 0.5, 1.0, 0.0};
    const double softening = motion_softening(p, s->longest_m);
    const constants c = constants_of(p);
    const motion_state start = *s;
    motion_state at = *s;
    rates r[4];
    int stage, k;
    for (stage = 0; stage < 4; ++stage) {
        r[stage] = rates_of(law, p, &c, &at, softening, in);
        if (tangent != NULL) {
            tangent_stage(law, p, &c, &at, tangent, &r[stage], in, stage, dt);
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

/* Share of the step from a to b at which the length passes the longest one, or at which it turns;
 * 1 where neither happens inside. */
static double event_between(const motion_state *a, const motion_state *b, double dt)
{
    double low = 0.0, high = 1.0;
    const int above = !(a->length_m < a->longest_m) && a->speed_m_s > 0.0;
    int k;
    if (above ? b->speed_m_s >= 0.0 : !(a->length_m < a->longest_m && b->length_m > a->longest_m)) {
        return 1.0;
    }
    for (k = 0; k < 40; ++k) {
        const double middle = 0.5 * (low + high);
        const double near = motion_between(a, b, dt, middle - 1e-4);
        const double far = motion_between(a, b, dt, middle + 1e-4);
        const int before = above ? far > near : 0.5 * (near + far) < a->longest_m;
        low = before ? middle : low;
        high = before ? high : middle;
    }
    return 0.5 * (low + high);
}

void motion_step(const motion_law *law, const motion_parameters *p, motion_state *s,
                 motion_tangent *tangent, const motion_input *in, double dt)
{
    if (p->softening_share > 0.0 && s->length_m + 2.0 * dt * fabs(s->speed_m_s) > s->longest_m) {
        motion_state end = *s;
        double share;
        smooth_step(law, p, &end, NULL, in, dt);
        share = event_between(s, &end, dt);
        if (share > 1e-6 && share < 1.0 - 1e-6) {
            smooth_step(law, p, s, tangent, in, share * dt);
            smooth_step(law, p, s, tangent, in, (1.0 - share) * dt);
            return;
        }
        if (tangent == NULL) {
            *s = end;
            return;
        }
    }
    smooth_step(law, p, s, tangent, in, dt);
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
