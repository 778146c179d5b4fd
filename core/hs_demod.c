/* Takes: ADC codes of one block and constant weights. Gives: phasors, capacitance, resistance. */
#include "hs.h"

#define HS_LANES 8

hs_phasors hs_demodulate(const int16_t *codes, const float *weights, uint16_t n)
{
    /* Fixed lanes fix the order of the additions, so vector units change no bit. */
    float vc[HS_LANES] = {0}, vs[HS_LANES] = {0}, ic[HS_LANES] = {0}, is[HS_LANES] = {0};
    hs_phasors p = {0.0f, 0.0f, 0.0f, 0.0f};
    uint16_t k;
    uint8_t j;

    for (k = 0; k < n; k = (uint16_t)(k + HS_LANES)) {
        const int16_t *x = codes + 2 * (uint32_t)k;
        const float *w = weights + 2 * (uint32_t)k;
        for (j = 0; j < HS_LANES; ++j) {
            const float v = (float)x[2 * j];
            const float i = (float)x[2 * j + 1];
            vc[j] += v * w[2 * j];
            vs[j] += v * w[2 * j + 1];
            ic[j] += i * w[2 * j];
            is[j] += i * w[2 * j + 1];
        }
    }
    for (j = 0; j < HS_LANES; ++j) {
        p.v_re += vc[j];
        p.v_im -= vs[j]; /* x = re cos - im sin */
        p.i_re += ic[j];
        p.i_im -= is[j];
    }
    return p;
}

hs_impedance hs_impedance_from_phasors(const hs_impedance_config *config, const hs_phasors *p)
{
    hs_impedance z = {0.0f, 0.0f, 0};
    const float i_re = p->i_re * config->skew_re - p->i_im * config->skew_im;
    const float i_im = p->i_re * config->skew_im + p->i_im * config->skew_re;
    const float i2 = i_re * i_re + i_im * i_im;
    const float v2 = p->v_re * p->v_re + p->v_im * p->v_im;
    const float floor2 = config->min_amplitude * config->min_amplitude;
    float z_re, z_im;

    if (!(i2 > floor2 && v2 > floor2)) {
        return z;
    }
    z_re = config->v_per_i * (p->v_re * i_re + p->v_im * i_im) / i2;
    z_im = config->v_per_i * (p->v_im * i_re - p->v_re * i_im) / i2;
    if (z_im < 0.0f) {
        z_im = -z_im;
    }
    if (!(z_im > 0.0f)) {
        return z;
    }
    z.capacitance_f = 1.0f / (config->omega_rad_s * z_im);
    z.resistance_ohm = z_re;
    z.valid = 1;
    return z;
}
