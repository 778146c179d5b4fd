/* Takes: reference and measurement in strain. Gives: corrected strain, clamped. */
#include "hs.h"

#define PID_NUMBER float
#define PID_STEP pid_step
#define PID_CONFIG hs_pid_config
#define PID_STATE hs_pid_state
#include "hs_pid_step.h"

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
    uint8_t limited;

    if (error != error) {
        return error;
    }
    if (!state->started) {
        state->filtered = measurement;
        state->started = 1;
    }
    return hs_limit(pid_step(config, state, error, measurement, 1), config->u_low, config->u_high,
                    &limited);
}
