/* One step of the PI and PID, shared by all number types: float in core/hs_pid.c, double
 * and vectors of floats in native/loops. Include it once for each kind, after
 *     PID_NUMBER            a number, or many side by side
 *     PID_STEP              name of the function
 *     PID_CONFIG, PID_STATE types with the fields of hs_pid_config and hs_pid_state
 * and, unless C's own operators apply to PID_NUMBER, all of the operations below.
 */
#ifndef PID_ADD
#define PID_TRUTH uint8_t
#define PID_INLINE static inline
#define PID_ZERO 0
#define PID_ADD(a, b) ((a) + (b))
#define PID_SUB(a, b) ((a) - (b))
#define PID_MUL(a, b) ((a) * (b))
#define PID_DIV(a, b) ((a) / (b))
#define PID_ABOVE(a, b) ((a) > (b))
#define PID_OR(a, b) ((a) || (b))
#define PID_AND(a, b) ((a) && (b))
#define PID_AND_NOT(a, b) ((a) && !(b))
#define PID_CHOOSE(truth, a, b) ((truth) ? (a) : (b))
#endif

/* The output before limiting. Without `valid` the state is unchanged. */
PID_INLINE PID_NUMBER PID_STEP(const PID_CONFIG *config, PID_STATE *state, PID_NUMBER error,
                               PID_NUMBER measurement, PID_TRUTH valid)
{
    const PID_NUMBER previous = state->filtered, integral = state->integral;
    const PID_NUMBER filtered =
        PID_ADD(previous, PID_MUL(config->filter_constant, PID_SUB(measurement, previous)));
    const PID_NUMBER damping =
        PID_MUL(config->kd, PID_DIV(PID_SUB(filtered, previous), config->period_s));
    const PID_NUMBER direct = PID_MUL(config->kp, error);
    const PID_NUMBER free_u = PID_SUB(PID_ADD(direct, integral), damping);
    const PID_TRUTH outward =
        PID_OR(PID_AND(PID_ABOVE(free_u, config->u_high), PID_ABOVE(error, PID_ZERO)),
               PID_AND(PID_ABOVE(config->u_low, free_u), PID_ABOVE(PID_ZERO, error)));
    const PID_NUMBER moved =
        PID_ADD(integral, PID_MUL(PID_MUL(config->ki, error), config->period_s));

    state->filtered = PID_CHOOSE(valid, filtered, previous);
    state->integral = PID_CHOOSE(PID_AND_NOT(valid, outward), moved, integral);
    return PID_SUB(PID_ADD(direct, state->integral), damping);
}

#undef PID_NUMBER
#undef PID_STEP
#undef PID_CONFIG
#undef PID_STATE
