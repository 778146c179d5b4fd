/* Takes: residuals. Gives: their autocovariance, an autoregressive model of them. */
#include "identification/noise.h"

#include <math.h>
#include <string.h>

#ifndef HS_CLONES
#define HS_CLONES
#endif

#define LANES 16
#define MOST_LAGS 64

HS_CLONES
void noise_autocovariance(const double *e, int64_t n, int32_t lags, double *total)
{
    int32_t lag, k;
    for (lag = 0; lag <= lags && lag < n; ++lag) {
        double lanes[LANES] = {0.0}, sum = 0.0;
        int64_t m = 0;
        for (; m + LANES + lag <= n; m += LANES) {
            for (k = 0; k < LANES; ++k) {
                lanes[k] += e[m + k] * e[m + k + lag];
            }
        }
        for (; m + lag < n; ++m) {
            sum += e[m] * e[m + lag];
        }
        for (k = 0; k < LANES; ++k) {
            sum += lanes[k];
        }
        total[lag] += sum;
    }
}

int32_t noise_autoregression(const double *covariance, int32_t lags, int64_t count,
                             double *polynomial, double *variance)
{
    double a[MOST_LAGS + 1] = {1.0}, next[MOST_LAGS + 1], rest = covariance[0];
    double lowest;
    int32_t order, best = 0, i;
    memset(polynomial, 0, (size_t)(lags + 1) * sizeof(double));
    polynomial[0] = 1.0;
    *variance = rest;
    if (!(rest > 0.0)) {
        return 0;
    }
    lowest = (double)count * log(rest);
    for (order = 1; order <= lags && order <= MOST_LAGS; ++order) {
        double reflection = 0.0, score;
        for (i = 0; i < order; ++i) {
            reflection -= a[i] * covariance[order - i];
        }
        reflection /= rest;
        a[order] = 0.0;
        for (i = 0; i <= order; ++i) {
            next[i] = a[i] + reflection * a[order - i];
        }
        memcpy(a, next, (size_t)(order + 1) * sizeof(double));
        rest *= 1.0 - reflection * reflection;
        if (!(rest > 1e-14 * covariance[0])) {
            break;
        }
        score = (double)count * log(rest) + order * log((double)count);
        if (score < lowest) {
            lowest = score;
            best = order;
            *variance = rest;
            memcpy(polynomial, a, (size_t)(order + 1) * sizeof(double));
        }
    }
    return best;
}
