/* Takes: readings of one channel and a table of the carrier. Gives: sums, phasors, impedance. */
#include "hs.h"

/* Fixed lanes fix the order of the additions, so vector units give the same bits. */
#define HS_LANES 16

#define HS_KEPT 4 /* of them are added last */

/* cosine, sine, level, ramp, square: the lanes of one segment, four of each. */
typedef float hs_kept[5][HS_KEPT];

static void fold_lanes(const float *lane, float *kept)
{
    float half[HS_LANES / 2];
    uint8_t j;
    for (j = 0; j < HS_LANES / 2; ++j) {
        half[j] = lane[j] + lane[j + HS_LANES / 2];
    }
    for (j = 0; j < HS_KEPT; ++j) {
        kept[j] = half[j] + half[j + HS_KEPT];
    }
}

static void sum_segment(const float *x, const float *cosine, const float *sine, uint16_t n,
                         hs_kept kept)
{
    float c[HS_LANES] = {0}, s[HS_LANES] = {0}, l[HS_LANES] = {0}, q[HS_LANES] = {0};
    float t[HS_LANES] = {0}; /* sum of the sums so far: an early sample is in it more often */
    const float first = x[0];
    uint16_t k;
    uint8_t j;

    for (k = 0; (uint16_t)(n - k) >= HS_LANES; k = (uint16_t)(k + HS_LANES)) {
        for (j = 0; j < HS_LANES; ++j) {
            const float d = x[k + j] - first;
            c[j] += d * cosine[k + j];
            s[j] += d * sine[k + j];
            l[j] += d;
            t[j] += l[j];
            q[j] += d * d;
        }
    }
    for (j = 0; j < HS_LANES; ++j) {
        t[j] = l[j] * (float)(k + j) - t[j] * (float)HS_LANES;
    }
    fold_lanes(c, kept[0]);
    fold_lanes(s, kept[1]);
    fold_lanes(l, kept[2]);
    fold_lanes(t, kept[3]);
    fold_lanes(q, kept[4]);
    for (; k < n; ++k) {
        const float d = x[k] - first;
        j = k % HS_KEPT;
        kept[0][j] += d * cosine[k];
        kept[1][j] += d * sine[k];
        kept[2][j] += d;
        kept[3][j] += d * (float)k;
        kept[4][j] += d * d;
    }
}

static float add_kept(const float *x)
{
    return (x[0] + x[2]) + (x[1] + x[3]);
}

void hs_sum_segments(const float *x, uint32_t n, const float *cosine, const float *sine,
                   uint16_t segment, hs_sums *out)
{
    uint32_t from;
    for (from = 0; from < n; from += segment) {
        const uint32_t left = n - from;
        hs_kept kept;
        sum_segment(x + from, cosine, sine, left < segment ? (uint16_t)left : segment, kept);
        out->first = x[from];
        out->cosine = add_kept(kept[0]);
        out->sine = add_kept(kept[1]);
        out->level = add_kept(kept[2]);
        out->ramp = add_kept(kept[3]);
        out->square = add_kept(kept[4]);
        ++out;
    }
}

hs_phasor hs_phasor_of_segment(const float inverse[8], const hs_sums *sums)
{
    const float b[4] = {sums->cosine, sums->sine, sums->level, sums->ramp};
    hs_phasor p = {0.0f, 0.0f};
    uint8_t j;
    for (j = 0; j < 4; ++j) {
        p.re += inverse[j] * b[j];
        p.im -= inverse[4 + j] * b[j]; /* x = re cos - im sin */
    }
    return p;
}

static uint8_t lost(const hs_phasor *p, float floor)
{
    const float square = p->re * p->re + p->im * p->im;
    return !(square > floor * floor && square <= HS_LARGEST);
}

hs_impedance hs_impedance_of(const hs_impedance_config *config, const hs_phasor *v,
                             const hs_phasor *i)
{
    hs_impedance z = {0.0f, 0.0f, HS_AMPLITUDE_LOST};
    float v2, ratio_re, ratio_im, y_re, y_im, y2, x;

    if (lost(v, config->min_amplitude) || lost(i, config->min_amplitude)) {
        return z;
    }
    v2 = v->re * v->re + v->im * v->im;
    ratio_re = (i->re * v->re + i->im * v->im) / v2;
    ratio_im = (i->im * v->re - i->re * v->im) / v2;
    y_re = config->scale_re * ratio_re - config->scale_im * ratio_im - config->stray_re;
    y_im = config->scale_re * ratio_im + config->scale_im * ratio_re - config->stray_im;
    /* Admittances are small: their squares would underflow a float. */
    x = y_re / y_im;
    y2 = y_im * (1.0f + x * x);
    if (!(y_im > 0.0f && y_re > -HS_LEAD * y_im && y2 > 0.0f && y2 <= HS_LARGEST)) {
        z.reason = HS_PHASE_OUT;
        return z;
    }
    z.capacitance_f = y2 / config->omega_rad_s; /* 1 / (omega |Im Z|), Im Z = -1 / y2 */
    z.resistance_ohm = x / y2;
    z.reason = 0;
    return z;
}

hs_quadrature hs_demodulate_quadrature(const int16_t x[HS_QUADRATURE_SAMPLES])
{
    hs_quadrature sums;
    sums.re = (int16_t)(x[1] - 2 * x[2] + x[3] + x[5] - 2 * x[6] + x[7]);
    sums.im = (int16_t)(x[2] - x[1] + x[3] - x[5] - x[6] + x[7]); /* x = re cos - im sin */
    return sums;
}

hs_capacitance hs_capacitance_of(const hs_quadrature_config *config, hs_quadrature v,
                                 hs_quadrature i)
{
    hs_capacitance c = {0.0f, HS_AMPLITUDE_LOST};
    const int32_t v2 = (int32_t)v.re * v.re + (int32_t)v.im * v.im;
    const int32_t i2 = (int32_t)i.re * i.re + (int32_t)i.im * i.im;
    float re, im, x, y;

    if (v2 < config->v_low || v2 > config->v_high || i2 < config->i_low) {
        return c;
    }
    re = (float)((int32_t)v.re * i.re + (int32_t)v.im * i.im);
    im = (float)((int32_t)v.im * i.re - (int32_t)v.re * i.im);
    x = config->turn_re * re - config->turn_im * im;
    y = config->turn_re * im + config->turn_im * re;
    if (!(y < 0.0f && x > HS_LEAD * y)) {
        c.reason = HS_PHASE_OUT;
        return c;
    }
    c.capacitance_f = (float)i2 / -y;
    c.reason = 0;
    return c;
}
