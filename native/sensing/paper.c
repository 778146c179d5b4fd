/* Takes: pairs of readings and a low-pass. Gives: mean period, peak to peak, fundamental. */
#include "sensing/paper.h"

#define CHANNELS 2 /* side by side: their chains of operations overlap */

static void finish(const double *mean, size_t period, double count, const double *c,
                   const double *s, size_t j, paper_result *out)
{
    double re = 0.0, im = 0.0, square = 0.0, low = mean[j], high = mean[j];
    size_t k;
    for (k = 0; k < period; ++k) {
        const double y = mean[CHANNELS * k + j];
        low = y < low ? y : low;
        high = y > high ? y : high;
    }
    for (k = 0; k < (size_t)count; ++k) {
        re += c[CHANNELS * k + j];
        im -= s[CHANNELS * k + j];
        square += c[CHANNELS * k + j] * c[CHANNELS * k + j];
        square += s[CHANNELS * k + j] * s[CHANNELS * k + j];
    }
    out->peak_to_peak = (high - low) / count;
    out->re = re / count;
    out->im = im / count;
    /* Both quadratures together have twice the variance of one. */
    square = 0.5 * (square - (re * re + im * im) / count) / (count - 1.0);
    out->scatter = square > 0.0 ? square / count : 0.0;
}

void paper_block(const paper_filter *filter, paper_state *state, const double *x, size_t n,
                 size_t period, const double *wave, double *mean, double *fundamentals,
                 paper_result out[2])
{
    const paper_filter f = *filter;
    const size_t periods = n / period;
    double *cosines = fundamentals, *sines = fundamentals + CHANNELS * periods;
    paper_state z = *state;
    double most[CHANNELS] = {0};
    size_t p, k, j;

    for (k = 0; k < CHANNELS * period; ++k) {
        mean[k] = 0.0;
    }
    for (p = 0; p < periods; ++p) {
        double c[CHANNELS] = {0}, s[CHANNELS] = {0};
        for (k = 0; k < period; ++k) {
            for (j = 0; j < CHANNELS; ++j) {
                const double in = x[CHANNELS * (p * period + k) + j];
                const double size = in < 0.0 ? -in : in;
                const double y = f.b[0][0] * in + z.z[0][0][j];
                const double w = f.b[1][0] * y + z.z[1][0][j];
                z.z[0][0][j] = f.b[0][1] * in - f.a[0][0] * y + z.z[0][1][j];
                z.z[0][1][j] = f.b[0][2] * in - f.a[0][1] * y;
                z.z[1][0][j] = f.b[1][1] * y - f.a[1][0] * w + z.z[1][1][j];
                z.z[1][1][j] = f.b[1][2] * y - f.a[1][1] * w;
                most[j] = size > most[j] ? size : most[j];
                mean[CHANNELS * k + j] += w;
                c[j] += wave[k] * w;
                s[j] += wave[period + k] * w;
            }
        }
        for (j = 0; j < CHANNELS; ++j) {
            cosines[CHANNELS * p + j] = c[j];
            sines[CHANNELS * p + j] = s[j];
        }
    }
    *state = z;
    for (j = 0; j < CHANNELS; ++j) {
        finish(mean, period, (double)periods, cosines, sines, j, &out[j]);
        out[j].most = most[j];
    }
}
