/* Takes: reference and measurement in strain. Gives: corrected strain, clamped. */
#include "hs.h"

void hs_pid_init(hs_pid_state *state, float u)
{
    state->integral = u;
    state->filtered = 0.0f;
    state->started = 0;
}

float hs_pid_step(const hs_pid_config *config, hs_pid_state *state, float reference,
                  float measurement)
{
    const float error = reference - measurement;
    float previous, damping, free_u, integral, u;
    uint8_t outward, limited;

    if (error != error) {
        return error;
    }
    if (!state->started) {
        state->filtered = measurement;
        state->started = 1;
    }
    previous = state->filtered;
    state->filtered = previous + config->filter_constant * (measurement - previous);
    damping = config->kd * ((state->filtered - previous) / config->period_s);

    free_u = config->kp * error + state->integral - damping;
    outward = (uint8_t)((free_u > config->u_high && error > 0.0f) ||
                        (free_u < config->u_low && error < 0.0f));
    integral = state->integral + config->ki * error * config->period_s;
    if (!outward) {
        state->integral = integral;
    }
    u = config->kp * error + state->integral - damping;
    return hs_limit(u, config->u_low, config->u_high, &limited);
}
