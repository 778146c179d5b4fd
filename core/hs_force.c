/* Takes: reference and strain. Gives: the drive of a PID in the force of the field, in V. */
#include "hs_motion_step.h"

void hs_force_init(hs_force_state *state)
{
    state->motion.started = 0;
    state->motion.drive = 0;
}

/* Start without a jump: the integral is what equilibrium and the present force differ by. */
static void begin(const hs_motion_config *c, hs_force_state *s, int32_t x, float voltage_v)
{
    const hs_place p = place_of(x);
    hs_motion_begin(c, &s->motion, x, voltage_v);
    s->integral = whole(quarter(pushed_by(c, p, s->motion.drive)) - quarter(rest_at(c, p)) +
                        quarter(creep_of(c, &s->motion)));
    s->filtered = 0;
}

float hs_force_step(const hs_force_config *config, hs_force_state *state, float reference,
                    float strain, float voltage_v, uint8_t valid)
{
    const hs_motion_config *c = &config->motion;
    const hs_force_gains *g = &config->gains;
    hs_wanted *wanted = &state->motion.wanted;
    int32_t sensed, then, rest, needed, excess, more;
    int16_t error, speed;
    if (!valid) {
        return (float)state->motion.drive * c->volt; /* not used: the output is kept */
    }
    sensed = hs_motion_x(c, strain);
    if (!state->motion.started) {
        begin(c, state, sensed, voltage_v);
        return voltage_v;
    }
    hs_motion_aim(c, wanted, reference);
    hs_motion_next(c, wanted);

    speed = speed_of(wanted->v);
    then = earlier(wanted->x, speed, wanted->a, g->lag, g->lag_square);
    error = short_of(then - sensed);
    more = (int32_t)error * 8192 - state->filtered;
    needed = (g->kp * (int32_t)error >> 1) + (g->kd * (int32_t)short_of(more) >> 1); /* Q26 */
    state->filtered += part(more, g->filter);

    rest = rest_at(c, place_of(wanted->x));
    needed = whole(limited(needed, ONE / 16) * 4 + quarter(wanted->a) + quarter(rest) -
                   quarter(crept(c, &state->motion, rest)) + quarter(state->integral) +
                   quarter((int32_t)speed * c->drag));
    /* where the actuator will be when the drive acts, if it follows the reference */
    excess = hs_motion_put(c, &state->motion, place_of(sensed + (wanted->x - then)), needed, 1);
    more = (int32_t)g->ki * error;
    if (excess == 0 || (excess > 0) == (more > 0)) {
        state->integral = limited(state->integral + more, ONE);
    }
    return (float)state->motion.drive * c->volt;
}
