/* Noise models of residuals. Desktop only; the caller owns all memory. */
#ifndef NOISE_H
#define NOISE_H

#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

/* total[k] += sum of e[m] e[m + k] for k from 0 to `lags`. */
void noise_autocovariance(const double *e, int64_t n, int32_t lags, double *total);

/* Autoregressive model of the order that BIC prefers, from an autocovariance of `count` samples.
 * polynomial: room for lags + 1 values, (1, a1, ..). Returns the order. */
int32_t noise_autoregression(const double *covariance, int32_t lags, int64_t count,
                             double *polynomial, double *variance);

#ifdef __cplusplus
}
#endif

#endif
