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
    static int16_t codes[2 * SAMPLES];
    static float weights[2 * SAMPLES];
    const hs_impedance_config c = {2.5e6f, 12566.3706f, 0.99950656f, -0.0314107591f, 5.0f};
    hs_phasors p;
    hs_impedance z;
    int k;
    for (k = 0; k < 2 * SAMPLES; ++k) {
        codes[k] = (int16_t)(check_draw(seed) >> 16);
        weights[k] = check_uniform(seed, -1.0f, 1.0f);
    }
    p = hs_demodulate(codes, weights, SAMPLES);
    z = hs_impedance_from_phasors(&c, &p);
    mix(p.v_re), mix(p.v_im), mix(p.i_re), mix(p.i_im);
    mix(z.capacitance_f), mix(z.resistance_ohm), mix((float)z.valid);
}

int main(void)
{
    const hs_voltage_map volt = {1.324f, 3.124f, -0.2805f, -26.92f};
    const hs_strain_map strain = {4.923e6f, -0.276f, -1.0e13f};
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
        mix(hs_strain_from_capacitance(&strain, check_uniform(&seed, 1e-8f, 9e-8f)));
        mix(hs_pid_step(&pid, &state, x, check_uniform(&seed, -0.05f, 0.1f)));
    }
    printf("%016llx\n", (unsigned long long)hash);
    return 0;
}
