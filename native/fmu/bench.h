/* The twin as a functional mock-up unit (FMU), without the interface of a version of the standard.
 *
 * A step of the simulation is cut into steps of the twin of TWIN_SUB samples each. A new drive
 * voltage reaches the amplifier `acquisition.output_delay_s` after the communication point at which
 * it was set, as at the bench. SI units.
 */
#ifndef FMU_BENCH_H
#define FMU_BENCH_H

#include <stddef.h>
#include <stdint.h>

#include "twin/twin.h"

/* Value references; haselab.rig.twin.fmu writes the same into modelDescription.xml. */
enum fmu_reference {
    FMU_DRIVE_V, /* inputs */
    FMU_FORCE_N,
    FMU_CARRIER_V,
    FMU_CARRIER_HZ,
    FMU_INPUTS,
    FMU_FIRST_OUTPUT = 100,
    FMU_LENGTH_M = FMU_FIRST_OUTPUT,
    FMU_SPEED_M_S,
    FMU_STRAIN,
    FMU_OUTPUT_V,
    FMU_ACTUATOR_V,
    FMU_FIELD_V_M, /* largest in the last step that was at least a step of the twin */
    FMU_CAPACITANCE_F,
    FMU_V_READING_V, /* last reading of each monitor */
    FMU_I_READING_V,
    FMU_SENSED_F, /* of the lock-in, with SENSED_OHM in series; see FMU_SENSED_VALID */
    FMU_SENSED_OHM,
    FMU_END_OUTPUTS,
    FMU_BREAKDOWN = 200, /* Booleans */
    FMU_SENSED_VALID,
    FMU_SEED = 300, /* integer */
    FMU_TIME = 400, /* of FMI 3.0: the independent variable */
    FMU_FIRST_PARAMETER = 1000,
    FMU_FIRST_CONSTANT = 3000
};

/* Parameters that are more than one number of the twin, by the place that resources/twin.bin gives
 * for them; any other place is the offset of a number in twin_parameters. */
enum fmu_place {
    FMU_GAIN = -1,
    FMU_GAIN_ERROR = -2,
    FMU_BANDWIDTH_HZ = -3,
    FMU_VOLT_PER_MONITOR_VOLT = -4,
    FMU_AMPERE_PER_MONITOR_VOLT = -5,
    FMU_V_MONITOR_GAIN_ERROR = -6,
    FMU_I_MONITOR_GAIN_ERROR = -7,
    FMU_RESONANCE_HZ = -8,
    FMU_MASS_KG = -9,
    FMU_ADDED_INERTIA_KG = -10,
    FMU_OUTPUT_DELAY_S = -11,
    FMU_PLACES = 12
};

typedef enum { FMU_OK, FMU_WARNING, FMU_DISCARD, FMU_ERROR, FMU_FATAL } fmu_status;

typedef struct fmu_bench fmu_bench;
typedef struct fmu_memory fmu_memory; /* a state that can be restored */

/* `folder`: of the resources. NULL, with a message of at most `room` bytes, if they are unusable. */
fmu_bench *fmu_new(const char *folder, char *message, size_t room);
void fmu_free(fmu_bench *b);
/* What was wrong with the last call that did not end with FMU_OK. */
const char *fmu_message(const fmu_bench *b);

void fmu_reset(fmu_bench *b);

/* Ends the simulation: a step is then an error, until a reset or until a state is restored. */
void fmu_terminate(fmu_bench *b);
fmu_status fmu_start(fmu_bench *b, double time_s);
fmu_status fmu_enter(fmu_bench *b); /* the initialisation; starts at 0 s if no start was set */
fmu_status fmu_settle(fmu_bench *b);     /* the mass has hung for a while */
fmu_status fmu_initialise(fmu_bench *b); /* settles; after it parameters are fixed */
fmu_status fmu_step(fmu_bench *b, double time_s, double step_s);
double fmu_time(const fmu_bench *b);

fmu_status fmu_get_real(fmu_bench *b, uint32_t reference, double *value);
fmu_status fmu_set_real(fmu_bench *b, uint32_t reference, double value);
fmu_status fmu_get_integer(fmu_bench *b, uint32_t reference, int32_t *value);
fmu_status fmu_set_integer(fmu_bench *b, uint32_t reference, int32_t value);
fmu_status fmu_get_boolean(fmu_bench *b, uint32_t reference, int *value);
/* Says that this value cannot be read or set as such a type. */
fmu_status fmu_no_such(fmu_bench *b, uint32_t reference, const char *type);

fmu_status fmu_remember(fmu_bench *b, fmu_memory **memory); /* NULL: a new one */
fmu_status fmu_restore(fmu_bench *b, const fmu_memory *memory);
/* `size` must be fmu_memory_size. */
fmu_status fmu_serialise(fmu_bench *b, const fmu_memory *memory, void *bytes, size_t size);
void fmu_forget(fmu_memory *memory);
size_t fmu_memory_size(const fmu_bench *b);
fmu_memory *fmu_memory_of(fmu_bench *b, const void *bytes, size_t size); /* NULL: another FMU's */

#endif
