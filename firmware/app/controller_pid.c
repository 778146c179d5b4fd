/* The built-in controller: the PID of the core. */
#include "hs_controller.h"

void hs_controller_init(const hs_controller_setting *setting, hs_controller_state *state)
{
    hs_pid_init(&state->pid, setting->u_start);
}

float hs_controller_step(const hs_controller_setting *setting, hs_controller_state *state,
                         float reference, const hs_measurement *measurement)
{
    if (!measurement->valid) {
        return setting->u_low; /* not used: the output is kept */
    }
    return hs_pid_step(&setting->own.pid, &state->pid, reference, measurement->strain);
}
