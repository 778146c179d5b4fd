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
#define TWIN_LENGTHS 1024
#define TWIN_VOLTAGES 9

/* One sample of a first-order lag whose input goes in straight lines. */
typedef struct {
    double last_output, last_input, input;
} twin_lag;

/* An actuator law as numbers on a grid of lengths and voltages, with cubics between the knots; see
 * haselab.actuators. It replaces the built-in shell, electrodes and capacitance. Losses, softening
 * and charge creep act on it as on the built-in law. */
typedef struct {
    int32_t lengths;      /* knots in use, 4 to TWIN_LENGTHS; 0: the built-in law */
    int32_t voltages;     /* 1: nothing depends on the voltage; else 4 to TWIN_VOLTAGES */
    int32_t substeps;     /* of the motion in one mechanical step */
    double low_m, step_m; /* first length and distance of two */
    double step_v;        /* voltages are 0, step_v, 2 step_v, ... */
    double elastic_n[TWIN_LENGTHS];
    double gap_m[TWIN_LENGTHS]; /* thickness of the dielectric */
    double capacitance_f[TWIN_VOLTAGES][TWIN_LENGTHS]; /* differential: dQ / dV */
    double pull_n_v2[TWIN_VOLTAGES][TWIN_LENGTHS];     /* electric force over the voltage squared */
} twin_table;

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
    double amp_a[2][2], amp_b[2], series_decay;
    twin_lag v_lag, i_lag; /* of the monitors */
    twin_table law;
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
    int32_t outside;             /* 1 after the length left the table of the law; then also broken */
} twin_state;

void twin_prepare(twin_parameters *p);
void twin_seed(twin_state *s, uint64_t seed);

/* Elastic force at a length, N, of an actuator whose largest length so far was longest_m. */
double twin_elastic_force(const twin_parameters *p, double length_m, double longest_m);
/* Differential capacitance, F. */
double twin_capacitance(const twin_parameters *p, double length_m, double voltage_v);
/* Thickness of the dielectric, m. */
double twin_gap(const twin_parameters *p, double length_m);

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
