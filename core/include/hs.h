/* haselab core: what runs at every update, on the desktop and on the microcontroller alike.
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

/* Why a result does not count; bits, 0 where it does. */
#define HS_AMPLITUDE_LOST 1u /* no carrier on one of the monitors */
#define HS_PHASE_OUT 2u      /* no capacitor shows such a phase: channels swapped, wire broken */
#define HS_CLIPPED 4u        /* a reading at the end of the converter's range */
#define HS_CURRENT_LIMIT 8u  /* the amplifier limits its current */
#define HS_UPDATE 16u        /* the drive jumped where samples count */
#define HS_NOT_FINITE 32u    /* a reading is not a number */
#define HS_CARRIER_OFF 64u   /* the carrier has another frequency */

#define HS_LARGEST 3.0e38f
#define HS_LEAD 0.25f /* tangent of the lead beyond 90 degrees that a monitor's lag explains */

/* What least squares needs to know of one channel in one piece of a block: sums over its samples
 * less the first, against the carrier's table, against 1 and against the sample's number. They are
 * all of it: pieces are added up, left out or weighted later without a second look at the samples. */
typedef struct {
    float first;  /* reading that was taken off */
    float cosine; /* sum of d cos */
    float sine;   /* sum of d sin */
    float level;  /* sum of d */
    float ramp;   /* sum of d k */
    float square; /* sum of d^2 */
} hs_sums;

/* Sums of every piece of a block, the last of which may be shorter.
 * x:            n readings of one channel, in any unit; n is at least 1.
 * cosine, sine: `piece` values each of the carrier, from phase 0 at a piece's first sample.
 * out:          room for n / piece sums, rounded up.
 */
void hs_sum_pieces(const float *x, uint32_t n, const float *cosine, const float *sine,
                   uint16_t piece, hs_sums *out);

/* Peak amplitude of the carrier, x = re cos - im sin. */
typedef struct {
    float re, im;
} hs_phasor;

/* Phasor of a piece that stands alone.
 * inverse: first two rows of (B'B)^-1, B the columns cos, sin, 1, k over the piece's samples. */
hs_phasor hs_phasor_of_piece(const float inverse[8], const hs_sums *sums);

/* Series capacitance and resistance from the phasors, without trigonometry:
 *     Y = scale I / V - stray,   1 / Y = R + 1 / (j omega C) */
typedef struct {
    float scale_re, scale_im; /* siemens for equal readings, turned back by the channels' skew */
    float stray_re, stray_im; /* siemens beside the actuator: cables */
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

/* Four readings a carrier period (or one each period and a quarter: a slow converter may skip), two
 * periods in a row, from a converter of at most 12 bits. Whole numbers as far as they go. The output
 * steps where a period begins: its first reading is left out. A level and a ramp fall out. */
#define HS_QUADRATURE_SAMPLES 8

/* In phase and in quadrature: four times the phasor. */
typedef struct {
    int16_t re, im;
} hs_quadrature;

hs_quadrature hs_demodulate_quadrature(const int16_t x[HS_QUADRATURE_SAMPLES]);

/* Capacitance in series with a resistance, with one division:
 *     omega Z = turn V / I,   C = -|I|^2 / Im(turn V conj(I))
 * What lies beside the actuator is not taken off: it belongs to the map of capacitance to strain. */
typedef struct {
    float turn_re, turn_im; /* 1/F for equal readings: omega over the scale of hs_impedance_config */
    int32_t v_low, v_high;  /* squares of `re, im` that count; beyond: HS_AMPLITUDE_LOST */
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

/* Values at equal distances, straight lines between them. */
typedef struct {
    float low;            /* where value[0] holds */
    float steps_per_unit; /* 1 / distance */
    uint8_t steps;        /* value[] has steps + 1 entries */
    const float *value;
} hs_table;

/* The first value below the table, the last above it, NaN for NaN. */
float hs_table_at(const hs_table *table, float x);

/* ---- limits ------------------------------------------------------------------------------- */

/* value inside [low, high], the nearer end outside, and 0 for NaN: the last line before the
 * output. Returns 1 in *limited when it had to act. */
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

/* Start so that the first output with zero error is u (bumpless). */
void hs_pid_init(hs_pid_state *state, float u);

/* One update. A measurement that is NaN leaves the state untouched and returns NaN: the caller's
 * hs_limit turns that into 0. */
float hs_pid_step(const hs_pid_config *config, hs_pid_state *state, float reference,
                  float measurement);

#ifdef __cplusplus
}
#endif

#endif
