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

/* Phasors of the carrier in one block: real parts (cosine) and imaginary parts (sine). */
typedef struct {
    float v_re, v_im; /* voltage monitor, ADC codes */
    float i_re, i_im; /* current monitor, ADC codes */
} hs_phasors;

/* Least-squares lock-in of one block.
 * codes:   2 * n ADC codes, interleaved voltage, current.
 * weights: 2 * n numbers, interleaved cosine, sine: rows of the pseudo-inverse of the basis
 *          (cos, sin, 1, t) over the samples that count, 0 where a sample is blanked.
 * n:       samples per channel, a multiple of 8.
 */
hs_phasors hs_demodulate(const int16_t *codes, const float *weights, uint16_t n);

/* Series capacitance from the phasors, without trigonometry:
 *     reactance = v_per_i * |Im(V conj(I'))| / |I|^2,   C = 1 / (omega * reactance)
 * with I' = I rotated by the known skew of the channels. */
typedef struct {
    float v_per_i;          /* ohm per (code / code): ratio of the two monitor scales */
    float omega_rad_s;      /* carrier */
    float skew_re, skew_im; /* exp(-j omega skew): takes I back to the instant of V */
    float min_amplitude;    /* codes; below it the carrier counts as lost */
} hs_impedance_config;

typedef struct {
    float capacitance_f;
    float resistance_ohm;
    uint8_t valid; /* 0: carrier lost, numbers are 0 */
} hs_impedance;

hs_impedance hs_impedance_from_phasors(const hs_impedance_config *config, const hs_phasors *p);

/* ---- maps --------------------------------------------------------------------------------- */

/* strain = (curvature * capacitance + slope) * capacitance + offset; curvature 0 is the paper's
 * straight line. */
typedef struct {
    float slope_per_f;
    float offset;
    float curvature_per_f2;
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
