/* Takes: a structure and its numbers. Gives: poles, residues, and their derivatives. */
#include "identification/transfer_poles.h"

#include "identification/quotient.h"

#include <math.h>
#include <string.h>

#define CRITICAL_BAND 2e-6 /* of damping ratio squared about 1: two equal poles are kept apart */

static int32_t fast_order(const transfer_structure *s) { return 2 * s->pairs + s->reals; }

transfer_poles transfer_poles_of(const transfer_structure *s, const double *numbers)
{
    transfer_poles set;
    int32_t i, at = 0;
    memset(&set, 0, sizeof set);
    set.numbers = fast_order(s) + s->slow + 1;
    for (i = 0; i < s->pairs; ++i) {
        const double omega = exp(numbers[at]), zeta = exp(numbers[at + 1]);
        double spread = zeta * zeta - 1.0;
        double complex root;
        int32_t side;
        if (fabs(spread) < CRITICAL_BAND) {
            spread = CRITICAL_BAND;
        }
        root = csqrt(spread + 0.0 * I);
        for (side = 0; side < 2; ++side) {
            const double sign = side == 0 ? 1.0 : -1.0;
            set.value[set.n] = omega * (-zeta + sign * root);
            set.slope[set.n][at] = set.value[set.n];
            set.slope[set.n][at + 1] = omega * zeta * (-1.0 + quotient(sign * zeta, root));
            set.counts[set.n++] = spread > 0.0 ? 1 : 2 * (1 - side);
        }
        at += 2;
    }
    for (i = 0; i < s->reals + s->slow; ++i, ++at) {
        const double rate = exp(-numbers[at]);
        set.value[set.n] = -rate;
        set.slope[set.n][at] = rate;
        set.counts[set.n++] = 1;
    }
    set.delay_s = numbers[at];
    return set;
}

static transfer_section section_at(const transfer_structure *s, int32_t index)
{
    transfer_section out;
    if (index == 0) {
        out.first = 0;
        out.order = fast_order(s);
    } else {
        out.first = fast_order(s) + index - 1;
        out.order = 1;
    }
    return out;
}

/* Residues of (prod -p)^size s^power / A(s). */
static transfer_residues residues_of(const transfer_poles *set, transfer_section part,
                                     int32_t power, double size)
{
    transfer_residues out;
    double complex product = 1.0, scale;
    int32_t i, k, j;
    memset(&out, 0, sizeof out);
    out.part = part;
    for (i = 0; i < part.order; ++i) {
        product *= -set->value[part.first + i];
    }
    scale = size == 0.0 ? 1.0 : cpow(product, size);
    for (i = 0; i < part.order; ++i) {
        const double complex p = set->value[part.first + i];
        double complex weight = scale, gaps = 0.0;
        for (k = 0; k < power; ++k) {
            weight *= p;
        }
        for (k = 0; k < part.order; ++k) {
            if (k != i) {
                const double complex gap = p - set->value[part.first + k];
                weight = quotient(weight, gap);
                gaps += quotient(1.0, gap);
            }
        }
        out.value[part.first + i] = weight;
        for (k = 0; k < part.order; ++k) {
            const double complex q = set->value[part.first + k];
            double complex by_pole = quotient(size, q);
            by_pole += k == i ? quotient(power, p) - gaps : quotient(1.0, p - q);
            for (j = 0; j < set->numbers; ++j) {
                out.slope[part.first + i][j] += weight * by_pole * set->slope[part.first + k][j];
            }
        }
    }
    return out;
}

transfer_residues transfer_shared_residues(const transfer_structure *s, const transfer_poles *set,
                                           int32_t index)
{
    if (index <= s->zeros) {
        const double order = fast_order(s);
        return residues_of(set, section_at(s, 0), index, 1.0 - index / order);
    }
    return residues_of(set, section_at(s, index - s->zeros), 0, 1.0);
}

transfer_residues transfer_own_residues(const transfer_structure *s, const transfer_poles *set,
                                        int32_t index)
{
    const int32_t order = fast_order(s);
    if (index < order) {
        return residues_of(set, section_at(s, 0), index, (order - 1.0 - index) / order);
    }
    return residues_of(set, section_at(s, index - order + 1), 0, 0.0);
}
