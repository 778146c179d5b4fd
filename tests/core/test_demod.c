/* Demodulation against the same sums in double, and impedance against complex arithmetic. */
#include <complex.h>
#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "check.h"
#include "hs.h"

#define SAMPLES 2000
#define PERIOD 100
#define PI 3.141592653589793

/* Rows of the pseudo-inverse for a whole number of periods without a slope: 2/n cos, 2/n sin. */
static void fill_weights(float *weights)
{
    int k;
    for (k = 0; k < SAMPLES; ++k) {
        weights[2 * k] = (float)(2.0 / SAMPLES * cos(2.0 * PI * k / PERIOD));
        weights[2 * k + 1] = (float)(2.0 / SAMPLES * sin(2.0 * PI * k / PERIOD));
    }
}

/* One lane adds n / 8 products, then 8 lanes are added: each partial sum is rounded once. */
static void check_channel(const char *what, const int16_t *codes, const float *weights, int n,
                          float got, int column, double sign)
{
    double sum = 0.0, magnitude = 0.0, bound;
    int k;
    for (k = 0; k < n; ++k) {
        const double term = (double)codes[2 * k] * (double)weights[2 * k + column];
        sum += sign * term;
        magnitude += fabs(term);
    }
    bound = (n / 8 + 9) * ROUNDOFF * magnitude;
    CHECK(fabs((double)got - sum) <= bound, "%s: got %.9g, exact %.9g, bound %.2g", what,
          (double)got, sum, bound);
}

static void random_codes_agree_with_sums_in_double(void)
{
    static int16_t codes[2 * SAMPLES];
    static float weights[2 * SAMPLES];
    static const int lengths[] = {8, 16, 80, SAMPLES};
    uint32_t seed = 1;
    size_t j;
    int k;

    fill_weights(weights);
    for (j = 0; j < sizeof lengths / sizeof *lengths; ++j) {
        const int n = lengths[j];
        hs_phasors p;
        for (k = 0; k < 2 * n; ++k) {
            codes[k] = (int16_t)(check_draw(&seed) >> 16);
        }
        p = hs_demodulate(codes, weights, (uint16_t)n);
        check_channel("v_re", codes, weights, n, p.v_re, 0, 1.0);
        check_channel("v_im", codes, weights, n, p.v_im, 1, -1.0);
        check_channel("i_re", codes + 1, weights, n, p.i_re, 0, 1.0);
        check_channel("i_im", codes + 1, weights, n, p.i_im, 1, -1.0);
    }
}

static void nothing_beyond_the_block_is_read(void)
{
    /* Exactly as large as the block: the address sanitizer stops any read beyond. */
    int16_t *codes = calloc(16, sizeof *codes);
    float *weights = calloc(16, sizeof *weights);
    if (codes != NULL && weights != NULL) {
        const hs_phasors p = hs_demodulate(codes, weights, 8);
        CHECK(p.v_re == 0.0f && p.i_im == 0.0f, "%g %g", (double)p.v_re, (double)p.i_im);
    }
    free(codes);
    free(weights);
}

static void a_sine_gives_its_phasors_within_half_a_code(void)
{
    static int16_t codes[2 * SAMPLES];
    static float weights[2 * SAMPLES];
    const double complex v = 1000.0 * cexp(0.3 * I), i = 20000.0 * cexp(1.7 * I);
    hs_phasors p;
    int k;

    fill_weights(weights);
    for (k = 0; k < SAMPLES; ++k) {
        const double complex turn = cexp(2.0 * PI * k / PERIOD * I);
        codes[2 * k] = (int16_t)lrint(creal(v * turn));
        codes[2 * k + 1] = (int16_t)lrint(creal(i * turn));
    }
    p = hs_demodulate(codes, weights, SAMPLES);
    /* Rounding errs by at most 0.5 a sample; the mean of |cos| times 2 is 4 / pi. */
    CHECK(cabs(v - ((double)p.v_re + (double)p.v_im * I)) < 0.5 * sqrt(2.0) * 4.0 / PI, "%g %g",
          (double)p.v_re, (double)p.v_im);
    CHECK(cabs(i - ((double)p.i_re + (double)p.i_im * I)) < 0.5 * sqrt(2.0) * 4.0 / PI, "%g %g",
          (double)p.i_re, (double)p.i_im);
}

static hs_impedance_config config_for(double omega, double skew_s, float floor)
{
    hs_impedance_config c;
    c.v_per_i = 2.5e6f;
    c.omega_rad_s = (float)omega;
    c.skew_re = (float)cos(omega * skew_s);
    c.skew_im = (float)-sin(omega * skew_s);
    c.min_amplitude = floor;
    return c;
}

static void series_resistor_and_capacitor_are_recovered(void)
{
    const double omega = 2.0 * PI * 2000.0;
    uint32_t seed = 7;
    int k;
    for (k = 0; k < 2000; ++k) {
        const double farad = (double)check_uniform(&seed, 0.2e-9f, 6e-9f);
        const double ohm = (double)check_uniform(&seed, 0.0f, 60e3f);
        const double skew_s = (double)check_uniform(&seed, 0.0f, 5e-6f);
        const double angle = (double)check_uniform(&seed, -3.0f, 3.0f);
        const double complex z = ohm + 1.0 / (I * omega * farad);
        const double complex v = 200.0 * cexp(I * angle);
        const double complex i = 2.5e6 * v / z * cexp(I * omega * skew_s); /* sampled later */
        const hs_impedance_config c = config_for(omega, skew_s, 5.0f);
        hs_phasors p;
        hs_impedance got;
        /* 14 roundings of terms as large as |v| |i|, seen from the imaginary part. */
        const double bound = 14.0 * ROUNDOFF * cabs(z) / fabs(cimag(z));
        p.v_re = (float)creal(v);
        p.v_im = (float)cimag(v);
        p.i_re = (float)creal(i);
        p.i_im = (float)cimag(i);
        got = hs_impedance_from_phasors(&c, &p);
        CHECK(got.valid == 1, "%d", got.valid);
        CHECK(fabs((double)got.capacitance_f / farad - 1.0) <= bound, "%g of %g F",
              (double)got.capacitance_f, farad);
        CHECK(fabs((double)got.resistance_ohm - ohm) <= 14.0 * ROUNDOFF * cabs(z), "%g of %g ohm",
              (double)got.resistance_ohm, ohm);
    }
}

static void a_lost_carrier_is_not_valid_and_gives_zeros(void)
{
    const hs_impedance_config c = config_for(12566.37, 0.0, 5.0f);
    const hs_phasors lost[] = {
        {0.0f, 0.0f, 0.0f, 0.0f},     {100.0f, 0.0f, 3.0f, 3.0f}, {3.0f, 3.0f, 0.0f, 100.0f},
        {100.0f, 0.0f, 100.0f, 0.0f}, /* no reactance */
        {NAN, 0.0f, 0.0f, 100.0f},    {100.0f, 0.0f, 0.0f, NAN},
    };
    size_t k;
    for (k = 0; k < sizeof lost / sizeof *lost; ++k) {
        const hs_impedance z = hs_impedance_from_phasors(&c, &lost[k]);
        CHECK(z.valid == 0 && z.capacitance_f == 0.0f && z.resistance_ohm == 0.0f, "case %u: %g F",
              (unsigned)k, (double)z.capacitance_f);
    }
}

int main(void)
{
    random_codes_agree_with_sums_in_double();
    nothing_beyond_the_block_is_read();
    a_sine_gives_its_phasors_within_half_a_code();
    series_resistor_and_capacitor_are_recovered();
    a_lost_carrier_is_not_valid_and_gives_zeros();
    return check_end();
}
