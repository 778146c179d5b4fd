/* Sums and phasors against the same in double, and impedance against complex arithmetic. */
#include <complex.h>
#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "check.h"
#include "hs.h"

#define MOST 300
#define PI 3.141592653589793

static void fill_table(float *cosine, float *sine, int n, double period)
{
    int k;
    for (k = 0; k < n; ++k) {
        cosine[k] = (float)cos(2.0 * PI * k / period);
        sine[k] = (float)sin(2.0 * PI * k / period);
    }
}

/* One lane adds n / 16 products, then 16 lanes are added: each partial sum is rounded once; the
 * difference to the first reading and the product once more. */
static void check_sum(const char *what, double got, const float *x, const float *weight, int n)
{
    double sum = 0.0, magnitude = 0.0, bound;
    int k;
    for (k = 0; k < n; ++k) {
        const double term = ((double)x[k] - (double)x[0]) * (double)weight[k];
        sum += term;
        magnitude += fabs(term);
    }
    bound = (n / 16 + 24) * ROUNDOFF * magnitude;
    CHECK(fabs(got - sum) <= bound, "%s of %d: got %.9g, exact %.9g, bound %.2g", what, n, got,
          sum, bound);
}

static void random_readings_agree_with_sums_in_double(void)
{
    static float x[MOST], cosine[MOST], sine[MOST], one[MOST], self[MOST];
    static const int lengths[] = {1, 3, 15, 16, 17, 64, 112, 255, 256, MOST};
    uint32_t seed = 1;
    size_t j;
    int k;

    fill_table(cosine, sine, MOST, 100.0);
    for (j = 0; j < sizeof lengths / sizeof *lengths; ++j) {
        const int n = lengths[j];
        hs_sums s;
        for (k = 0; k < n; ++k) {
            x[k] = check_uniform(&seed, -32768.0f, 32767.0f);
            one[k] = 1.0f;
        }
        for (k = 0; k < n; ++k) {
            self[k] = x[k] - x[0];
        }
        hs_sum_segments(x, (uint32_t)n, cosine, sine, MOST, &s);
        CHECK(s.first == x[0], "%g", (double)s.first);
        check_sum("cosine", (double)s.cosine, x, cosine, n);
        check_sum("sine", (double)s.sine, x, sine, n);
        check_sum("level", (double)s.level, x, one, n);
        check_sum("square", (double)s.square, x, self, n);
        { /* the ramp is a difference of two sums up to n times the level's magnitude */
            double sum = 0.0, magnitude = 0.0;
            for (k = 0; k < n; ++k) {
                sum += ((double)x[k] - (double)x[0]) * k;
                magnitude += fabs((double)x[k] - (double)x[0]) * n;
            }
            CHECK(fabs((double)s.ramp - sum) <= (n / 16 + 24) * ROUNDOFF * magnitude,
                  "ramp of %d: got %.9g, exact %.9g", n, (double)s.ramp, sum);
        }
    }
}

static void a_block_falls_into_segments_the_last_of_which_is_shorter(void)
{
    static float x[250], cosine[100], sine[100];
    hs_sums all[3], one;
    uint32_t seed = 3;
    int k;
    fill_table(cosine, sine, 100, 100.0);
    for (k = 0; k < 250; ++k) {
        x[k] = check_uniform(&seed, -10.0f, 10.0f);
    }
    hs_sum_segments(x, 250, cosine, sine, 100, all);
    for (k = 0; k < 3; ++k) {
        hs_sum_segments(x + 100 * k, k < 2 ? 100 : 50, cosine, sine, 100, &one);
        CHECK(memcmp(&one, &all[k], sizeof one) == 0, "segment %d", k);
    }
}

static void nothing_beyond_the_block_is_read(void)
{
    /* Exactly as large as the block: the address sanitizer stops any read beyond. */
    float *x = calloc(37, sizeof *x), *wave = calloc(37, sizeof *wave);
    hs_sums s;
    if (x != NULL && wave != NULL) {
        hs_sum_segments(x, 37, wave, wave, 37, &s);
        CHECK(s.cosine == 0.0f && s.square == 0.0f, "%g %g", (double)s.cosine, (double)s.square);
    }
    free(x);
    free(wave);
}

static void what_is_no_number_reaches_the_sums(void)
{
    static float x[64], cosine[64], sine[64];
    hs_sums s;
    fill_table(cosine, sine, 64, 32.0);
    x[5] = NAN;
    hs_sum_segments(x, 64, cosine, sine, 64, &s);
    CHECK(!(s.square <= HS_LARGEST), "%g", (double)s.square);
}

static void a_sine_gives_its_phasor(void)
{
    /* 64 samples of 16 a period: (B'B)^-1 of cos, sin, 1, k has a closed form, made here. */
    static float x[64], cosine[64], sine[64];
    double m[4][8] = {{0}};
    float inverse[8];
    const double complex v = 1000.0 * cexp(0.3 * I);
    hs_sums s;
    hs_phasor p;
    int i, j, k;

    fill_table(cosine, sine, 64, 16.0);
    for (k = 0; k < 64; ++k) {
        const double turn = 2.0 * PI * k / 16.0, row[4] = {cos(turn), sin(turn), 1.0, k};
        x[k] = (float)(creal(v * cexp(turn * I)) + 300.0 + 7.0 * k);
        for (i = 0; i < 4; ++i) {
            for (j = 0; j < 4; ++j) {
                m[i][j] += row[i] * row[j];
            }
            m[i][4 + i] = 1.0;
        }
    }
    for (k = 0; k < 4; ++k) { /* Gauss-Jordan */
        const double pivot = m[k][k];
        for (j = 0; j < 8; ++j) {
            m[k][j] /= pivot;
        }
        for (i = 0; i < 4; ++i) {
            const double part = m[i][k];
            for (j = 0; i != k && j < 8; ++j) {
                m[i][j] -= part * m[k][j];
            }
        }
    }
    for (j = 0; j < 8; ++j) {
        inverse[j] = (float)m[j / 4][4 + j % 4];
    }
    hs_sum_segments(x, 64, cosine, sine, 64, &s);
    p = hs_phasor_of_segment(inverse, &s);
    /* Sums as large as 64 readings of 1,750 against 1,000, rounded some 30 times. */
    CHECK(cabs(v - ((double)p.re + (double)p.im * I)) < 30.0 * ROUNDOFF * 4.0 * 1750.0, "%g %g",
          (double)p.re, (double)p.im);
}

static hs_impedance_config config_for(double omega, double skew_s, float floor)
{
    hs_impedance_config c;
    c.scale_re = (float)(cos(omega * skew_s) / 2.5e6);
    c.scale_im = (float)(-sin(omega * skew_s) / 2.5e6);
    c.stray_re = c.stray_im = 0.0f;
    c.omega_rad_s = (float)omega;
    c.min_amplitude = floor;
    return c;
}

static hs_phasor phasor(double complex x)
{
    hs_phasor p;
    p.re = (float)creal(x);
    p.im = (float)cimag(x);
    return p;
}

static void series_resistor_and_capacitor_are_recovered_beside_a_stray(void)
{
    const double omega = 2.0 * PI * 2000.0;
    uint32_t seed = 7;
    int k;
    for (k = 0; k < 2000; ++k) {
        const double farad = (double)check_uniform(&seed, 0.2e-9f, 6e-9f);
        const double ohm = (double)check_uniform(&seed, 0.0f, 60e3f);
        const double skew_s = (double)check_uniform(&seed, 0.0f, 5e-6f);
        const double angle = (double)check_uniform(&seed, -3.0f, 3.0f);
        const double stray_s = (double)check_uniform(&seed, 0.0f, 1e-6f);
        const double complex z = ohm + 1.0 / (I * omega * farad), y = 1.0 / z + I * stray_s;
        const double complex v = 200.0 * cexp(I * angle);
        const double complex i = 2.5e6 * v * y * cexp(I * omega * skew_s); /* sampled later */
        hs_impedance_config c = config_for(omega, skew_s, 5.0f);
        const hs_phasor pv = phasor(v), pi = phasor(i);
        /* 16 roundings of terms as large as |Y|, seen from the imaginary part of Z. */
        const double bound = 16.0 * ROUNDOFF * cabs(y * z) * cabs(z) / fabs(cimag(z));
        hs_impedance got;
        c.stray_im = (float)stray_s;
        got = hs_impedance_of(&c, &pv, &pi);
        CHECK(got.reason == 0, "%d", got.reason);
        CHECK(fabs((double)got.capacitance_f / farad - 1.0) <= bound * cabs(z) / fabs(cimag(z)),
              "%g of %g F", (double)got.capacitance_f, farad);
        CHECK(fabs((double)got.resistance_ohm - ohm) <= 16.0 * ROUNDOFF * cabs(y * z) * cabs(z),
              "%g of %g ohm", (double)got.resistance_ohm, ohm);
    }
}

static void a_lost_carrier_and_a_phase_of_no_capacitor_are_told(void)
{
    const hs_impedance_config c = config_for(12566.37, 0.0, 5.0f);
    static const struct {
        hs_phasor v, i;
        uint8_t reason;
    } cases[] = {
        {{0.0f, 0.0f}, {0.0f, 0.0f}, HS_AMPLITUDE_LOST},
        {{100.0f, 0.0f}, {3.0f, 3.0f}, HS_AMPLITUDE_LOST},
        {{3.0f, 3.0f}, {0.0f, 100.0f}, HS_AMPLITUDE_LOST},
        {{NAN, 0.0f}, {0.0f, 100.0f}, HS_AMPLITUDE_LOST},
        {{100.0f, 0.0f}, {0.0f, NAN}, HS_AMPLITUDE_LOST},
        {{100.0f, 0.0f}, {100.0f, 0.0f}, HS_PHASE_OUT},   /* a resistor */
        {{100.0f, 0.0f}, {0.0f, -100.0f}, HS_PHASE_OUT},  /* channels swapped */
        {{100.0f, 0.0f}, {-90.0f, 100.0f}, HS_PHASE_OUT}, /* a resistance far below 0 */
        {{100.0f, 0.0f}, {-20.0f, 100.0f}, 0},            /* what a monitor's lag explains */
    };
    size_t k;
    for (k = 0; k < sizeof cases / sizeof *cases; ++k) {
        const hs_impedance z = hs_impedance_of(&c, &cases[k].v, &cases[k].i);
        CHECK(z.reason == cases[k].reason, "case %u: %d", (unsigned)k, z.reason);
        CHECK((z.capacitance_f == 0.0f) == (z.reason != 0), "case %u: %g F", (unsigned)k,
              (double)z.capacitance_f);
    }
}

/* Readings of 12 bits every 5 quarter periods, rounded: half a unit each, weights 8 and 6 of a
 * quarter. The first of each period may hold anything. */
static void quadrature_samples_give_the_phasor_whatever_drifts_beneath(void)
{
    uint32_t seed = 7;
    int trial, k;
    for (trial = 0; trial < 1000; ++trial) {
        const double re = (double)check_uniform(&seed, -800.0f, 800.0f);
        const double im = (double)check_uniform(&seed, -800.0f, 800.0f);
        const double level = (double)check_uniform(&seed, 1500.0f, 2500.0f);
        const double ramp = (double)check_uniform(&seed, -40.0f, 40.0f);
        int16_t x[HS_QUADRATURE_SAMPLES];
        hs_quadrature sums;
        for (k = 0; k < HS_QUADRATURE_SAMPLES; ++k) {
            const double angle = 1.25 * 2.0 * 3.14159265358979 * k;
            x[k] = (int16_t)lrint(re * cos(angle) - im * sin(angle) + level + ramp * k);
        }
        x[0] = (int16_t)(check_draw(&seed) >> 20);
        x[4] = (int16_t)(check_draw(&seed) >> 20);
        sums = hs_demodulate_quadrature(x);
        CHECK(fabs(sums.re - 4.0 * re) <= 4.0 + 1e-6, "%d of 4 * %g", sums.re, re);
        CHECK(fabs(sums.im - 4.0 * im) <= 3.0 + 1e-6, "%d of 4 * %g", sums.im, im);
    }
}

/* omega Z in double. */
static void reactance(double turn_re, double turn_im, hs_quadrature v, hs_quadrature i, double z[2])
{
    const double i2 = (double)i.re * i.re + (double)i.im * i.im;
    const double re = ((double)v.re * i.re + (double)v.im * i.im) / i2;
    const double im = ((double)v.im * i.re - (double)v.re * i.im) / i2;
    z[0] = turn_re * re - turn_im * im;
    z[1] = turn_re * im + turn_im * re;
}

/* 5 roundings of the largest term in the sum that is divided by, and 3 of the quotient. */
static void capacitance_is_the_reactance_turned_over(void)
{
    const hs_quadrature_config c = {1.1e9f, -0.9e9f, 1601, 2147483647, 1601};
    uint32_t seed = 77;
    int trial, valid = 0;
    for (trial = 0; trial < 20000; ++trial) {
        const hs_quadrature v = {(int16_t)(check_draw(&seed) >> 17),
                               (int16_t)(check_draw(&seed) >> 18)};
        const hs_quadrature i = {(int16_t)(check_draw(&seed) >> 18),
                               (int16_t)(check_draw(&seed) >> 17)};
        const hs_capacitance got = hs_capacitance_of(&c, v, i);
        double z[2];
        reactance((double)c.turn_re, (double)c.turn_im, v, i, z);
        if (got.reason == 0) {
            const double term = 2.0e9 * hypot(v.re, v.im) / hypot(i.re, i.im);
            const double bound = (5.0 * term / -z[1] + 3.0) * ROUNDOFF;
            ++valid;
            CHECK(fabs((double)got.capacitance_f * -z[1] - 1.0) <= bound, "%.9g of %.9g",
                  (double)got.capacitance_f, -1.0 / z[1]);
        } else if (got.reason == HS_PHASE_OUT) {
            CHECK(z[1] >= 0.0 || z[0] < (0.25 - 1e-4) * z[1], "%g, %g", z[0], z[1]);
        }
    }
    CHECK(valid > 5000, "only %d", valid);
}

/* The two ways to a capacitance, for the same element. */
static void one_division_gives_what_five_give(void)
{
    const hs_impedance_config full = {2.0e-5f, 0.0f, 0.0f, 0.0f, 31415.9f, 10.0f};
    const hs_quadrature_config few = {31415.9f / 2.0e-5f, 0.0f, 1601, 2147483647, 1601};
    const hs_quadrature v = {1000, -300}, i = {260, 900}; /* a lead of 90.6 degrees */
    const hs_phasor vf = {250.0f, -75.0f}, vi = {65.0f, 225.0f};
    const hs_impedance z = hs_impedance_of(&full, &vf, &vi);
    const hs_capacitance c = hs_capacitance_of(&few, v, i);
    CHECK(z.reason == 0 && c.reason == 0, "%d %d", z.reason, c.reason);
    CHECK(fabs((double)c.capacitance_f / (double)z.capacitance_f - 1.0) <= 40.0 * ROUNDOFF,
          "%.9g of %.9g", (double)c.capacitance_f, (double)z.capacitance_f);
}

static void quadrature_knows_what_hides_the_capacitance(void)
{
    const hs_quadrature_config c = {1e9f, 0.0f, 1600, 1000000, 1600};
    const hs_quadrature good = {400, 0}, small = {39, 0}, large = {1001, 0}, lead = {0, 400};
    const hs_quadrature widest = {32760, -32760}; /* the squares just stay within 31 bits */
    CHECK(hs_capacitance_of(&c, good, lead).reason == 0, "capacitor");
    CHECK(hs_capacitance_of(&c, small, lead).reason == HS_AMPLITUDE_LOST, "no voltage");
    CHECK(hs_capacitance_of(&c, large, lead).reason == HS_AMPLITUDE_LOST, "too much voltage");
    CHECK(hs_capacitance_of(&c, good, small).reason == HS_AMPLITUDE_LOST, "no current");
    CHECK(hs_capacitance_of(&c, good, good).reason == HS_PHASE_OUT, "a resistor");
    CHECK(hs_capacitance_of(&c, lead, good).reason == HS_PHASE_OUT, "channels swapped");
    CHECK(hs_capacitance_of(&c, widest, widest).reason == HS_AMPLITUDE_LOST, "wrapped");
    CHECK(hs_capacitance_of(&c, good, small).capacitance_f == 0.0f, "a number without a reason");
}

int main(void)
{
    quadrature_samples_give_the_phasor_whatever_drifts_beneath();
    capacitance_is_the_reactance_turned_over();
    one_division_gives_what_five_give();
    quadrature_knows_what_hides_the_capacitance();
    random_readings_agree_with_sums_in_double();
    a_block_falls_into_segments_the_last_of_which_is_shorter();
    nothing_beyond_the_block_is_read();
    what_is_no_number_reaches_the_sums();
    a_sine_gives_its_phasor();
    series_resistor_and_capacitor_are_recovered_beside_a_stray();
    a_lost_carrier_and_a_phase_of_no_capacitor_are_told();
    return check_end();
}
