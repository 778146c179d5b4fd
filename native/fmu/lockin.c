/* Takes: readings of both monitors. Gives: capacitance and resistance as a lock-in senses them. */
#include "fmu/instance.h"

#include <math.h>
#include <string.h>

#include "hs.h"

#define SETTLED_TAU 12.0 /* time constants of amplifier and circuit until the lock-in reads again */
#define LEAST_PERIODS 2.0
#define LEAST_CODES 20.0 /* of the carrier's amplitude */

/* Inverse of the normal equations of cos, sin, 1 and k, first two rows; 0 if there is none. */
static int normal_rows(const float *cosine, const float *sine, size_t n, float rows[8])
{
    double a[4][6] = {{0}};
    size_t k;
    int i, j, r;
    for (k = 0; k < n; ++k) {
        const double x[4] = {(double)cosine[k], (double)sine[k], 1.0, (double)k};
        for (i = 0; i < 4; ++i) {
            for (j = i; j < 4; ++j) {
                a[i][j] += x[i] * x[j];
            }
        }
    }
    for (i = 0; i < 4; ++i) {
        for (j = 0; j < i; ++j) {
            a[i][j] = a[j][i];
        }
        a[i][4] = i == 0;
        a[i][5] = i == 1;
    }
    for (i = 0; i < 4; ++i) { /* positive definite: no pivots are needed */
        if (!(a[i][i] > 0.0)) {
            return 0;
        }
        for (r = 0; r < 4; ++r) {
            const double share = a[r][i] / a[i][i];
            for (j = i; r != i && j < 6; ++j) {
                a[r][j] -= share * a[i][j];
            }
        }
    }
    for (i = 0; i < 4; ++i) {
        rows[i] = (float)(a[i][4] / a[i][i]);
        rows[4 + i] = (float)(a[i][5] / a[i][i]);
    }
    return 1;
}

static void carrier_table(fmu_bench *b, size_t n)
{
    const double step = b->p.carrier_rad_s * b->p.sample_s;
    size_t k;
    for (k = 0; k < n; ++k) {
        const double turned = step * (double)k;
        b->cosine[k] = (float)cos(turned);
        b->sine[k] = (float)sin(turned);
    }
}

/* Capacitance and resistance from the last readings, of at most a block, since the last change. */
void fmu_sense(fmu_bench *b)
{
    fmu_memory *m = b->now;
    const double volt_per_volt = b->composed[-FMU_VOLT_PER_MONITOR_VOLT];
    const double ampere_per_volt = b->composed[-FMU_AMPERE_PER_MONITOR_VOLT];
    const double scale_s = ampere_per_volt / volt_per_volt;
    const double turned = b->p.carrier_rad_s * b->p.skew_s;
    const size_t block = (size_t)b->about.block_samples;
    const size_t n = m->fresh < (int64_t)block ? (size_t)(m->fresh > 0 ? m->fresh : 0) : block;
    const float *v = fmu_readings(b, m) + block - n, *i = v + block;
    const hs_impedance_config config = {(float)(scale_s * cos(turned)),
                                        (float)(-scale_s * sin(turned)),
                                        0.0f,
                                        0.0f,
                                        (float)b->p.carrier_rad_s,
                                        (float)(LEAST_CODES * b->p.lsb_v)};
    hs_sums sums;
    hs_phasor phasor[2];
    hs_impedance found;
    float rows[8];
    m->sensed_valid = 0;
    if (!(b->p.carrier_v > 0.0) || m->twin.broken ||
        (double)n * b->p.sample_s * b->p.carrier_rad_s < LEAST_PERIODS * TWO_PI) {
        return;
    }
    carrier_table(b, n);
    if (!normal_rows(b->cosine, b->sine, n, rows)) {
        return;
    }
    hs_sum_segments(v, (uint32_t)n, b->cosine, b->sine, (uint16_t)n, &sums);
    phasor[0] = hs_phasor_of_segment(rows, &sums);
    hs_sum_segments(i, (uint32_t)n, b->cosine, b->sine, (uint16_t)n, &sums);
    phasor[1] = hs_phasor_of_segment(rows, &sums);
    found = hs_impedance_of(&config, &phasor[0], &phasor[1]);
    if (found.reason == 0) {
        m->sensed_f = (double)found.capacitance_f;
        m->sensed_ohm = (double)found.resistance_ohm;
        m->sensed_valid = 1;
    }
}

/* Time after a change until the readings are those of a steady carrier. */
int64_t fmu_settling_samples(const fmu_bench *b)
{
    const twin_parameters *p = &b->p;
    const double farad = motion_capacitance(&p->law, b->now->twin.motion.length_m, 0.0);
    const double lag_s = fmax(p->v_monitor_lag_s, p->i_monitor_lag_s);
    const double tau_s = 1.0 / (p->amplifier_damping * p->amplifier_rad_s) +
                         p->series_ohm * farad + lag_s;
    return (int64_t)ceil(SETTLED_TAU * tau_s / p->sample_s);
}

/* Keeps `samples` new readings; a reading at the end of the converter's range counts as a change. */
void fmu_keep_readings(fmu_bench *b, int32_t samples)
{
    const size_t block = (size_t)b->about.block_samples, n = (size_t)samples;
    int64_t fresh = b->now->fresh + samples;
    int c;
    size_t k;
    for (c = 0; c < 2; ++c) {
        float *kept = fmu_readings(b, b->now) + (size_t)c * block;
        memmove(kept, kept + n, (block - n) * sizeof *kept);
        for (k = 0; k < n; ++k) {
            const int16_t code = b->codes[2 * k + (size_t)c];
            kept[block - n + k] = (float)(code * b->p.lsb_v);
            if (code >= b->p.top_code || code <= -b->p.top_code - 1.0) {
                fresh = fresh < samples - 1 - (int64_t)k ? fresh : samples - 1 - (int64_t)k;
            }
        }
    }
    b->now->fresh = fresh;
    b->now->v_reading_v = b->codes[2 * (samples - 1)] * b->p.lsb_v;
    b->now->i_reading_v = b->codes[2 * (samples - 1) + 1] * b->p.lsb_v;
}

