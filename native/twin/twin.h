/* The bench as physics: actuator, charge, amplifier, converters. Desktop only, double precision.
 *
 * The caller owns parameters and state. One mechanical step holds `TWIN_SUB` electrical steps, one
 * of which is one ADC sample. SI units throughout; a length is that of the sheet between clamps.
 */
#ifndef TWIN_H
#define TWIN_H

#include <stdint.h>

#include "motion/motion.h"

#define TWIN_SUB 20
#define TWIN_LONG (1 << 30)

/* One sample of a first-order lag whose input goes in straight lines. */
typedef struct {
    double last_output, last_input, input;
} twin_lag;

typedef struct {
    motion_law law;           /* of the actuator, see haselab.actuators */
    motion_parameters motion; /* losses and inertia */
    double series_ohm, leakage_ohm;
    double breakdown_v_m;
    /* generator, amplifier, monitors */
    double carrier_v, carrier_rad_s;
    double gain, amplifier_rad_s, amplifier_damping, slew_v_s, current_limit_a;
    double stray_f;              /* cable and fixture, in parallel with what is connected */
    double v_monitor, i_monitor; /* V per V, V per A */
    double v_monitor_lag_s, i_monitor_lag_s; /* first order each; 0: none */
    double v_offset_v, i_offset_v;           /* readings at 0 V, 0 A */
    /* converters */
    double sample_s, skew_s, lsb_v, v_noise_v, i_noise_v;
    double top_code; /* the largest; the smallest is -top_code - 1 */
    /* What no law has, all off at 0: the permittivity rises by capacitance_rise as the bench warms
     * up, ageing takes stiffness_loss of the elastic force, both from begins_s on, and a second
     * mass hangs on a spring. */
    double capacitance_rise, warming_s, stiffness_loss, ageing_s, begins_s;
    double second_kg, second_rad_s, second_damping;
    /* of the amplifier for sample_s, filled by twin_prepare; amp_r: response to an input that rises
     * to 1 in a straight line */
    double amp_a[2][2], amp_b[2], amp_r[2];
    twin_lag v_lag, i_lag; /* of the monitors */
} twin_parameters;

typedef struct {
    motion_state motion;
    double amp_v, amp_v_s;       /* amplifier output and its rate */
    double plate_v;              /* voltage over the capacitor */
    double v_seen, v_shown;      /* voltage monitor: its last input and output, V of the amplifier */
    double i_seen, i_shown;      /* current monitor, A */
    double reference_f, reference_ohm; /* in the actuator's place; 0 F: the actuator is connected */
    double second_m, second_m_s; /* of the second mass, from where it hangs on the moving end */
    double time_s, field_v_m;    /* field: largest since it was last cleared */
    uint64_t random[4];
    int32_t broken;              /* 1 after a dielectric breakdown, until the state is made anew */
    int32_t limited;             /* samples at the current or slew limit */
    int32_t outside;             /* 1 after the length left the table of the law; then also broken */
    int32_t since_limited;       /* samples since the last at such a limit, TWIN_LONG at most */
} twin_state;

void twin_prepare(twin_parameters *p);
void twin_seed(twin_state *s, uint64_t seed);

/* n_samples with drive `before_v` up to sample `switch_at`, `after_v` from there on. `load_n` is the
 * hung weight. codes: 2 * n_samples (voltage, current); lengths: n_samples / TWIN_SUB (the length
 * after each mechanical step). */
void twin_acquire(const twin_parameters *p, twin_state *s, double before_v, double after_v,
                  int32_t switch_at, double load_n, int32_t n_samples, int16_t *codes,
                  double *lengths);

/* Factor on the permittivity at a time, see capacitance_rise. */
double twin_permittivity(const twin_parameters *p, double time_s);

/* A reference of `farad` with `series_ohm` in the actuator's place; 0 F puts the actuator back. The
 * output must be at 0 V without a carrier. */
void twin_connect(twin_state *s, double farad, double series_ohm);

/* Motion alone: `n_steps` times of `TWIN_SUB * sample_s` under the ideal amplifier output
 * gain * drive[k / steps_per_value], with the carrier; lengths[n_steps] may be NULL. */
void twin_move(const twin_parameters *p, twin_state *s, const double *drive_v, int32_t n_drive,
               int32_t steps_per_value, double load_n, int32_t n_steps, double *lengths);

/* One update of a loop, by motion alone: `steps` times of `TWIN_SUB * sample_s`, with the drive
 * `before_v` up to step `switch_at`, `after_v` from there on. Writes `steps` lengths from
 * lengths[at] on; those before are of earlier updates. Returns the mean capacitance from step
 * `first` to step `last` after lengths[at - 1], which may be negative, as a lock-in senses it
 * without noise; at + first must be at least 1. */
typedef struct {
    double before_v, after_v, load_n;
    int32_t steps, switch_at, first, last;
} twin_update_input;
double twin_update(const twin_parameters *p, twin_state *s, const twin_update_input *in,
                   double *lengths, int32_t at);

#endif
