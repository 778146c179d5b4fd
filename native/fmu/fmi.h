/* What both versions of the Functional Mock-up Interface share here: fmi-standard.org, 2.0.4 and
 * 3.0.2. Types are those of the standard on platforms with an int of 32 bits. */
#ifndef FMU_FMI_H
#define FMU_FMI_H

#include "fmu/bench.h"

#if defined(_WIN32)
#define FMI_EXPORT __declspec(dllexport)
#else
#define FMI_EXPORT __attribute__((visibility("default")))
#endif

#define FMI_MESSAGE 256

/* Functions for what this FMU has not: events, derivatives, clocks. The caller removes the arguments
 * from the stack on every platform of the standard, so that further ones do not matter. */
#define FMI_UNSUPPORTED(name)                                                                      \
    FMI_EXPORT int name(void *f)                                                                   \
    {                                                                                              \
        (void)f;                                                                                   \
        return FMU_ERROR;                                                                          \
    }

#endif
