/* haselab core: the code of every update, the same on the desktop and on the microcontroller.
 *
 * Rules of this folder: C99, float only, no heap, no globals, no libm, no recursion. The caller
 * owns every context; a configuration is constant while it runs; a step is
 *     out = step(const configuration, state, latched inputs)
 * and gives the same bits on every machine (built with -ffp-contract=off).
 */
#ifndef HS_H
#define HS_H

#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

/* ---- demodulation ------------------------------------------------------------------------- */

/* Why a result is not valid; bits, 0 if it is. */
#define HS_AMPLITUDE_LOST 1u /* no carrier on one of the monitors */
#define HS_PHASE_OUT 2u      /* no capacitor shows such a phase: channels swapped, wire broken */
#define HS_CLIPPED 4u        /* a reading at the end of the converter's range */
#define HS_CURRENT_LIMIT 8u  /* the amplifier limits its current */
#define HS_UPDATE 16u        /* the drive changed within the samples that are used */
#define HS_NOT_FINITE 32u    /* a reading is not a number */
#define HS_CARRIER_OFF 64u   /* the carrier has another frequency */

#define HS_LARGEST 3.0e38f
#define HS_LEAD 0.25f /* tangent of the phase lead beyond 90 degrees due to a monitor's lag */

/* Sums for least squares over one channel in one segment of a block, of its samples minus the first:
 * with the carrier's table, with 1 and with the sample number. Segments can be added, skipped or
 * weighted later without reading the samples again. */
typedef struct {
    float first;  /* reading that was subtracted */
    float cosine; /* sum of d cos */
    float sine;   /* sum of d sin */
    float level;  /* sum of d */
    float ramp;   /* sum of d k */
    float square; /* sum of d^2 */
} hs_sums;

/* Sums of every segment of a block, the last of which may be shorter.
 * x:            n readings of one channel, in any unit; n is at least 1.
 * cosine, sine: `segment` values each of the carrier, from phase 0 at a segment's first sample.
 * out:          n / segment sums, rounded up.
 */
void hs_sum_segments(const float *x, uint32_t n, const float *cosine, const float *sine,
                   uint16_t segment, hs_sums *out);

/* Peak amplitude of the carrier, x = re cos - im sin. */
typedef struct {
    float re, im;
} hs_phasor;

/* Phasor of a single segment.
 * inverse: first two rows of (B'B)^-1, B the columns cos, sin, 1, k over the segment's samples. */
hs_phasor hs_phasor_of_segment(const float inverse[8], const hs_sums *sums);

/* Series capacitance and resistance from the phasors, without trigonometry:
 *     Y = scale I / V - stray,   1 / Y = R + 1 / (j omega C) */
typedef struct {
    float scale_re, scale_im; /* siemens for equal readings, corrected for the channels' skew */
    float stray_re, stray_im; /* siemens in parallel with the actuator: cables */
    float omega_rad_s;        /* carrier */
    float min_amplitude;      /* unit of the readings; below it the carrier counts as lost */
} hs_impedance_config;

typedef struct {
    float capacitance_f;
    float resistance_ohm;
    uint8_t reason; /* 0: valid; else the numbers are 0 */
} hs_impedance;

hs_impedance hs_impedance_of(const hs_impedance_config *config, const hs_phasor *v,
                             const hs_phasor *i);

/* Four readings per carrier period (or one every 1.25 periods, for a slow converter), two periods
 * in a row, from a converter of at most 12 bits. Integers as far as possible. The output steps at
 * the start of a period, so the period's first reading is not used. A level and a ramp cancel. */
#define HS_QUADRATURE_SAMPLES 8

/* In phase and in quadrature: four times the phasor. */
typedef struct {
    int16_t re, im;
} hs_quadrature;

hs_quadrature hs_demodulate_quadrature(const int16_t x[HS_QUADRATURE_SAMPLES]);

/* Capacitance in series with a resistance, with one division:
 *     omega Z = turn V / I,   C = -|I|^2 / Im(turn V conj(I))
 * Parallel capacitance is not subtracted: it is part of the map from capacitance to strain. */
typedef struct {
    float turn_re, turn_im; /* 1/F for equal readings: omega over the scale of hs_impedance_config */
    int32_t v_low, v_high;  /* valid range of re^2 + im^2; outside: HS_AMPLITUDE_LOST */
    int32_t i_low;
} hs_quadrature_config;

typedef struct {
    float capacitance_f;
    uint8_t reason; /* 0: valid; else the number is 0 */
} hs_capacitance;

hs_capacitance hs_capacitance_of(const hs_quadrature_config *config, hs_quadrature v,
                                 hs_quadrature i);

/* ---- maps --------------------------------------------------------------------------------- */

/* strain = ((cubic * capacitance + curvature) * capacitance + slope) * capacitance + offset; cubic
 * and curvature 0 are the paper's straight line. */
typedef struct {
    float slope_per_f;
    float offset;
    float curvature_per_f2;
    float cubic_per_f3;
} hs_strain_map;

float hs_strain_from_capacitance(const hs_strain_map *map, float capacitance_f);

/* voltage = a1 exp(b1 strain) + a2 exp(b2 strain) */
typedef struct {
    float a1_v, b1, a2_v, b2;
} hs_voltage_map;

float hs_voltage_from_strain(const hs_voltage_map *map, float strain);

/* exp by range reduction and a polynomial: + - * only, below 1 ulp on [-87, 88]; 0 below -87,
 * the largest float above 88, 0 for NaN. */
float hs_exp(float x);

/* Table with equal spacing and linear interpolation. */
typedef struct {
    float low;            /* argument of value[0] */
    float steps_per_unit; /* 1 / distance */
    uint8_t steps;        /* value[] has steps + 1 entries */
    const float *value;
} hs_table;

/* The first value below the table, the last above it, NaN for NaN. */
float hs_table_at(const hs_table *table, float x);

/* ---- limits ------------------------------------------------------------------------------- */

/* Limit value to [low, high]; 0 for NaN: the last check before the output. Sets *limited to 1 if
 * the value was changed. */
float hs_limit(float value, float low, float high, uint8_t *limited);

/* ---- PI and PID --------------------------------------------------------------------------- */

/* u = kp e + integral - kd d(filtered measurement)/dt, clamped to [u_low, u_high]. The integral
 * is frozen while the unclamped output is beyond a limit and the error pushes it further out. */
typedef struct {
    float kp;              /* strain / strain */
    float ki;              /* 1 / s */
    float kd;              /* s */
    float period_s;        /* time between steps */
    float filter_constant; /* period / (period + derivative filter time), in (0, 1] */
    float u_low, u_high;   /* strain */
} hs_pid_config;

typedef struct {
    float integral;
    float filtered;
    uint8_t started; /* 0: the next step takes its measurement as the filter's start */
} hs_pid_state;

/* Start so that the first output for zero error is u (bumpless transfer). */
void hs_pid_init(hs_pid_state *state, float u);

/* One update. If the measurement is NaN, the state is unchanged and the result is NaN, which the
 * caller's hs_limit turns into 0. */
float hs_pid_step(const hs_pid_config *config, hs_pid_state *state, float reference,
                  float measurement);

#ifdef __cplusplus
}
#endif

#endif
