/* Exponential, maps and limiter against libm in double. */
#include <float.h>
#include <math.h>
#include <string.h>

#include "check.h"
#include "hs.h"

static float from_bits(uint32_t bits)
{
    float value;
    memcpy(&value, &bits, sizeof value);
    return value;
}

/* Error in units of the float spacing at the exact value. */
static double ulp_error(float got, double exact)
{
    int exponent;
    frexp(exact, &exponent);
    return fabs((double)got - exact) / ldexp(1.0, exponent - FLT_MANT_DIG);
}

static double worst_ulp(float largest, uint32_t sign)
{
    double worst = 0.0;
    uint32_t bits;
    /* From 2^-30, where exp rounds to 1, in steps of 211 patterns: a million arguments and more. */
    for (bits = 0x30800000u; from_bits(bits) <= largest; bits += 211u) {
        const float x = from_bits(bits | sign);
        const double e = ulp_error(hs_exp(x), exp((double)x));
        worst = e > worst ? e : worst;
    }
    return worst;
}

static void exp_is_within_one_ulp_on_minus_three_to_three(void)
{
    const double up = worst_ulp(3.0f, 0u), down = worst_ulp(3.0f, 0x80000000u);
    CHECK(up < 1.0, "%.4f ulp above 0", up);
    CHECK(down < 1.0, "%.4f ulp below 0", down);
    printf("exp on [-3, 3]: worst %.3f ulp\n", up > down ? up : down);
}

static void exp_keeps_its_words_at_the_edges(void)
{
    CHECK(hs_exp(0.0f) == 1.0f, "%.9g", (double)hs_exp(0.0f));
    CHECK(hs_exp(-0.0f) == 1.0f, "%.9g", (double)hs_exp(-0.0f));
    CHECK(hs_exp(-87.5f) == 0.0f, "%.9g", (double)hs_exp(-87.5f));
    CHECK(hs_exp(-INFINITY) == 0.0f, "%.9g", (double)hs_exp(-INFINITY));
    CHECK(hs_exp(88.5f) == FLT_MAX, "%.9g", (double)hs_exp(88.5f));
    CHECK(hs_exp(INFINITY) == FLT_MAX, "%.9g", (double)hs_exp(INFINITY));
    CHECK(hs_exp(NAN) == 0.0f, "%.9g", (double)hs_exp(NAN));
    CHECK(worst_ulp(88.0f, 0u) < 1.0, "%.4f", worst_ulp(88.0f, 0u));
    CHECK(worst_ulp(86.9f, 0x80000000u) < 1.0, "%.4f", worst_ulp(86.9f, 0x80000000u));
}

static void voltage_map_follows_its_formula(void)
{
    const hs_voltage_map map = {1.324f, 3.124f, -0.2805f, -26.92f}; /* eq. 4 of the study */
    uint32_t seed = 3;
    int k;
    for (k = 0; k < 20000; ++k) {
        const float strain = check_uniform(&seed, -0.05f, 0.1f);
        const double x1 = (double)map.b1 * (double)strain, x2 = (double)map.b2 * (double)strain;
        const double t1 = (double)map.a1_v * exp(x1), t2 = (double)map.a2_v * exp(x2);
        /* Rounded argument, exp within 1 ulp (2 roundoffs), product, sum. */
        const double bound =
            ROUNDOFF * (fabs(t1) * (fabs(x1) + 4.0) + fabs(t2) * (fabs(x2) + 4.0));
        const double got = (double)hs_voltage_from_strain(&map, strain);
        CHECK(fabs(got - t1 - t2) <= bound, "%.9g of %.9g at %g", got, t1 + t2, (double)strain);
    }
}

static void strain_map_follows_its_formula(void)
{
    const hs_strain_map maps[] = {{4.923e6f, -0.276f, 0.0f, 0.0f}, {3.1e8f, -0.4f, -2.0e16f, 4.0e23f}};
    uint32_t seed = 4;
    int k;
    for (k = 0; k < 20000; ++k) {
        const hs_strain_map *m = &maps[k % 2];
        const float farad = check_uniform(&seed, 0.1e-9f, 80e-9f);
        const double c = (double)farad;
        const double square = (double)m->curvature_per_f2 * c * c, line = (double)m->slope_per_f * c;
        const double cube = (double)m->cubic_per_f3 * c * c * c;
        const double exact = cube + square + line + (double)m->offset;
        const double bound = ROUNDOFF * (6.0 * fabs(cube) + 5.0 * fabs(square) + 3.0 * fabs(line) +
                                         fabs((double)m->offset));
        const double got = (double)hs_strain_from_capacitance(m, farad);
        CHECK(fabs(got - exact) <= bound, "%.9g of %.9g", got, exact);
    }
}

static void limit_acts_outside_and_only_there(void)
{
    uint8_t limited = 9;
    CHECK(hs_limit(0.03f, -0.05f, 0.1f, &limited) == 0.03f && limited == 0, "%d", limited);
    CHECK(hs_limit(-0.05f, -0.05f, 0.1f, &limited) == -0.05f && limited == 0, "%d", limited);
    CHECK(hs_limit(0.1f, -0.05f, 0.1f, &limited) == 0.1f && limited == 0, "%d", limited);
    CHECK(hs_limit(0.2f, -0.05f, 0.1f, &limited) == 0.1f && limited == 1, "%d", limited);
    CHECK(hs_limit(-1.0f, -0.05f, 0.1f, &limited) == -0.05f && limited == 1, "%d", limited);
    CHECK(hs_limit(INFINITY, -0.05f, 0.1f, &limited) == 0.1f && limited == 1, "%d", limited);
    CHECK(hs_limit(-INFINITY, -0.05f, 0.1f, &limited) == -0.05f && limited == 1, "%d", limited);
    CHECK(hs_limit(NAN, -0.05f, 0.1f, &limited) == 0.0f && limited == 1, "%d", limited);
}

static void a_table_is_straight_between_its_values_and_flat_beyond(void)
{
    const float value[5] = {1.0f, 3.0f, 2.0f, 2.5f, -4.0f};
    const hs_table table = {-0.5f, 4.0f, 4, value}; /* -0.5, -0.25, ... 0.5: exact in float */
    int k;
    for (k = 0; k <= 4; ++k) {
        const float x = -0.5f + 0.25f * (float)k;
        CHECK(hs_table_at(&table, x) == value[k], "%d: %.9g", k, (double)hs_table_at(&table, x));
    }
    CHECK(hs_table_at(&table, -0.4375f) == 1.5f, "%.9g", (double)hs_table_at(&table, -0.4375f));
    CHECK(hs_table_at(&table, 0.375f) == -0.75f, "%.9g", (double)hs_table_at(&table, 0.375f));
    CHECK(hs_table_at(&table, -9.0f) == 1.0f, "%.9g", (double)hs_table_at(&table, -9.0f));
    CHECK(hs_table_at(&table, 9.0f) == -4.0f, "%.9g", (double)hs_table_at(&table, 9.0f));
    CHECK(hs_table_at(&table, -INFINITY) == 1.0f, "%.9g", (double)hs_table_at(&table, -INFINITY));
    CHECK(hs_table_at(&table, INFINITY) == -4.0f, "%.9g", (double)hs_table_at(&table, INFINITY));
    CHECK(isnan(hs_table_at(&table, NAN)), "%.9g", (double)hs_table_at(&table, NAN));
}

int main(void)
{
    a_table_is_straight_between_its_values_and_flat_beyond();
    exp_is_within_one_ulp_on_minus_three_to_three();
    exp_keeps_its_words_at_the_edges();
    voltage_map_follows_its_formula();
    strain_map_follows_its_formula();
    limit_acts_outside_and_only_there();
    return check_end();
}
