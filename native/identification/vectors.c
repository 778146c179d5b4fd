/* Takes: columns of doubles. Gives: their products, and an orthonormal basis column by column. */
#include "identification/vectors.h"

#include <math.h>

#ifndef HS_CLONES
#define HS_CLONES
#endif

#define LANES 16
#define DEPENDENT 1e-10 /* what is left of a column that the others already explain */

HS_CLONES
double vector_dot(const double *a, const double *b, int64_t n)
{
    double lanes[LANES] = {0.0}, total = 0.0;
    int64_t m = 0;
    int32_t k;
    for (; m + LANES <= n; m += LANES) {
        for (k = 0; k < LANES; ++k) {
            lanes[k] += a[m + k] * b[m + k];
        }
    }
    for (; m < n; ++m) {
        total += a[m] * b[m];
    }
    for (k = 0; k < LANES; ++k) {
        total += lanes[k];
    }
    return total;
}

HS_CLONES
void vector_add(double *out, double factor, const double *a, int64_t n)
{
    int64_t m;
    for (m = 0; m < n; ++m) {
        out[m] += factor * a[m];
    }
}

HS_CLONES
static void add_pair(double *out, double first, const double *a, double second, const double *b,
                     int64_t n)
{
    int64_t m;
    for (m = 0; m < n; ++m) {
        out[m] += first * a[m] + second * b[m];
    }
}

void vector_add_real(double *out, double factor_re, double factor_im, const double *re,
                     const double *im, int64_t n)
{
    if (factor_im != 0.0) {
        add_pair(out, factor_re, re, -factor_im, im, n);
    } else if (factor_re != 0.0) {
        vector_add(out, factor_re, re, n);
    }
}

void vector_scale(double *out, double factor, int64_t n)
{
    int64_t m;
    for (m = 0; m < n; ++m) {
        out[m] *= factor;
    }
}

void vector_fill(double *out, double value, int64_t n)
{
    int64_t m;
    for (m = 0; m < n; ++m) {
        out[m] = value;
    }
}

void vector_orthonormal(double *column, double *const *earlier, int32_t count, int64_t from,
                        int64_t n, double *triangle)
{
    const double before = sqrt(vector_dot(column + from, column + from, n));
    double length;
    int32_t i;
    for (i = 0; i < count; ++i) {
        triangle[i] = vector_dot(earlier[i] + from, column + from, n);
        vector_add(column + from, -triangle[i], earlier[i] + from, n);
    }
    length = sqrt(vector_dot(column + from, column + from, n));
    triangle[count] = length;
    if (!(length > DEPENDENT * before)) {
        triangle[count] = 0.0;
        vector_fill(column + from, 0.0, n);
        return;
    }
    vector_scale(column + from, 1.0 / length, n);
}

void vector_back_substitute(double triangle[][VECTOR_COLUMNS], const double *right, int32_t n,
                            double *out)
{
    int32_t i, j;
    for (i = n - 1; i >= 0; --i) {
        double rest = right[i];
        for (j = i + 1; j < n; ++j) {
            rest -= triangle[j][i] * out[j];
        }
        out[i] = triangle[i][i] > 0.0 ? rest / triangle[i][i] : 0.0;
    }
}
