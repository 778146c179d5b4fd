/* Takes: calls of FMI 3.0 for co-simulation. Gives: those of fmu/bench.h. */
#include "fmu/fmi.h"

#include <stdbool.h>
#include <stdlib.h>

typedef void (*log_message)(void *environment, int status, const char *category,
                            const char *message);

typedef struct {
    fmu_bench *bench;
    void *environment;
    log_message log;
} instance;

static int answer(instance *f, fmu_status status)
{
    if (status != FMU_OK && f->log != NULL) {
        f->log(f->environment, (int)status, "logStatusError", fmu_message(f->bench));
    }
    return (int)status;
}

FMI_EXPORT const char *fmi3GetVersion(void) { return "3.0"; }

FMI_EXPORT int fmi3SetDebugLogging(void *f, bool on, size_t n, const char *const *categories)
{
    (void)f;
    (void)on;
    (void)n;
    (void)categories;
    return FMU_OK; /* errors alone are logged, always */
}

FMI_EXPORT void *fmi3InstantiateModelExchange(const char *name, const char *token,
                                              const char *folder, bool visible, bool logging,
                                              void *environment, log_message log)
{
    (void)name;
    (void)token;
    (void)folder;
    (void)visible;
    (void)logging;
    if (log != NULL) {
        log(environment, FMU_ERROR, "logStatusError", "This FMU supports co-simulation only.");
    }
    return NULL;
}

FMI_EXPORT void *fmi3InstantiateScheduledExecution(const char *name, const char *token,
                                                   const char *folder, bool visible, bool logging,
                                                   void *environment, log_message log,
                                                   void (*clock)(void *), void (*lock)(void),
                                                   void (*unlock)(void))
{
    (void)clock;
    (void)lock;
    (void)unlock;
    return fmi3InstantiateModelExchange(name, token, folder, visible, logging, environment, log);
}

FMI_EXPORT void *fmi3InstantiateCoSimulation(const char *name, const char *token,
                                             const char *folder, bool visible, bool logging,
                                             bool events, bool early, const uint32_t *required,
                                             size_t n_required, void *environment,
                                             log_message log, void (*intermediate)(void))
{
    char message[FMI_MESSAGE] = "No memory is left for the instance. Close other programs.";
    instance *f = calloc(1, sizeof *f);
    (void)name;
    (void)token; /* twin.bin says whether it fits */
    (void)visible;
    (void)logging;
    (void)events;
    (void)early;
    (void)required;
    (void)n_required;
    (void)intermediate;
    if (f != NULL) {
        f->environment = environment;
        f->log = log;
        f->bench = fmu_new(folder != NULL ? folder : "", message, sizeof message);
    }
    if (f == NULL || f->bench == NULL) {
        if (log != NULL) {
            log(environment, FMU_ERROR, "logStatusError", message);
        }
        free(f);
        return NULL;
    }
    return f;
}

FMI_EXPORT void fmi3FreeInstance(void *f)
{
    if (f != NULL) {
        fmu_free(((instance *)f)->bench);
        free(f);
    }
}

FMI_EXPORT int fmi3EnterInitializationMode(void *f, bool tolerance_defined, double tolerance,
                                           double start_s, bool stop_defined, double stop_s)
{
    (void)tolerance_defined;
    (void)tolerance;
    (void)stop_defined;
    (void)stop_s;
    return answer(f, fmu_start(((instance *)f)->bench, start_s));
}

FMI_EXPORT int fmi3ExitInitializationMode(void *f)
{
    return answer(f, fmu_initialise(((instance *)f)->bench));
}

FMI_EXPORT int fmi3Terminate(void *f)
{
    fmu_terminate(((instance *)f)->bench);
    return FMU_OK;
}

FMI_EXPORT int fmi3Reset(void *f)
{
    fmu_reset(((instance *)f)->bench);
    return FMU_OK;
}

FMI_EXPORT int fmi3DoStep(void *f, double time_s, double step_s, bool no_return, bool *event,
                          bool *terminate, bool *early, double *last_s)
{
    fmu_bench *b = ((instance *)f)->bench;
    const fmu_status status = fmu_step(b, time_s, step_s);
    (void)no_return;
    *event = *terminate = *early = false;
    *last_s = status == FMU_OK ? time_s + step_s : fmu_time(b);
    return answer(f, status);
}

/* ---- values ---- */

/* A call for each value, up to the first that fails. */
#define EACH(name, type, call)                                                                     \
    FMI_EXPORT int name(void *f, const uint32_t *vr, size_t n, type *values, size_t m)              \
    {                                                                                              \
        fmu_bench *b = ((instance *)f)->bench;                                                      \
        size_t k;                                                                                  \
        (void)m;                                                                                   \
        for (k = 0; k < n; ++k) {                                                                  \
            const fmu_status status = call;                                                        \
            if (status != FMU_OK) {                                                                \
                return answer(f, status);                                                          \
            }                                                                                      \
        }                                                                                          \
        return FMU_OK;                                                                             \
    }

static fmu_status get_real(fmu_bench *b, uint32_t reference, double *value)
{
    if (reference == FMU_TIME) {
        *value = fmu_time(b);
        return FMU_OK;
    }
    return fmu_get_real(b, reference, value);
}

static fmu_status get_boolean(fmu_bench *b, uint32_t reference, bool *value)
{
    int found = 0;
    const fmu_status status = fmu_get_boolean(b, reference, &found);
    *value = found != 0;
    return status;
}

EACH(fmi3GetFloat64, double, get_real(b, vr[k], values + k))
EACH(fmi3SetFloat64, const double, fmu_set_real(b, vr[k], values[k]))
EACH(fmi3GetInt32, int32_t, fmu_get_integer(b, vr[k], values + k))
EACH(fmi3SetInt32, const int32_t, fmu_set_integer(b, vr[k], values[k]))
EACH(fmi3GetBoolean, bool, get_boolean(b, vr[k], values + k))

/* Of what no variable is. */
#define NONE(name, type, what) EACH(name, type, ((void)values, fmu_no_such(b, vr[k], what)))
#define NONE_OF(type, name, what)                                                                  \
    NONE(fmi3Get##name, type, what)                                                                \
    NONE(fmi3Set##name, const type, what)

NONE(fmi3SetBoolean, const bool, "input")
NONE_OF(float, Float32, "32-bit real number")
NONE_OF(int8_t, Int8, "8-bit integer")
NONE_OF(uint8_t, UInt8, "8-bit integer")
NONE_OF(int16_t, Int16, "16-bit integer")
NONE_OF(uint16_t, UInt16, "16-bit integer")
NONE_OF(uint32_t, UInt32, "unsigned integer")
NONE_OF(int64_t, Int64, "64-bit integer")
NONE_OF(uint64_t, UInt64, "64-bit integer")
NONE_OF(char *, String, "text")

/* ---- states ---- */

FMI_EXPORT int fmi3GetFMUState(void *f, void **state)
{
    fmu_memory *memory = *state;
    const fmu_status status = fmu_remember(((instance *)f)->bench, &memory);
    *state = memory;
    return answer(f, status);
}

FMI_EXPORT int fmi3SetFMUState(void *f, void *state)
{
    return answer(f, fmu_restore(((instance *)f)->bench, state));
}

FMI_EXPORT int fmi3FreeFMUState(void *f, void **state)
{
    (void)f;
    fmu_forget(*state);
    *state = NULL;
    return FMU_OK;
}

FMI_EXPORT int fmi3SerializedFMUStateSize(void *f, void *state, size_t *size)
{
    (void)state;
    *size = fmu_memory_size(((instance *)f)->bench);
    return FMU_OK;
}

FMI_EXPORT int fmi3SerializeFMUState(void *f, void *state, uint8_t *bytes, size_t size)
{
    return answer(f, fmu_serialise(((instance *)f)->bench, state, bytes, size));
}

FMI_EXPORT int fmi3DeserializeFMUState(void *f, const uint8_t *bytes, size_t size, void **state)
{
    *state = fmu_memory_of(((instance *)f)->bench, bytes, size);
    return *state != NULL ? FMU_OK : answer(f, FMU_ERROR);
}

FMI_UNSUPPORTED(fmi3EnterEventMode)
FMI_UNSUPPORTED(fmi3GetBinary)
FMI_UNSUPPORTED(fmi3SetBinary)
FMI_UNSUPPORTED(fmi3GetClock)
FMI_UNSUPPORTED(fmi3SetClock)
FMI_UNSUPPORTED(fmi3GetNumberOfVariableDependencies)
FMI_UNSUPPORTED(fmi3GetVariableDependencies)
FMI_UNSUPPORTED(fmi3GetDirectionalDerivative)
FMI_UNSUPPORTED(fmi3GetAdjointDerivative)
FMI_UNSUPPORTED(fmi3EnterConfigurationMode)
FMI_UNSUPPORTED(fmi3ExitConfigurationMode)
FMI_UNSUPPORTED(fmi3GetIntervalDecimal)
FMI_UNSUPPORTED(fmi3GetIntervalFraction)
FMI_UNSUPPORTED(fmi3GetShiftDecimal)
FMI_UNSUPPORTED(fmi3GetShiftFraction)
FMI_UNSUPPORTED(fmi3SetIntervalDecimal)
FMI_UNSUPPORTED(fmi3SetIntervalFraction)
FMI_UNSUPPORTED(fmi3SetShiftDecimal)
FMI_UNSUPPORTED(fmi3SetShiftFraction)
FMI_UNSUPPORTED(fmi3EvaluateDiscreteStates)
FMI_UNSUPPORTED(fmi3UpdateDiscreteStates)
FMI_UNSUPPORTED(fmi3EnterStepMode)
FMI_UNSUPPORTED(fmi3GetOutputDerivatives)
/* Of model exchange and scheduled execution: importers look for them. */
FMI_UNSUPPORTED(fmi3EnterContinuousTimeMode)
FMI_UNSUPPORTED(fmi3CompletedIntegratorStep)
FMI_UNSUPPORTED(fmi3SetTime)
FMI_UNSUPPORTED(fmi3SetContinuousStates)
FMI_UNSUPPORTED(fmi3GetContinuousStateDerivatives)
FMI_UNSUPPORTED(fmi3GetEventIndicators)
FMI_UNSUPPORTED(fmi3GetContinuousStates)
FMI_UNSUPPORTED(fmi3GetNominalsOfContinuousStates)
FMI_UNSUPPORTED(fmi3GetNumberOfEventIndicators)
FMI_UNSUPPORTED(fmi3GetNumberOfContinuousStates)
FMI_UNSUPPORTED(fmi3ActivateModelPartition)
