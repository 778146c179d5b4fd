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

/* Into the vector code of the function that calls it. */
#define ALWAYS static inline __attribute__((always_inline))

#include "motion/knots.h"

/* ---- the law ---- */

double motion_elastic(const motion_law *law, double length_m)
{
    cubic c;
    locate_length(law, length_m, &c);
    weigh(&c);
    return dot4(c.weight, law->elastic_n + c.first);
}

double motion_gap(const motion_law *law, double length_m)
{
    cubic c;
    locate_length(law, length_m, &c);
    weigh(&c);
    return dot4(c.weight, law->gap_m + c.first);
}

double motion_capacitance(const motion_law *law, double length_m, double voltage_v)
{
    place at;
    place_at(law, length_m, voltage_v, &at);
    return value_at(law, law->capacitance_f, &at);
}

motion_capacitance_slopes motion_capacitance_by(const motion_law *law, const motion_tangent *t,
                                                double length_m, double voltage_v, double *by)
{
    motion_capacitance_slopes slopes;
    surface found;
    place at;
    place_at(law, length_m, voltage_v, &at);
    found = surface_at(law, law->capacitance_f, &at, voltage_v);
    slopes.value = found.value;
    slopes.per_m = found.per_m;
    slopes.per_v = found.per_v;
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
    int is_late, drags, softens;       /* whether there are charge, hysteresis, softening */
} constants;

static int is_simple(const motion_parameters *p)
{
    return !(p->charge_share > 0.0 || p->hysteresis_n > 0.0 || p->softening_share > 0.0);
}

/* `simple`: what `is_simple` says, as a number that the compiler knows. */
ALWAYS void prepare(const motion_parameters *p, int simple, constants *c)
{
    int k;
    c->is_late = !simple && p->charge_share > 0.0;
    c->drags = !simple && p->hysteresis_n > 0.0;
    c->softens = !simple && p->softening_share > 0.0;
    c->held = 1.0;
    for (k = 0; k < MOTION_BRANCHES; ++k) {
        const int is_one = p->branch_share[k] > 0.0;
        c->held += is_one ? p->branch_share[k] : 0.0;
        c->per_branch_s[k] = (is_one ? 1.0 : 0.0) / (is_one ? p->branch_s[k] : 1.0);
    }
    c->per_kg = 1.0 / p->inertia_kg;
    c->per_charge_s = c->is_late ? 1.0 / p->charge_s : 0.0;
}

/* Length over which the hysteretic force follows a reversal. */
static double slip_m(const motion_parameters *p) { return p->hysteresis_width * p->free_length_m; }

/* Rates of the state, and what their derivatives need. */
typedef struct {
    double speed, acceleration, relaxed[MOTION_BRANCHES], charge, hysteresis;
    double elastic, softening; /* their product is the elastic force */
    double pull;               /* electric force over the voltage squared */
    double square;             /* mean square of the voltage that acts */
    double acting_v;
} rates;

/* Derivatives of the factor of softening by its parameters and by the longest stretch. */
typedef struct {
    double longest_m, share, stretch, width, reached;
} softening_slopes;

/* What one smooth step takes for granted: softening at its begin, the sign of the speed, and the
 * forces between the two knots where it is. */
typedef struct {
    double softening, sign;
    softening_slopes softens; /* with a tangent */
    place at;
    double knot; /* the lower one of the two */
    polynomial elastic, pull;
} course;

ALWAYS double acting_v(const motion_parameters *p, const constants *c, const motion_input *in,
                       double charge_v)
{
    return !c->is_late ? in->volt : (1.0 - p->charge_share) * in->volt + p->charge_share * charge_v;
}

/* The forces at another place of the tables. */
ALWAYS void enter(const motion_law *law, double length_m, course *along)
{
    double values[4];
    locate_length(law, length_m, &along->at.along);
    along->knot = (double)(along->at.along.first + 1);
    along->elastic = through(law->elastic_n + along->at.along.first);
    blend_rows(law, law->pull_n_v2, along->at.along.first, &along->at.across, values);
    along->pull = through(values);
}

/* Where a length lies between the two knots, which are others if it has left them; the voltage
 * varies only with a charge that acts late. */
ALWAYS double follow_tables(const motion_law *law, const constants *c, double length_m,
                            double square, course *along)
{
    const double t = (length_m - law->low_m) * law->per_step_m - along->knot;
    if (law->voltages > 1 && c->is_late) {
        locate_voltage(law, sqrt(square), &along->at.across);
    } else if (t >= 0.0 && t < 1.0) {
        along->at.along.t = t;
        return t;
    }
    enter(law, length_m, along);
    return along->at.along.t;
}

/* In each sum, what a step knows early comes first: the processor need not wait for the tables. */
ALWAYS rates rates_of(const motion_law *law, const motion_parameters *p, const constants *c,
                      const motion_state *s, course *along, const motion_input *in)
{
    double force, known = in->load_n - p->damping_n_s_m * s->speed_m_s;
    double late[MOTION_BRANCHES], t;
    rates r;
    int k;
    r.softening = c->softens && s->length_m > s->longest_m ? motion_softening(p, s->length_m)
                                                           : along->softening;
    r.acting_v = acting_v(p, c, in, s->charge_v);
    r.square = r.acting_v * r.acting_v + in->ripple_v2;
    t = follow_tables(law, c, s->length_m, r.square, along);
    r.elastic = p->elastic_scale * polynomial_at(&along->elastic, t);
    r.pull = polynomial_at(&along->pull, t);
    force = r.elastic * r.softening;
    for (k = 0; k < MOTION_BRANCHES; ++k) {
        late[k] = p->branch_share[k] * s->relaxed_n[k];
        r.relaxed[k] = (force - s->relaxed_n[k]) * c->per_branch_s[k];
    }
    known += (late[0] + late[1]) + (late[2] + late[3]);
    r.hysteresis = 0.0;
    if (c->drags) {
        known -= s->hysteresis_n;
        r.hysteresis = (p->hysteresis_n - along->sign * s->hysteresis_n) * s->speed_m_s / slip_m(p);
    }
    r.acceleration = (known + (r.square * r.pull - c->held * force)) * c->per_kg;
    r.speed = s->speed_m_s;
    r.charge = c->is_late ? (in->volt - s->charge_v) * c->per_charge_s : 0.0;
    return r;
}

/* Field by field: a copy of the whole would wait for what was stored last. */
ALWAYS motion_state moved(const motion_state *s, const rates *r, double dt)
{
    motion_state m;
    int k;
    m.length_m = s->length_m + dt * r->speed;
    m.speed_m_s = s->speed_m_s + dt * r->acceleration;
    for (k = 0; k < MOTION_BRANCHES; ++k) {
        m.relaxed_n[k] = s->relaxed_n[k] + dt * r->relaxed[k];
    }
    m.charge_v = s->charge_v + dt * r->charge;
    m.longest_m = s->longest_m;
    m.hysteresis_n = s->hysteresis_n + dt * r->hysteresis;
    return m;
}

#include "motion/tangent.h"

/* ---- steps ---- */

ALWAYS void begin(const motion_law *law, const motion_parameters *p, const constants *c,
                  const motion_state *s, double sign, const motion_input *in, course *along)
{
    const double volt = acting_v(p, c, in, s->charge_v);
    along->softening = c->softens ? motion_softening(p, s->longest_m) : 1.0;
    along->sign = sign;
    locate_voltage(law, sqrt(volt * volt + in->ripple_v2), &along->at.across);
    enter(law, s->length_m, along);
}

/* One step without looking for events, in which the speed has a sign; the state's longest length
 * follows at the end. */
ALWAYS void smooth(const motion_law *law, const motion_parameters *p, motion_state *s,
                   motion_tangent *tangent, double sign, const motion_input *in, double dt,
                   int simple)
{
    constants c;
    course along;
    motion_state at;
    rates first, second, third, fourth;
    int k;
    prepare(p, simple, &c);
    begin(law, p, &c, s, sign, in, &along);
#define STAGE(number, state, rate) \
    rate = rates_of(law, p, &c, state, &along, in); \
    if (tangent != NULL) { \
        tangent_stage(law, p, &c, state, tangent, &rate, &along, in, number, dt); \
    }
    STAGE(0, s, first)
    at = moved(s, &first, 0.5 * dt);
    STAGE(1, &at, second)
    at = moved(s, &second, 0.5 * dt);
    STAGE(2, &at, third)
    at = moved(s, &third, dt);
    STAGE(3, &at, fourth)
#undef STAGE
#define MEAN(of) ((first.of + 2.0 * (second.of + third.of) + fourth.of) * (dt / 6.0))
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

HS_CLONES static void plain_step(const motion_law *law, const motion_parameters *p, motion_state *s,
                                 double sign, const motion_input *in, double dt)
{
    smooth(law, p, s, NULL, sign, in, dt, 0);
}

HS_CLONES static void simple_step(const motion_law *law, const motion_parameters *p,
                                  motion_state *s, const motion_input *in, double dt)
{
    smooth(law, p, s, NULL, 1.0, in, dt, 1);
}

static void smooth_step(const motion_law *law, const motion_parameters *p, motion_state *s,
                        motion_tangent *tangent, double sign, const motion_input *in, double dt)
{
    if (tangent != NULL) {
        smooth(law, p, s, tangent, sign, in, dt, 0);
    } else if (is_simple(p)) {
        simple_step(law, p, s, in, dt);
    } else {
        plain_step(law, p, s, sign, in, dt);
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

/* Largest sum of stiffnesses at this length, in N/m. */
static double stiffness_at(const motion_law *law, const motion_parameters *p, double length_m)
{
    cubic c;
    const double held = (p->branch_share[0] + p->branch_share[1]) +
                        (p->branch_share[2] + p->branch_share[3]);
    const double taut = 1.0 + p->softening_share + held;
    double elastic;
    locate_length(law, length_m, &c);
    elastic = fabs(slope_along(law, law->elastic_n, &c)) * taut;
    return p->hysteresis_n > 0.0 ? elastic + 2.0 * p->hysteresis_n / slip_m(p) : elastic;
}

/* As motion_steps, without division. */
static int fits(const motion_parameters *p, double stiffness, double duration_s)
{
    const double kg = p->phase * p->inertia_kg;
    int k, slow = duration_s <= p->step_s && duration_s * p->damping_n_s_m <= kg &&
                  duration_s * duration_s * stiffness <= p->phase * kg && !(p->hysteresis_n > 0.0);
    for (k = 0; k < MOTION_BRANCHES; ++k) {
        slow &= !(p->branch_share[k] > 0.0) || duration_s <= p->phase * p->branch_s[k];
    }
    return slow;
}

int motion_fits(const motion_law *law, const motion_parameters *p, const motion_state *s,
                double duration_s)
{
    return fits(p, stiffness_at(law, p, s->length_m), duration_s);
}

int32_t motion_steps(const motion_law *law, const motion_parameters *p, const motion_state *s,
                     double duration_s)
{
    const double stiffness = stiffness_at(law, p, s->length_m);
    double fastest = p->damping_n_s_m / p->inertia_kg, step_s = p->step_s, wanted;
    int k;
    if (fits(p, stiffness, duration_s)) {
        return 1;
    }
    for (k = 0; k < MOTION_BRANCHES; ++k) {
        if (p->branch_share[k] > 0.0 && fastest * p->branch_s[k] < 1.0) {
            fastest = 1.0 / p->branch_s[k];
        }
    }
    if (p->hysteresis_n > 0.0) {
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
