/* Takes: value references. Gives: the values of an instance, and sets its inputs and parameters. */
#include "fmu/instance.h"

#include <math.h>

fmu_status fmu_no_such(fmu_bench *b, uint32_t reference, const char *type)
{
    return fmu_fail(b, "This FMU has no %s with value reference %u. See modelDescription.xml.", type,
                    (unsigned)reference);
}

static double output(const fmu_bench *b, uint32_t reference)
{
    const fmu_memory *m = b->now;
    const twin_state *s = &m->twin;
    switch (reference) {
    case FMU_LENGTH_M:
        return s->motion.length_m;
    case FMU_SPEED_M_S:
        return s->motion.speed_m_s;
    case FMU_STRAIN:
        return s->motion.length_m / b->p.motion.free_length_m - 1.0;
    case FMU_OUTPUT_V:
        return s->amp_v;
    case FMU_ACTUATOR_V:
        return s->plate_v;
    case FMU_FIELD_V_M:
        return s->field_v_m;
    case FMU_CAPACITANCE_F:
        return motion_capacitance(&b->p.law, s->motion.length_m, s->plate_v) *
               twin_permittivity(&b->p, s->time_s);
    case FMU_V_READING_V:
        return m->v_reading_v;
    case FMU_I_READING_V:
        return m->i_reading_v;
    case FMU_SENSED_F:
        return m->sensed_f;
    default:
        return m->sensed_ohm;
    }
}

fmu_status fmu_get_real(fmu_bench *b, uint32_t reference, double *value)
{
    if (reference < FMU_INPUTS) {
        *value = b->now->input[reference];
        return FMU_OK;
    }
    if (reference >= FMU_FIRST_OUTPUT && reference < FMU_END_OUTPUTS) {
        fmu_status status;
        if (!b->now->started) {
            return fmu_fail(b, "An output was read before the initialisation. Enter the "
                           "initialisation first.");
        }
        status = fmu_settle(b);
        *value = output(b, reference);
        return status;
    }
    if (reference >= FMU_FIRST_PARAMETER &&
        reference - FMU_FIRST_PARAMETER < b->about.parameters) {
        *value = b->now->parameter[reference - FMU_FIRST_PARAMETER];
        return FMU_OK;
    }
    if (reference >= FMU_FIRST_CONSTANT && reference - FMU_FIRST_CONSTANT < b->about.constants) {
        *value = b->constants[reference - FMU_FIRST_CONSTANT];
        return FMU_OK;
    }
    return fmu_no_such(b, reference, "real number");
}

fmu_status fmu_set_real(fmu_bench *b, uint32_t reference, double value)
{
    const uint32_t k = reference - FMU_FIRST_PARAMETER;
    if (reference < FMU_INPUTS) {
        b->now->input[reference] = value; /* checked in the step */
        return FMU_OK;
    }
    if (reference < FMU_FIRST_PARAMETER || k >= b->about.parameters) {
        return fmu_no_such(b, reference, "real input or parameter");
    }
    if (!isfinite(value)) {
        return fmu_fail(b, "%s is %g. Set a finite number.", b->records[k].name, value);
    }
    if (!(value >= b->records[k].low && value <= b->records[k].high)) {
        const int positive = b->records[k].low > 0.0 && b->records[k].low < 1e-300;
        return fmu_fail(b, "%s is %g. Set it %s %g%s%g.", b->records[k].name, value,
                        positive ? "above" : "within", positive ? 0.0 : b->records[k].low,
                        positive ? ", at most " : " to ", b->records[k].high);
    }
    if (b->now->initialised) {
        return fmu_fail(b, "%s was set during the simulation. Set it before the initialisation ends.",
                        b->records[k].name);
    }
    b->now->parameter[k] = value;
    b->now->settled = 0;
    return FMU_OK;
}

fmu_status fmu_get_integer(fmu_bench *b, uint32_t reference, int32_t *value)
{
    *value = b->now->seed;
    return reference == FMU_SEED ? FMU_OK : fmu_no_such(b, reference, "32-bit integer");
}

fmu_status fmu_set_integer(fmu_bench *b, uint32_t reference, int32_t value)
{
    if (reference != FMU_SEED) {
        return fmu_no_such(b, reference, "32-bit integer");
    }
    if (value < 0 || b->now->initialised) {
        return fmu_fail(b, "The seed is %d. Set one that is not negative, before the initialisation "
                       "ends.", (int)value);
    }
    b->now->seed = value;
    b->now->settled = 0;
    return FMU_OK;
}

fmu_status fmu_get_boolean(fmu_bench *b, uint32_t reference, int *value)
{
    if (reference != FMU_BREAKDOWN && reference != FMU_SENSED_VALID) {
        return fmu_no_such(b, reference, "Boolean");
    }
    *value = reference == FMU_BREAKDOWN ? b->now->twin.broken != 0 : b->now->sensed_valid != 0;
    return FMU_OK;
}

