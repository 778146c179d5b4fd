/* Prints one hash over the bits that the core puts out for a fixed set of inputs. Inputs are made
 * with integer arithmetic and exact float operations: the hash may not depend on the compiler's
 * optimisation or on the machine. */
#include <string.h>

#include "check.h"
#include "hs.h"

#define SAMPLES 400

static uint64_t hash = 0xcbf29ce484222325u; /* FNV-1a */

static void mix(float value)
{
    uint32_t bits;
    int k;
    memcpy(&bits, &value, sizeof bits);
    for (k = 0; k < 4; ++k) {
        hash = (hash ^ (bits & 0xffu)) * 0x100000001b3u;
        bits >>= 8;
    }
}

static void demodulation(uint32_t *seed)
{
    static float x[SAMPLES], cosine[SAMPLES], sine[SAMPLES];
    const hs_impedance_config c = {3.998e-7f, -1.257e-8f, 0.0f, 1e-7f, 12566.3706f, 5.0f};
    hs_sums sums[4];
    hs_impedance z;
    hs_phasor v, i;
    float inverse[8];
    const hs_quadrature_config few = {1.1e9f, -0.9e9f, 100, 2147483647, 100};
    int16_t samples[2][HS_QUADRATURE_SAMPLES];
    hs_capacitance farad;
    int k;
    for (k = 0; k < SAMPLES; ++k) {
        x[k] = (float)(int16_t)(check_draw(seed) >> 16);
        cosine[k] = check_uniform(seed, -1.0f, 1.0f);
        sine[k] = check_uniform(seed, -1.0f, 1.0f);
    }
    for (k = 0; k < 8; ++k) {
        inverse[k] = check_uniform(seed, -1.0f, 1.0f);
    }
    hs_sum_segments(x, SAMPLES, cosine, sine, 112, sums);
    for (k = 0; k < 4; ++k) {
        mix(sums[k].first), mix(sums[k].cosine), mix(sums[k].sine);
        mix(sums[k].level), mix(sums[k].ramp), mix(sums[k].square);
    }
    v = hs_phasor_of_segment(inverse, &sums[0]);
    i = hs_phasor_of_segment(inverse, &sums[1]);
    z = hs_impedance_of(&c, &v, &i);
    mix(v.re), mix(v.im), mix(i.re), mix(i.im);
    for (k = 0; k < HS_QUADRATURE_SAMPLES; ++k) {
        samples[0][k] = (int16_t)(check_draw(seed) >> 20);
        samples[1][k] = (int16_t)(check_draw(seed) >> 20);
    }
    farad = hs_capacitance_of(&few, hs_demodulate_quadrature(samples[0]),
                              hs_demodulate_quadrature(samples[1]));
    mix(farad.capacitance_f), mix((float)farad.reason);
    mix(z.capacitance_f), mix(z.resistance_ohm), mix((float)z.reason);
}

int main(void)
{
    const float value[4] = {0.055f, 1.0f, 1.4f, 1.79f};
    const hs_table table = {-0.05f, 20.0f, 3, value};
    const hs_voltage_map volt = {1.324f, 3.124f, -0.2805f, -26.92f};
    const hs_strain_map strain = {4.923e6f, -0.276f, -1.0e13f, 3.0e19f};
    const hs_pid_config pid = {0.85f, 1.5f, 0.15f, 0.01f, 0.333333343f, -0.05f, 0.1f};
    hs_pid_state state;
    uint32_t seed = 2018;
    int k;

    for (k = 0; k < 500; ++k) {
        demodulation(&seed);
    }
    hs_pid_init(&state, 0.01f);
    for (k = 0; k < 100000; ++k) {
        const float x = check_uniform(&seed, -0.05f, 0.1f);
        mix(hs_exp(check_uniform(&seed, -88.0f, 89.0f)));
        mix(hs_voltage_from_strain(&volt, x));
        mix(hs_table_at(&table, x));
        mix(hs_strain_from_capacitance(&strain, check_uniform(&seed, 1e-8f, 9e-8f)));
        mix(hs_pid_step(&pid, &state, x, check_uniform(&seed, -0.05f, 0.1f)));
    }
    printf("%016llx\n", (unsigned long long)hash);
    return 0;
}
