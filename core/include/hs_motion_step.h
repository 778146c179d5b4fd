/* Parts of a controller of the motion, for core/hs_force.c and core/hs_observer.c. Inline: a call
 * with numbers of 32 bits costs an 8-bit processor as much as the work itself. */
#ifndef HS_MOTION_STEP_H
#define HS_MOTION_STEP_H

#include "hs_motion.h"

#define ONE ((int32_t)1 << 30)
#define FULL 32767 /* of a drive */

/* ---- numbers ------------------------------------------------------------------------------ */

static inline uint32_t bits_of(float value)
{
    union {
        float value;
        uint32_t bits;
    } same;
    same.value = value;
    return same.bits;
}

/* a b / 2^16, rounded down. */
static inline int32_t scaled(int32_t a, int16_t b)
{
    const int16_t high = (int16_t)(a >> 16);
    const uint16_t low = (uint16_t)((uint32_t)a & 0xffffu);
    return (int32_t)high * b + (int32_t)(((int32_t)low * b) >> 16);
}

/* The same for a factor below 1 in Q16. */
static inline int32_t part(int32_t a, uint16_t b)
{
    const int16_t high = (int16_t)(a >> 16);
    const uint16_t low = (uint16_t)((uint32_t)a & 0xffffu);
    return (int32_t)high * b + (int32_t)(((uint32_t)low * b) >> 16);
}

static inline int32_t limited(int32_t a, int32_t most)
{
    return a > most ? most : a < -most ? -most : a;
}

/* Accelerations may add up to more than 32 bits hold: add quarters, then limit the sum to 1. */
static inline int32_t quarter(int32_t a)
{
    return a >> 2;
}

static inline int32_t whole(int32_t quarters)
{
    return limited(quarters, ONE / 4) * 4;
}

/* A length within a quarter of the table's range beyond it. */
static inline int32_t kept(int32_t x)
{
    return x < -ONE / 4 ? -ONE / 4 : x > ONE / 4 * 5 ? ONE / 4 * 5 : x;
}

/* Q30 to Q17, at most a quarter. */
static inline int16_t short_of(int32_t a)
{
    return (int16_t)(limited(a, ONE / 4 - 1) >> 13);
}

/* Speed as Q15, below 1. */
static inline int16_t speed_of(int32_t v)
{
    return (int16_t)(limited(v, ONE - 1) >> 15);
}

/* Where a motion was before a lag. */
static inline int32_t earlier(int32_t x, int16_t speed, int32_t a, int16_t lag, int16_t square)
{
    return x - (int32_t)speed * lag + (int32_t)(int16_t)(a >> 16) * square;
}

/* ---- tables ------------------------------------------------------------------------------- */

static inline hs_place place_of(int32_t x)
{
    hs_place p;
    if (x < 0) {
        x = 0;
    } else if (x >= ONE) {
        x = ONE - 1;
    }
    p.knot = (uint8_t)((uint16_t)(x >> 16) >> 9);
    p.share = (uint16_t)(((uint32_t)x << 7) >> 16);
    return p;
}

/* Q31 of a table in Q15. */
static inline int32_t fine_at(const int16_t *table, hs_place p)
{
    const int16_t low = table[p.knot], more = (int16_t)(table[p.knot + 1] - low);
    return (int32_t)((uint32_t)(int32_t)low << 16) + (int32_t)more * p.share;
}

static inline int16_t value_at(const int16_t *table, hs_place p)
{
    const int16_t low = table[p.knot], more = (int16_t)(table[p.knot + 1] - low);
    return (int16_t)(low + (int16_t)(((int32_t)more * p.share) >> 16));
}

/* ---- what the parts do -------------------------------------------------------------------- */

/* x of a strain, as `kept`. */
int32_t hs_motion_x(const hs_motion_config *config, float strain);

/* Drive of a voltage. */
int16_t hs_motion_drive(const hs_motion_config *config, float voltage_v);

/* Root of w below 2^31 as mantissa, at least 2^15, over 2^*shift; 0 of 0. */
uint16_t hs_motion_root(uint32_t w, uint8_t *shift);

/* Rest at a length. */
void hs_motion_begin(const hs_motion_config *config, hs_motion_state *state, int32_t x,
                     float voltage_v);

/* Begin a move to the reference in the update after the one that brings it, if no more than one is
 * under way. */
void hs_motion_aim(const hs_motion_config *config, hs_wanted *wanted, float reference);

/* The wanted motion of the next update. */
void hs_motion_next(const hs_motion_config *config, hs_wanted *wanted);

/* Acceleration by the electric force of a drive, Q30. */
static inline int32_t pushed_by(const hs_motion_config *c, hs_place p, int16_t drive)
{
    const int32_t w = limited((int32_t)drive * drive + c->carrier, ONE - 1);
    return (int32_t)value_at(c->push, p) * (int16_t)(w >> 15);
}

/* Acceleration that holds a length where nothing has relaxed, Q30. */
static inline int32_t rest_at(const hs_motion_config *c, hs_place p)
{
    return fine_at(c->rest, p) >> 1;
}

static inline int32_t creep_of(const hs_motion_config *c, const hs_motion_state *s)
{
    int32_t sum = 0;
    uint8_t k;
    for (k = 0; k < c->branches; ++k) {
        sum += s->creep[k];
    }
    return sum;
}

/* Acceleration by the relaxed part of the elastic force; one branch moves in each update. */
static inline int32_t crept(const hs_motion_config *c, hs_motion_state *s, int32_t rest)
{
    const uint8_t k = s->updates & (HS_MOTION_BRANCHES - 1);
    if (k < c->branches) {
        const int32_t off = 2 * scaled(rest, c->branch_share[k]) - s->creep[k];
        s->creep[k] += part(c->branch_slow[k] ? off >> 8 : off, c->branch_gain[k]);
    }
    return creep_of(c, s);
}

/* Put out the drive for an acceleration by the electric force, at most 1, within all limits; without
 * `valid` it is kept. Gives the acceleration that it has too much. */
int32_t hs_motion_put(const hs_motion_config *config, hs_motion_state *state, hs_place place,
                      int32_t needed, uint8_t valid);

#endif
