/* Operations on long columns of doubles for least squares. Desktop only. */
#ifndef VECTORS_H
#define VECTORS_H

#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

#define VECTOR_COLUMNS 10 /* most columns of one triangle */

double vector_dot(const double *a, const double *b, int64_t n);

/* out += factor a. */
void vector_add(double *out, double factor, const double *a, int64_t n);

/* out += Re(factor x) for real and imaginary parts of x. */
void vector_add_real(double *out, double factor_re, double factor_im, const double *re,
                     const double *im, int64_t n);

void vector_scale(double *out, double factor, int64_t n);
void vector_fill(double *out, double value, int64_t n);

/* One column, from `from` on, freed of `count` earlier orthonormal ones, then of unit length; a
 * column that they explain becomes zero. triangle: coefficients of the earlier ones, then its
 * length. */
void vector_orthonormal(double *column, double *const *earlier, int32_t count, int64_t from,
                        int64_t n, double *triangle);

/* Triangular system; the factor of a column that was explained away is zero. */
void vector_back_substitute(double triangle[][VECTOR_COLUMNS], const double *right, int32_t n,
                            double *out);

#ifdef __cplusplus
}
#endif

#endif
