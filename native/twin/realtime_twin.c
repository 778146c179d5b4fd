/* Takes: an output and when it was ready. Gives: a block of codes from the twin's physics. */
#include "twin/realtime_twin.h"

#include <math.h>

static int exchange(void *context, double output_v, int64_t delay_ns, int16_t *codes,
                    double *start_s)
{
    rt_twin *t = context;
    /* An output that came late takes effect when it came, at the latest at the block's end. */
    const double ready = ceil((double)delay_ns * 1e-9 / t->parameters->sample_s);
    int32_t at = ready < (double)t->samples ? (int32_t)ready : t->samples;
    at = at > t->switch_sample ? at : t->switch_sample;
    *start_s = t->state->time_s;
    twin_acquire(t->parameters, t->state, t->before_v, output_v, at, t->load_n, t->samples, codes,
                 t->lengths);
    t->before_v = output_v;
    return t->state->broken;
}

static void zero(void *context)
{
    rt_twin *t = context;
    const double none_v = 0.0;
    t->before_v = 0.0;
    twin_move(t->parameters, t->state, &none_v, 1, 1, t->load_n, 1, t->lengths);
}

rt_plant rt_plant_of_twin(rt_twin *twin)
{
    const rt_plant plant = {twin, exchange, zero};
    return plant;
}
