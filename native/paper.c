/* Takes: readings and a low-pass. Gives: mean period, its peak-to-peak value and fundamental. */
#include "paper.h"

static double filtered(const paper_filter *f, paper_state *s, double x)
{
    size_t k;
    for (k = 0; k < PAPER_SECTIONS; ++k) {
        const double y = f->b[k][0] * x + s->z[k][0];
        s->z[k][0] = f->b[k][1] * x - f->a[k][0] * y + s->z[k][1];
        s->z[k][1] = f->b[k][2] * x - f->a[k][1] * y;
        x = y;
    }
    return x;
}

void paper_block(const paper_filter *filter, paper_state *state, const double *x, size_t stride,
                 size_t n, size_t period, const double *wave, double *mean, paper_result *out)
{
    const size_t periods = n / period;
    const double count = (double)periods;
    double re = 0.0, im = 0.0, square = 0.0, low, high;
    paper_state local = *state;
    size_t p, k;

    for (k = 0; k < period; ++k) {
        mean[k] = 0.0;
    }
    for (p = 0; p < periods; ++p) {
        double c = 0.0, s = 0.0;
        for (k = 0; k < period; ++k) {
            const double y = filtered(filter, &local, x[stride * (p * period + k)]);
            mean[k] += y;
            c += wave[k] * y;
            s += wave[period + k] * y;
        }
        re += c;
        im -= s;
        square += c * c + s * s;
    }
    *state = local;
    low = high = mean[0];
    for (k = 0; k < period; ++k) {
        low = mean[k] < low ? mean[k] : low;
        high = mean[k] > high ? mean[k] : high;
        mean[k] /= count;
    }
    out->peak_to_peak = (high - low) / count;
    out->re = re / count;
    out->im = im / count;
    /* Both quadratures together have twice the variance of one. */
    square = 0.5 * (square - (re * re + im * im) / count) / (count - 1.0);
    out->scatter = square > 0.0 ? square / count : 0.0;
}
