/* Takes: reference and strain. Gives: the drive of a state feedback with an observer, in V. */
#include "hs_motion_step.h"

void hs_observer_init(hs_observer_state *state)
{
    state->motion.started = 0;
    state->motion.drive = 0;
}

/* Rest, with the load that explains it. */
static void begin(const hs_motion_config *c, hs_observer_state *s, int32_t x, float voltage_v)
{
    const hs_place p = place_of(x);
    hs_motion_begin(c, &s->motion, x, voltage_v);
    s->x = x;
    s->v = s->a = 0;
    s->place = p;
    s->load = whole(quarter(rest_at(c, p)) - quarter(creep_of(c, &s->motion)) -
                    quarter(pushed_by(c, p, s->motion.drive)));
}

/* Correct the state by what was sensed earlier. */
static void correct(const hs_observer_gains *g, hs_observer_state *s, int32_t sensed)
{
    const hs_place p = s->place;
    const int16_t missed =
        short_of(sensed - earlier(s->x, speed_of(s->v), s->a, g->lag, g->lag_square));
    s->x = kept(s->x + (int32_t)value_at(g->gain_x, p) * missed);
    s->v = limited(s->v + (int32_t)value_at(g->gain_v, p) * missed, ONE - 1);
    s->load = limited(s->load + (int32_t)value_at(g->gain_load, p) * missed, ONE);
}

float hs_observer_step(const hs_observer_config *config, hs_observer_state *state,
                       float reference, float strain, float voltage_v, uint8_t valid)
{
    const hs_motion_config *c = &config->motion;
    const hs_observer_gains *g = &config->gains;
    hs_wanted *wanted = &state->motion.wanted;
    int32_t middle, rest, pushed, needed;
    hs_place p;
    if (!state->motion.started) {
        if (valid) {
            begin(c, state, hs_motion_x(c, strain), voltage_v);
        }
        return voltage_v;
    }
    if (valid) {
        correct(g, state, hs_motion_x(c, strain));
    }
    hs_motion_aim(c, wanted, reference);
    hs_motion_next(c, wanted);

    pushed = ((int32_t)g->kp * short_of(wanted->x - state->x) >> 1) +
             ((int32_t)g->kd * short_of(wanted->v - state->v) >> 1); /* Q26 */
    pushed = limited(pushed, ONE / 16) * 4 + quarter(wanted->a);
    /* forces half an update later, where they are those of the mean */
    middle = state->x + (state->v >> (c->shift + 1));
    p = state->place = place_of(middle);
    rest = rest_at(c, p);
    needed = whole(pushed + quarter(rest) - quarter(crept(c, &state->motion, rest)) -
                   quarter(state->load) + quarter((int32_t)speed_of(state->v) * c->drag));
    pushed += quarter(hs_motion_put(c, &state->motion, p, needed, valid));

    state->a = whole(pushed);
    state->v = limited(state->v + (state->a >> c->shift), ONE - 1);
    state->x = kept(middle + (state->v >> (c->shift + 1)));
    return (float)state->motion.drive * c->volt;
}
