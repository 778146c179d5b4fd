/* Normal random numbers of the monitors' noise (xoshiro256++, Box-Muller): for twin.c alone, which
 * includes it once. */
#ifndef TWIN_NOISE_H
#define TWIN_NOISE_H

#include "twin/twin.h"

#include <math.h>
#include <stdint.h>
#include <string.h>

#ifndef HS_CLONES
#define HS_CLONES
#endif

static uint64_t rotate(uint64_t x, int k) { return (x << k) | (x >> (64 - k)); }

static uint64_t draw(uint64_t *r)
{
    const uint64_t out = rotate(r[0] + r[3], 23) + r[0];
    const uint64_t t = r[1] << 17;
    r[2] ^= r[0];
    r[3] ^= r[1];
    r[1] ^= r[2];
    r[0] ^= r[3];
    r[2] ^= t;
    r[3] = rotate(r[3], 45);
    return out;
}

/* Natural logarithm of a positive normal number, to 1e-12. */
static inline double logarithm(float x)
{
    int32_t bits, exponent;
    float share; /* x = share * 2^exponent, share from 2/3 to 4/3 */
    double s, z;
    memcpy(&bits, &x, sizeof bits);
    bits -= 0x3f2aaaab;
    exponent = bits >> 23;
    bits = (bits & 0x7fffff) + 0x3f2aaaab;
    memcpy(&share, &bits, sizeof share);
    s = ((double)share - 1.0) / ((double)share + 1.0);
    z = s * s;
    return (double)exponent * 0.6931471805599453 +
           2.0 * s *
               (1.0 + z * (1.0 / 3.0 +
                           z * (1.0 / 5.0 +
                                z * (1.0 / 7.0 +
                                     z * (1.0 / 9.0 +
                                          z * (1.0 / 11.0 +
                                               z * (1.0 / 13.0 + z * (1.0 / 15.0))))))));
}

/* Sine and cosine of an angle from 0 to 2 pi, to 1e-13. */
static inline void sine_cosine(double angle, double *sine, double *cosine)
{
    const double nearest = 6755399441055744.0; /* 1.5 * 2^52: a sum with it is a whole number */
    const double quarters = (angle * 0.6366197723675814 + nearest) - nearest;
    const double y = (angle - quarters * 1.5707963267948966) - quarters * 6.123233995736766e-17;
    const double z = y * y;
    const double s =
        y + y * z * (-1.0 / 6.0 + z * (1.0 / 120.0 + z * (-1.0 / 5040.0 + z * (1.0 / 362880.0 -
            z * (1.0 / 39916800.0 - z * (1.0 / 6227020800.0))))));
    const double c =
        1.0 - z * (0.5 - z * (1.0 / 24.0 - z * (1.0 / 720.0 - z * (1.0 / 40320.0 -
            z * (1.0 / 3628800.0 - z * (1.0 / 479001600.0 - z * (1.0 / 87178291200.0)))))));
    const int odd = quarters == 1.0 || quarters == 3.0;
    const double first = odd ? c : s, second = odd ? s : c;
    *sine = quarters == 2.0 || quarters == 3.0 ? -first : first;
    *cosine = quarters == 1.0 || quarters == 2.0 ? -second : second;
}

/* Two normal numbers of each pair of 24 bits. */
HS_CLONES static void normal_of(const int32_t *length, const int32_t *turn, float *a, float *b)
{
    int j;
    for (j = 0; j < TWIN_SUB; ++j) {
        const float u = ((float)length[j] + 0.5f) * 5.9604645e-8f; /* 2^-24 */
        const float w = (float)turn[j] * 3.7450703e-7f;            /* 2 pi / 2^24 */
        const float radius = sqrtf(-2.0f * (float)logarithm(u));
        double sine, cosine;
        sine_cosine((double)w, &sine, &cosine);
        a[j] = radius * (float)cosine;
        b[j] = radius * (float)sine;
    }
}

static void normal_pairs(uint64_t *r, float *a, float *b)
{
    int32_t length[TWIN_SUB], turn[TWIN_SUB];
    int j;
    for (j = 0; j < TWIN_SUB; ++j) {
        const uint64_t bits = draw(r);
        length[j] = (int32_t)(bits >> 40);
        turn[j] = (int32_t)(bits & 0xFFFFFFu);
    }
    normal_of(length, turn, a, b);
}

#endif
