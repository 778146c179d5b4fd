/* The motion of an actuator that follows a law: its length, branches, charge, softening and
 * hysteresis in time.
 *
 * The law is a table of its forces over lengths and voltages (haselab.actuators.table), so that one
 * code moves every kind. Classic Runge-Kutta of order 4; the caller ends a step wherever an input
 * jumps. A crossing of the longest length so far ends a step as well, and so does a reversal where
 * there is hysteresis.
 *
 * With a tangent, the derivatives of the state by parameters and start values follow with it; they
 * are those of the numbers computed, not of another scheme. SI units throughout. The caller owns
 * everything.
 */
#ifndef MOTION_H
#define MOTION_H

#include <stdint.h>

#define MOTION_BRANCHES 4
#define MOTION_LENGTHS 1024
#define MOTION_VOLTAGES 129

/* An actuator law as numbers on a grid of lengths and voltages, with cubics between the knots. */
typedef struct {
    int32_t lengths;      /* knots in use, 4 to MOTION_LENGTHS */
    int32_t voltages;     /* 1: nothing depends on the voltage; else 4 to MOTION_VOLTAGES */
    double low_m, step_m; /* first length and distance of two */
    double step_v;        /* voltages are 0, step_v, 2 step_v, ... */
    double per_step_m, per_step_v; /* 1 over these distances */
    double elastic_n[MOTION_LENGTHS];
    double gap_m[MOTION_LENGTHS]; /* thickness of the dielectric */
    double capacitance_f[MOTION_VOLTAGES][MOTION_LENGTHS]; /* differential: dQ / dV */
    double pull_n_v2[MOTION_VOLTAGES][MOTION_LENGTHS];     /* electric force over the voltage squared */
} motion_law;

typedef struct {
    double free_length_m;
    double softening_share, softening_stretch, softening_width;
    double branch_share[MOTION_BRANCHES], branch_s[MOTION_BRANCHES]; /* share 0: none */
    double damping_n_s_m, inertia_kg;
    double charge_share, charge_s; /* of the voltage that acts late; share 0: none */
    double hysteresis_n, hysteresis_width; /* largest force; stretch that it needs; 0 N: none */
    double elastic_scale;          /* of the law's elastic force: 1 unless it ages */
    /* Slow changes in a record, of the elastic force and of the permittivity, each of a rate and a
     * time constant: the factor is 1 + rate s (1 - exp(-t / s)) a time t after its first edge. */
    double elastic_drift[2], electric_drift[2]; /* 1/s, s; 0 s: none */
    double step_s;                 /* longest step */
    double phase;                  /* of the fastest motion in a step, at most; rad */
} motion_parameters;

typedef struct {
    double length_m, speed_m_s;
    double relaxed_n[MOTION_BRANCHES]; /* elastic force to which a branch has relaxed */
    double charge_v;                   /* late part of the voltage */
    double longest_m;                  /* longest length so far: the memory of softening */
    double hysteresis_n;               /* its present force, against elongation */
} motion_state;

/* What acts during a step. The voltage's mean square is volt^2 + ripple_v2. */
typedef struct {
    double volt, ripple_v2, load_n;
} motion_input;

/* Derivatives by `columns` numbers. `kind` states the number a column is for: a parameter of the law
 * (any value below MOTION_START) or one of enum motion_column. `rows` holds MOTION_ROWS rows of the
 * state's derivatives, each `columns` wide; `work` MOTION_WORK rows. The tables of the law's
 * derivatives have the law's knots; those of the `laws` parameters lie side by side at each knot. */
enum motion_column {
    MOTION_START = 1000, /* a start value: derivatives enter through `rows` alone */
    MOTION_DAMPING,
    MOTION_INERTIA,
    MOTION_SOFTENING_SHARE,
    MOTION_SOFTENING_STRETCH,
    MOTION_SOFTENING_WIDTH,
    MOTION_CHARGE_SHARE,
    MOTION_CHARGE_S,
    MOTION_HYSTERESIS_N,
    MOTION_HYSTERESIS_WIDTH,
    MOTION_VOLTAGE_SCALE, /* of volt; the present scale is 1 */
    MOTION_ELASTIC_DRIFT, /* rate of the drift, then its time constant */
    MOTION_ELASTIC_DRIFT_S,
    MOTION_ELECTRIC_DRIFT,
    MOTION_ELECTRIC_DRIFT_S,
    MOTION_BRANCH_SHARE = 1100, /* + branch */
    MOTION_BRANCH_S = 1200      /* + branch */
};
enum { MOTION_ROWS = 5 + MOTION_BRANCHES, MOTION_WORK = 3 * MOTION_ROWS + MOTION_BRANCHES + 6 };

typedef struct {
    int32_t columns, laws, others;
    const int32_t *kind;
    const int32_t *law_column;        /* [laws]: their columns */
    const int32_t *other_column;      /* [others]: those of kinds above MOTION_START */
    const double *elastic;            /* [lengths][laws] */
    const double *pull, *capacitance; /* [voltages][lengths][laws] */
    const double *free_length;        /* [laws]: derivative of the free length */
    double drift[4]; /* relative derivatives of the present factors, from MOTION_ELASTIC_DRIFT on */
    double *rows;
    double *work;
} motion_tangent;

/* Values of the law. A length outside the table takes the value at its end. */
double motion_elastic(const motion_law *law, double length_m);
double motion_gap(const motion_law *law, double length_m);
double motion_capacitance(const motion_law *law, double length_m, double voltage_v);
/* The capacitance with its slopes; `by` gets its direct derivatives by the parameters of the law, in
 * the order of the tables. */
typedef struct {
    double value, per_m, per_v;
} motion_capacitance_slopes;
motion_capacitance_slopes motion_capacitance_by(const motion_law *law, const motion_tangent *t,
                                                double length_m, double voltage_v, double *by);
/* Factor of softening on the elastic force. */
double motion_softening(const motion_parameters *p, double longest_m);

/* A relaxed actuator at rest. */
void motion_rest(const motion_law *law, const motion_parameters *p, motion_state *s,
                 double length_m, double longest_m);

/* One step of dt; tangent may be NULL. */
void motion_step(const motion_law *law, const motion_parameters *p, motion_state *s,
                 motion_tangent *tangent, const motion_input *input, double dt);

/* Number of equal steps that a duration needs from this state on. */
int32_t motion_steps(const motion_law *law, const motion_parameters *p, const motion_state *s,
                     double duration_s);

/* Whether one step is enough for a duration; 0 also with hysteresis, where this needs more work. */
int motion_fits(const motion_law *law, const motion_parameters *p, const motion_state *s,
                double duration_s);

/* A duration in that many steps. */
void motion_advance(const motion_law *law, const motion_parameters *p, motion_state *s,
                    motion_tangent *tangent, const motion_input *input, double duration_s);

/* Length at a share (0 to 1) of the step from a to b of duration dt: Hermite's cubic. */
double motion_between(const motion_state *a, const motion_state *b, double dt, double share);

#endif
