/* The controller of __init__.py on the microcontroller. */
#include "hs_controller.h"

enum { GAIN_PER_S, SMOOTHING_S }; /* parameters, in the order of KIND */
enum { AIM, INTEGRAL };           /* states */

void hs_controller_init(const hs_controller_setting *setting, hs_controller_state *state)
{
    state->x[AIM] = 0.0f;
    state->x[INTEGRAL] = setting->u_start;
}

float hs_controller_step(const hs_controller_setting *setting, hs_controller_state *state,
                         float reference, const hs_measurement *measurement)
{
    const float *parameter = setting->own.parameter;
    float *x = state->x;
    const float share = setting->period_s / (setting->period_s + parameter[SMOOTHING_S]);

    x[AIM] += share * (reference - x[AIM]);
    if (measurement->valid) {
        const float more =
            parameter[GAIN_PER_S] * setting->period_s * (x[AIM] - measurement->strain);
        const float drive = x[AIM] + x[INTEGRAL] + more;
        if (drive > setting->u_low && drive < setting->u_high) { /* no windup */
            x[INTEGRAL] += more;
        }
    }
    return x[AIM] + x[INTEGRAL];
}
