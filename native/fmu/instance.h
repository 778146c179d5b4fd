/* Of the FMU's files: what an instance holds. */
#ifndef FMU_INSTANCE_H
#define FMU_INSTANCE_H

#include "fmu/bench.h"

#define FMU_MESSAGE 256
#define FMU_PENDING 2048 /* drive voltages under way to the amplifier */
#define TWO_PI 6.283185307179586

/* resources/twin.bin: this, `parameters` records, `constants` numbers, one twin_parameters. */
typedef struct {
    char magic[8];
    uint32_t version, bytes_of_parameters, bytes_of_state, parameters, constants;
    int32_t block_samples;
    int32_t seed, unused;
    double drive_low_v, drive_high_v, highest_law_v;
    double clamp_kg, moving_kg, settle_s, gravity_m_s2;
} fmu_header;

#define FMU_NAME 56 /* bytes of a name, with the zero at its end */

typedef struct {
    int64_t place;
    double start, low, high; /* smallest positive `low`: the value must be above 0 */
    char name[FMU_NAME];
} fmu_record;

typedef struct {
    int64_t at; /* sample */
    double drive_v;
} fmu_change;

/* All that a simulation changes. */
struct fmu_memory {
    uint64_t owner; /* FNV hash of resources/twin.bin */
    twin_state twin;
    double input[FMU_INPUTS];
    double start_s, drive_v, set_v;
    double carrier_v, carrier_hz; /* that act now */
    int64_t steps;   /* of the twin, since the start */
    int64_t fresh;   /* samples since the last change of drive or carrier had settled */
    int32_t seed, started, settled, failed;
    int32_t pending, first_pending;
    fmu_change queue[FMU_PENDING];
    double sensed_f, sensed_ohm, v_reading_v, i_reading_v;
    int32_t sensed_valid, initialised, terminated, unused; /* `unused` aligns the parameters */
    double parameter[]; /* then the last readings of both monitors: floats of a block each */
};

struct fmu_bench {
    fmu_header about;
    const fmu_record *records;
    const double *constants;
    char *file;
    uint64_t owner;
    twin_parameters p;
    double composed[FMU_PLACES];
    double load_n;
    int64_t delay_samples;
    int16_t *codes;
    double *lengths;
    float *cosine, *sine;
    fmu_memory *now;
    char message[FMU_MESSAGE];
};

/* Sets the message; returns FMU_ERROR. */
fmu_status fmu_fail(fmu_bench *b, const char *format, ...);

/* Brings the parameters of the twin, or its carrier, to those that are set now. */
void fmu_apply(fmu_bench *b);
void fmu_set_carrier(fmu_bench *b);

/* Last readings of both monitors in V, `block_samples` of the voltage, then of the current. */
float *fmu_readings(const fmu_bench *b, fmu_memory *m);

/* Keeps `samples` new readings. A reading at the end of the converter's range counts as a change. */
void fmu_keep_readings(fmu_bench *b, int32_t samples);

/* Samples after a change until the readings are those of a steady carrier. */
int64_t fmu_settling_samples(const fmu_bench *b);

/* Capacitance and resistance from the readings, of at most a block, since the last change. */
void fmu_sense(fmu_bench *b);

#endif
