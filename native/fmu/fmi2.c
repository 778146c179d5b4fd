/* Takes: calls of FMI 2.0 for co-simulation. Gives: those of fmu/bench.h. */
#include "fmu/fmi.h"

#include <stdlib.h>
#include <string.h>

typedef struct {
    void (*logger)(void *environment, const char *instance, int status, const char *category,
                   const char *message, ...);
    void *(*allocate)(size_t count, size_t size);
    void (*release)(void *memory);
    void (*step_finished)(void *environment, int status);
    void *environment;
} callbacks;

typedef struct {
    fmu_bench *bench;
    callbacks call;
    char name[64];
} instance;

static void log_error(const callbacks *call, const char *name, const char *message)
{
    if (call->logger != NULL) {
        call->logger(call->environment, name, FMU_ERROR, "logStatusError", "%s", message);
    }
}

static int answer(instance *f, fmu_status status)
{
    if (status != FMU_OK) {
        log_error(&f->call, f->name, fmu_message(f->bench));
    }
    return (int)status;
}

FMI_EXPORT const char *fmi2GetTypesPlatform(void) { return "default"; }
FMI_EXPORT const char *fmi2GetVersion(void) { return "2.0"; }

FMI_EXPORT int fmi2SetDebugLogging(void *f, int on, size_t n, const char *const *categories)
{
    (void)f;
    (void)on;
    (void)n;
    (void)categories;
    return FMU_OK; /* errors alone are logged, always */
}

static int hex_digit(char c)
{
    if (c >= '0' && c <= '9') {
        return c - '0';
    }
    c = (char)(c | 0x20);
    return c >= 'a' && c <= 'f' ? c - 'a' + 10 : -1;
}

/* Path of a file URI, decoded into `path`; one without a scheme is a path, and is not decoded. */
static void path_of(const char *uri, char *path)
{
    const int encoded = strncmp(uri, "file:", 5) == 0;
    if (encoded) {
        uri += 5;
        if (strncmp(uri, "//", 2) == 0) { /* file://host/path; the host is this one */
            const char *slash = strchr(uri + 2, '/');
            uri = slash != NULL ? slash : uri + 2;
        }
#if defined(_WIN32)
        if (uri[0] == '/' && uri[1] != '\0' && uri[2] == ':') {
            ++uri;
        }
#endif
    }
    while (*uri != '\0') {
        const int high = encoded && *uri == '%' ? hex_digit(uri[1]) : -1;
        const int low = high >= 0 ? hex_digit(uri[2]) : -1;
        *path++ = low >= 0 ? (char)(16 * high + low) : *uri;
        uri += low >= 0 ? 3 : 1;
    }
    *path = '\0';
}

FMI_EXPORT void *fmi2Instantiate(const char *name, int type, const char *guid, const char *uri,
                                 const callbacks *call, int visible, int logging)
{
    static const callbacks silent = {NULL, NULL, NULL, NULL, NULL};
    char message[FMI_MESSAGE] = "No memory is left for the instance. Close other programs.";
    instance *f = calloc(1, sizeof *f);
    char *path = malloc((uri != NULL ? strlen(uri) : 0) + 1);
    (void)guid; /* twin.bin says whether it fits */
    (void)visible;
    (void)logging;
    if (f != NULL && path != NULL) {
        f->call = call != NULL ? *call : silent;
        strncpy(f->name, name != NULL ? name : "", sizeof f->name - 1);
        path_of(uri != NULL ? uri : "", path);
        if (type != 1) {
            strcpy(message, "This FMU supports co-simulation only.");
        } else {
            f->bench = fmu_new(path, message, sizeof message);
        }
    }
    free(path);
    if (f == NULL || f->bench == NULL) {
        log_error(call != NULL ? call : &silent, name, message);
        free(f);
        return NULL;
    }
    return f;
}

FMI_EXPORT void fmi2FreeInstance(void *f)
{
    if (f != NULL) {
        fmu_free(((instance *)f)->bench);
        free(f);
    }
}

FMI_EXPORT int fmi2SetupExperiment(void *f, int tolerance_defined, double tolerance, double start_s,
                                   int stop_defined, double stop_s)
{
    (void)tolerance_defined;
    (void)tolerance;
    (void)stop_defined;
    (void)stop_s;
    return answer(f, fmu_start(((instance *)f)->bench, start_s));
}

FMI_EXPORT int fmi2EnterInitializationMode(void *f)
{
    return answer(f, fmu_enter(((instance *)f)->bench));
}

FMI_EXPORT int fmi2ExitInitializationMode(void *f)
{
    return answer(f, fmu_initialise(((instance *)f)->bench));
}

FMI_EXPORT int fmi2Terminate(void *f)
{
    fmu_terminate(((instance *)f)->bench);
    return FMU_OK;
}

FMI_EXPORT int fmi2Reset(void *f)
{
    fmu_reset(((instance *)f)->bench);
    return FMU_OK;
}

FMI_EXPORT int fmi2DoStep(void *f, double time_s, double step_s, int no_return)
{
    (void)no_return;
    return answer(f, fmu_step(((instance *)f)->bench, time_s, step_s));
}

/* ---- values ---- */

/* A call for each value, up to the first that fails. */
#define EACH(name, type, call)                                                                     \
    FMI_EXPORT int name(void *f, const uint32_t *vr, size_t n, type *values)                        \
    {                                                                                              \
        fmu_bench *b = ((instance *)f)->bench;                                                      \
        size_t k;                                                                                  \
        for (k = 0; k < n; ++k) {                                                                  \
            const fmu_status status = call;                                                        \
            if (status != FMU_OK) {                                                                \
                return answer(f, status);                                                          \
            }                                                                                      \
        }                                                                                          \
        return FMU_OK;                                                                             \
    }

EACH(fmi2GetReal, double, fmu_get_real(b, vr[k], values + k))
EACH(fmi2SetReal, const double, fmu_set_real(b, vr[k], values[k]))
EACH(fmi2GetInteger, int32_t, fmu_get_integer(b, vr[k], values + k))
EACH(fmi2SetInteger, const int32_t, fmu_set_integer(b, vr[k], values[k]))
EACH(fmi2GetBoolean, int, fmu_get_boolean(b, vr[k], values + k))
EACH(fmi2SetBoolean, const int, ((void)values, fmu_no_such(b, vr[k], "input")))
EACH(fmi2GetString, char *, ((void)values, fmu_no_such(b, vr[k], "text")))
EACH(fmi2SetString, char *const, ((void)values, fmu_no_such(b, vr[k], "text")))

/* ---- states ---- */

FMI_EXPORT int fmi2GetFMUstate(void *f, void **state)
{
    fmu_memory *memory = *state;
    const fmu_status status = fmu_remember(((instance *)f)->bench, &memory);
    *state = memory;
    return answer(f, status);
}

FMI_EXPORT int fmi2SetFMUstate(void *f, void *state)
{
    return answer(f, fmu_restore(((instance *)f)->bench, state));
}

FMI_EXPORT int fmi2FreeFMUstate(void *f, void **state)
{
    (void)f;
    fmu_forget(*state);
    *state = NULL;
    return FMU_OK;
}

FMI_EXPORT int fmi2SerializedFMUstateSize(void *f, void *state, size_t *size)
{
    (void)state;
    *size = fmu_memory_size(((instance *)f)->bench);
    return FMU_OK;
}

FMI_EXPORT int fmi2SerializeFMUstate(void *f, void *state, char *bytes, size_t size)
{
    return answer(f, fmu_serialise(((instance *)f)->bench, state, bytes, size));
}

FMI_EXPORT int fmi2DeSerializeFMUstate(void *f, const char *bytes, size_t size, void **state)
{
    *state = fmu_memory_of(((instance *)f)->bench, bytes, size);
    return *state != NULL ? FMU_OK : answer(f, FMU_ERROR);
}

/* ---- steps that take time: this one does not ---- */

FMI_EXPORT int fmi2GetRealStatus(void *f, int kind, double *value)
{
    *value = fmu_time(((instance *)f)->bench); /* last successful time */
    return kind == 2 ? FMU_OK : FMU_DISCARD;
}

FMI_EXPORT int fmi2GetBooleanStatus(void *f, int kind, int *value)
{
    (void)f;
    *value = 0; /* terminated */
    return kind == 3 ? FMU_OK : FMU_DISCARD;
}

FMI_UNSUPPORTED(fmi2GetDirectionalDerivative)
FMI_UNSUPPORTED(fmi2SetRealInputDerivatives)
FMI_UNSUPPORTED(fmi2GetRealOutputDerivatives)
FMI_UNSUPPORTED(fmi2CancelStep)
FMI_UNSUPPORTED(fmi2GetStatus)
FMI_UNSUPPORTED(fmi2GetIntegerStatus)
FMI_UNSUPPORTED(fmi2GetStringStatus)
