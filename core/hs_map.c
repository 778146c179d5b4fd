/* Takes: strain or capacitance and constant coefficients. Gives: voltage, strain, limited value. */
#include "hs.h"

float hs_exp(float x)
{
    /* exp(x) = 2^k exp(r), |r| <= ln(2)/2; ln(2) in two parts keeps r exact. */
    const float log2e = 1.44269504f, ln2_high = 0.693145752f, ln2_low = 1.42860677e-6f;
    float r, p, kf;
    int16_t k;
    union {
        uint32_t bits;
        float value;
    } scale;

    if (!(x > -87.0f)) {
        return 0.0f;
    }
    if (x > 88.0f) {
        return 3.4028235e38f;
    }
    kf = x * log2e;
    k = (int16_t)(kf + (kf < 0.0f ? -0.5f : 0.5f));
    r = x - (float)k * ln2_high;
    r = r - (float)k * ln2_low;
    /* Minimax on |r| <= ln(2)/2: 0.06 roundoffs; 1 + (r + small) keeps the last sum's error small. */
    p = 0.5f + r * (0.166665345f + r * (0.0416672453f + r * (0.00836744066f + r * 0.0013863144f)));
    p = 1.0f + (r + r * r * p);
    scale.bits = (uint32_t)(k + 127) << 23;
    return p * scale.value;
}

float hs_voltage_from_strain(const hs_voltage_map *map, float strain)
{
    return map->a1_v * hs_exp(map->b1 * strain) + map->a2_v * hs_exp(map->b2 * strain);
}

float hs_strain_from_capacitance(const hs_strain_map *map, float capacitance_f)
{
    /* 0 times an infinite capacitance would be NaN instead of a strain out of range */
    const float cubic = map->cubic_per_f3 == 0.0f ? 0.0f : map->cubic_per_f3 * capacitance_f;
    const float quadratic = cubic + map->curvature_per_f2;
    return (quadratic * capacitance_f + map->slope_per_f) * capacitance_f + map->offset;
}

float hs_table_at(const hs_table *table, float x)
{
    const float place = (x - table->low) * table->steps_per_unit;
    uint8_t k;
    if (!(place > 0.0f)) {
        return place != place ? place : table->value[0];
    }
    if (place >= (float)table->steps) {
        return table->value[table->steps];
    }
    k = (uint8_t)place;
    return table->value[k] + (place - (float)k) * (table->value[k + 1] - table->value[k]);
}

float hs_limit(float value, float low, float high, uint8_t *limited)
{
    *limited = 1;
    if (value != value) {
        return 0.0f;
    }
    if (value < low) {
        return low;
    }
    if (value > high) {
        return high;
    }
    *limited = 0;
    return value;
}
