/* Normal numbers by counting: the number of loop `key` at sample k is a function of these alone, so
 * any order and any vector unit give the same bits. Plain C that a compiler can vectorise. Inside
 * the loops only.
 *
 * Source: a 32-bit mixer by C. Wellons (triple32, public domain). The normal quantile as a function
 * of w = -ln(1 - u^2), after M. Giles (GPU Computing Gems, Jade edition, ch. 10); both polynomials
 * are this project's, minimax by Lawson's weights: 2e-6 for the logarithm, 7e-5 of the quantile. */
#ifndef HASELAB_LOOPS_NOISE_H
#define HASELAB_LOOPS_NOISE_H

#include <stddef.h>
#include <stdint.h>
#include <string.h>

static inline uint32_t noise_mix(uint32_t x)
{
    x ^= x >> 17;
    x *= 0xed5ad4bbu;
    x ^= x >> 11;
    x *= 0xac4c1b51u;
    x ^= x >> 15;
    x *= 0x31848babu;
    return x ^ (x >> 14);
}

/* Logarithm to base 2 of a positive normal number. */
static inline float noise_log2(float value)
{
    uint32_t bits, mantissa;
    float x, y;

    memcpy(&bits, &value, sizeof bits);
    mantissa = (bits & 0x007fffffu) | 0x3f800000u;
    memcpy(&x, &mantissa, sizeof x);
    x -= 1.0f;
    y = -0.0256910753f;
    y = y * x + 0.121002197f;
    y = y * x - 0.276540697f;
    y = y * x + 0.45652163f;
    y = y * x - 0.71779108f;
    y = y * x + 1.44249535f;
    y = y * x + 1.84569194e-06f;
    return y + (float)((int32_t)(bits >> 23) - 127);
}

/* The middle of one of 2^24 equal parts of (-1, 1); 1 is never reached. */
static inline float noise_uniform(uint32_t random)
{
    return ((float)(int32_t)(random >> 8) - 8388607.5f) * 1.1920928955078125e-7f;
}

/* w / 8 - 1, where w = -ln(1 - u^2) is below 16. */
static inline float noise_depth(float u)
{
    return -0.0866433976f * noise_log2((1.0f - u) * (1.0f + u)) - 1.0f;
}

/* Normal quantile of (1 + u) / 2, at most 5.42. */
static inline float noise_quantile(float u, float depth)
{
    float y = -0.0383769274f;
    y = y * depth - 0.0382726714f;
    y = y * depth + 0.169050753f;
    y = y * depth - 0.0557550602f;
    y = y * depth - 0.103671849f;
    y = y * depth + 0.187682867f;
    y = y * depth - 0.448950946f;
    y = y * depth + 1.99461162f;
    y = y * depth + 3.76360989f;
    return u * y;
}

/* Noise of one loop at a sample: `count` is noise_count() of it, `key` the loop's. */
static inline float noise_value(uint32_t count, uint32_t key, float std)
{
    const float u = noise_uniform(noise_mix(count ^ key));
    return std * noise_quantile(u, noise_depth(u));
}

static inline uint32_t noise_count(size_t sample, uint32_t seed)
{
    return noise_mix((uint32_t)sample + seed);
}

#endif
