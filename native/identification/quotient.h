/* Division of complex numbers, the same in every compiler: the C libraries of GCC and Clang round
 * a / b differently.
 * Source: Smith (1962), Algorithm 116. */
#ifndef IDENTIFICATION_QUOTIENT_H
#define IDENTIFICATION_QUOTIENT_H

#include <complex.h>
#include <math.h>

static inline double complex quotient(double complex a, double complex b)
{
    const double x = creal(a), y = cimag(a), c = creal(b), d = cimag(b);
    if (fabs(c) >= fabs(d)) {
        const double ratio = d / c, size = c + d * ratio;
        return (x + y * ratio) / size + (y - x * ratio) / size * I;
    } else {
        const double ratio = c / d, size = c * ratio + d;
        return (x * ratio + y) / size + (y * ratio - x) / size * I;
    }
}

#endif
