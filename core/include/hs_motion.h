/* Controllers of the identified motion in integers: what a slow processor without floating-point
 * hardware can compute in a thousandth of a second.
 *
 *     a = push(x) (w + carrier) - rest(x) + creep - drag v + load
 *
 * Lengths x are parts of the table's range, 0 to 1 in Q30 (1 is 2^30). The unit of time is 2^shift
 * updates, so that speeds v and accelerations a are numbers below 1, in Q30 too. w is the square
 * of the drive; the drive is a part of the highest drive in Q15. A product keeps to one or two
 * multiplications of 16 by 16 bits. Configurations are computed on the computer
 * (haselab.controllers.chip), constant while it runs, and full of numbers that fit: what could
 * overflow is limited.
 */
#ifndef HS_MOTION_H
#define HS_MOTION_H

#include "hs.h"

#ifdef __cplusplus
extern "C" {
#endif

#define HS_MOTION_KNOTS 33 /* of the tables over the length */
#define HS_MOTION_STARTS 9 /* lengths at which a move starts, of its table */
#define HS_MOTION_WAYS 9   /* distances of a move, of its table: 2^-8, 2^-7, ... 1 */
#define HS_MOTION_BRANCHES 4
#define HS_MOTION_MOVES 2 /* at the same time */

/* ---- the actuator ------------------------------------------------------------------------- */

typedef struct {
    float low;          /* strain at x = 0 */
    float per_strain;   /* x, in Q30, of a strain of 1 */
    float per_volt;     /* drive, in Q15, of 1 V */
    float volt;         /* V of a drive of 1 in Q15 */
    int32_t carrier;    /* Q30, of the highest drive squared */
    int32_t carrier_w;  /* the same, of what `inverse` gives */
    int32_t most;       /* change of speed in one update, Q30: an acceleration of 1 */
    int16_t rest[HS_MOTION_KNOTS];        /* acceleration that holds a length at once, Q15 */
    int16_t push[HS_MOTION_KNOTS];        /* acceleration by the highest drive, Q15 */
    int16_t inverse[HS_MOTION_KNOTS];     /* w over an acceleration */
    int16_t highest[HS_MOTION_KNOTS];     /* highest drive, by its limit and by the field, Q15 */
    /* Step of the phase of a move, first of those toward lower x, by start and distance. */
    uint16_t move[2 * HS_MOTION_STARTS * HS_MOTION_WAYS];
    /* Viscoelastic branches: a share of the elastic force relaxes. */
    int16_t branch_share[HS_MOTION_BRANCHES]; /* of rest[], Q15 */
    uint16_t branch_gain[HS_MOTION_BRANCHES]; /* of an update of the branch, Q16; if slow, Q24 */
    uint8_t branch_slow[HS_MOTION_BRANCHES];
    int16_t drag;       /* Q15 */
    int16_t lowest;     /* drive, Q15 */
    int16_t rise;       /* largest change of the drive in one update, Q15 */
    uint16_t root_unit; /* drive over the root of w, see drive_of */
    uint8_t root_shift;
    uint8_t branches;
    uint8_t shift;      /* the unit of time is 2^shift updates */
} hs_motion_config;

/* Between two knots of a table. */
typedef struct {
    uint8_t knot;
    uint16_t share; /* of the way to the next one, Q16 */
} hs_place;

/* A length on its way to another one: speed = peak s^2, s = 16 p^2 (1 - p)^2 of the phase p, which
 * is the polynomial of the fifth degree from rest to rest. */
typedef struct {
    int32_t peak;   /* speed in the middle */
    uint16_t phase; /* Q16 */
    uint16_t step;  /* of the phase in one update; 0: at rest */
} hs_move;

typedef struct {
    int32_t x, v, a;        /* wanted when the drive acts; a until the next one does */
    int32_t next_x, next_v; /* when the next one does */
    int32_t target;  /* of the last move that began */
    int32_t asked;   /* target of the next one */
    float reference; /* of which `asked` was computed */
    hs_move move[HS_MOTION_MOVES];
} hs_wanted;

typedef struct {
    hs_wanted wanted;
    int32_t creep[HS_MOTION_BRANCHES]; /* acceleration by each branch */
    int16_t drive;                     /* Q15 */
    uint8_t updates;                   /* modulo 256 */
    uint8_t started;
} hs_motion_state;

/* ---- force loop --------------------------------------------------------------------------- */

/* PID in the force of the field, with feed-forward of the planned motion. */
typedef struct {
    int16_t kp, kd;     /* Q10; kd: of the error beyond its filtered value */
    int16_t ki;         /* of one update, Q13 */
    int16_t lag;        /* age of a measurement when the drive acts, in units of time, Q15 */
    int16_t lag_square; /* half of its square, Q16 */
    uint16_t filter;    /* share of the new error in the filtered one, Q16 */
} hs_force_gains;

typedef struct {
    hs_motion_config motion;
    hs_force_gains gains;
} hs_force_config;

typedef struct {
    hs_motion_state motion;
    int32_t integral;
    int32_t filtered; /* error, Q30 */
} hs_force_state;

void hs_force_init(hs_force_state *state);

/* One update: reference and strain in strain, voltage_v the present drive. Gives the new drive in
 * V; the first time the present one, from which it starts. Without a valid strain it is kept. */
float hs_force_step(const hs_force_config *config, hs_force_state *state, float reference,
                    float strain, float voltage_v, uint8_t valid);

/* ---- observer ----------------------------------------------------------------------------- */

/* State feedback of an observer whose state is that at the time at which the drive acts. */
typedef struct {
    int16_t kp, kd;     /* Q10 */
    int16_t lag;        /* as of the force loop */
    int16_t lag_square;
    int16_t gain_x[HS_MOTION_KNOTS]; /* of Kalman's filter, Q13 */
    int16_t gain_v[HS_MOTION_KNOTS];
    int16_t gain_load[HS_MOTION_KNOTS];
} hs_observer_gains;

typedef struct {
    hs_motion_config motion;
    hs_observer_gains gains;
} hs_observer_config;

typedef struct {
    hs_motion_state motion;
    int32_t x, v, load; /* when the drive acts */
    int32_t a;          /* of the last update */
    hs_place place;     /* of its forces */
} hs_observer_state;

void hs_observer_init(hs_observer_state *state);

/* As hs_force_step; without a valid strain the model goes on alone. */
float hs_observer_step(const hs_observer_config *config, hs_observer_state *state,
                       float reference, float strain, float voltage_v, uint8_t valid);

#ifdef __cplusplus
}
#endif

#endif
