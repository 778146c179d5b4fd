/* The bench as physics: shell, charge, amplifier, converters. Desktop only, double precision.
 *
 * The caller owns parameters and state. One mechanical step holds `TWIN_SUB` electrical steps, one
 * of which is one ADC sample. SI units throughout; a length is that of the sheet between clamps.
 */
#ifndef TWIN_H
#define TWIN_H

#include <stdint.h>

#define TWIN_BRANCHES 4
#define TWIN_SUB 20

typedef struct {
    /* shell: Arruda-Boyce with fixed lateral stretch, electrodes, visco-elastic branches */
    double area_m2, length_m, lateral_stretch;
    double ab[5];           /* coefficients of d(energy)/d(I1), Pa */
    double free_length_m;   /* length without load and voltage */
    double electrode_n_m;   /* electrode spring, natural at the free length */
    double electrode_cubic; /* its stiffening, per square of its strain */
    double mullins, mullins_stretch, mullins_width; /* virgin stiffening that the first cycle takes */
    double prony_g[TWIN_BRANCHES], prony_s[TWIN_BRANCHES];
    double damping_n_s_m, inertia_kg;
    /* charge */
    double capacitance_f, capacitance_exponent, thickness_m; /* at the free length */
    double series_ohm, leakage_ohm;
    double relaxation_share, relaxation_s; /* oil charge; share 0 switches it off */
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
    /* zero-order-hold matrices of the amplifier for sample_s, filled by twin_prepare */
    double amp_a[4], amp_b[2], series_decay;
    /* the same of the monitors, whose input goes in straight lines: last output, last input, input */
    double v_lag[3], i_lag[3];
} twin_parameters;

typedef struct {
    double length_m, speed_m_s;
    double branch_n[TWIN_BRANCHES], elastic_n;
    double longest_m;            /* largest length so far: the Mullins memory */
    double relaxed_v;            /* slow voltage of the oil */
    double amp_v, amp_v_s;       /* amplifier output and its rate */
    double plate_v, current_a;   /* voltage over the capacitor, mean current of the last sample */
    double v_seen, v_shown;      /* voltage monitor: its last input and output, V of the amplifier */
    double i_seen, i_shown;      /* current monitor, A */
    double reference_f, reference_ohm; /* in the actuator's place; 0 F: the actuator is connected */
    double time_s, field_v_m;    /* field: largest since it was last cleared */
    uint64_t random[4];
    int32_t broken;              /* 1 after a dielectric breakdown, until the state is made anew */
    int32_t limited;             /* samples at the current or slew limit */
} twin_state;

void twin_prepare(twin_parameters *p);
void twin_seed(twin_state *s, uint64_t seed);

/* Elastic force of shell and electrodes, N, and its Mullins factor's memory in *longest_m. */
double twin_elastic_force(const twin_parameters *p, double length_m, double longest_m);
double twin_capacitance(const twin_parameters *p, double length_m);

/* n_samples with drive `before_v` up to sample `switch_at`, `after_v` from there on. `load_n` is the
 * hung weight. codes: 2 * n_samples (voltage, current); lengths: n_samples / TWIN_SUB (the length
 * after each mechanical step). */
void twin_acquire(const twin_parameters *p, twin_state *s, double before_v, double after_v,
                  int32_t switch_at, double load_n, int32_t n_samples, int16_t *codes,
                  double *lengths);

/* A reference of `farad` with `series_ohm` in the actuator's place; 0 F puts the actuator back. The
 * output must be at 0 V without a carrier. */
void twin_connect(twin_state *s, double farad, double series_ohm);

/* Mechanics alone: `n_steps` steps of `TWIN_SUB * sample_s` under the ideal amplifier output
 * gain * drive[k / steps_per_value]; lengths[n_steps] may be NULL. */
void twin_move(const twin_parameters *p, twin_state *s, const double *drive_v, int32_t n_drive,
               int32_t steps_per_value, double load_n, int32_t n_steps, double *lengths);

#endif
