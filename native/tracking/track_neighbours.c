/* See track_neighbours.h. */
#include "tracking/track_neighbours.h"

enum { MOST_NEIGHBOURS = 32 };

void track_full_gradient(const struct track_points *p, const double *moved, int i, double *g)
{
    const int k_all = p->neighbours, *near = p->near + (ptrdiff_t)i * k_all;
    const double *wx = p->weights + 2 * (ptrdiff_t)i * k_all, *wy = wx + k_all;
    const double x = moved[2 * i], y = moved[2 * i + 1];
    double xx = 0.0, xy = 0.0, yx = 0.0, yy = 0.0;
    for (int k = 0; k < k_all; ++k) {
        const double u = moved[2 * near[k]] - x, v = moved[2 * near[k] + 1] - y;
        xx += wx[k] * u;
        xy += wy[k] * u;
        yx += wx[k] * v;
        yy += wy[k] * v;
    }
    g[0] = xx;
    g[1] = xy;
    g[2] = yx;
    g[3] = yy;
}

int track_all_usable(const struct track_points *p, const unsigned char *unusable, int i)
{
    const int *near = p->near + (ptrdiff_t)i * p->neighbours;
    int bad = unusable[i];
    for (int k = 0; k < p->neighbours; ++k) {
        bad |= unusable[near[k]];
    }
    return !bad;
}

double track_median(double *values, int count)
{
    for (int i = 1; i < count; ++i) {
        const double v = values[i];
        int k = i;
        for (; k > 0 && values[k - 1] > v; --k) {
            values[k] = values[k - 1];
        }
        values[k] = v;
    }
    return count % 2 ? values[count / 2] : 0.5 * (values[count / 2 - 1] + values[count / 2]);
}

int track_median_guess(const struct track_points *p, const double *moved,
                        const unsigned char *unusable, const double *g, int i, double *guess)
{
    const ptrdiff_t first = (ptrdiff_t)i * p->neighbours;
    double x[MOST_NEIGHBOURS], y[MOST_NEIGHBOURS];
    int count = 0;
    for (int k = 0; k < p->neighbours; ++k) {
        const int n = p->near[first + k];
        if (!unusable[n]) {
            const double *lever = p->lever + 2 * (first + k);
            x[count] = moved[2 * n] + g[0] * lever[0] + g[1] * lever[1];
            y[count] = moved[2 * n + 1] + g[2] * lever[0] + g[3] * lever[1];
            ++count;
        }
    }
    if (count >= TRACK_FEWEST) {
        guess[0] = track_median(x, count);
        guess[1] = track_median(y, count);
    }
    return count;
}

int track_partial_gradient(const struct track_points *p, const double *moved,
                            const unsigned char *unusable, int i, double *g)
{
    const ptrdiff_t first = (ptrdiff_t)i * p->neighbours;
    double s[5] = {0.0}, count = 0.0, mean[4] = {0.0};
    for (int k = 0; k < p->neighbours; ++k) {
        const int n = p->near[first + k];
        if (!unusable[n]) {
            const double part[4] = {-p->lever[2 * (first + k)], -p->lever[2 * (first + k) + 1],
                                    moved[2 * n], moved[2 * n + 1]};
            count += 1.0;
            for (int m = 0; m < 4; ++m) {
                mean[m] += part[m];
            }
        }
    }
    if (count < TRACK_FEWEST) {
        return 0;
    }
    double xu = 0.0, xv = 0.0, yu = 0.0, yv = 0.0;
    for (int k = 0; k < p->neighbours; ++k) {
        const int n = p->near[first + k];
        if (!unusable[n]) {
            const double x = -p->lever[2 * (first + k)] - mean[0] / count;
            const double y = -p->lever[2 * (first + k) + 1] - mean[1] / count;
            const double u = moved[2 * n] - mean[2] / count, v = moved[2 * n + 1] - mean[3] / count;
            s[0] += x * x;
            s[1] += x * y;
            s[2] += y * y;
            xu += x * u;
            xv += x * v;
            yu += y * u;
            yv += y * v;
        }
    }
    const double determinant = s[0] * s[2] - s[1] * s[1], trace = s[0] + s[2];
    if (!(determinant > 1e-3 * trace * trace)) {
        return 0;
    }
    g[0] = (s[2] * xu - s[1] * yu) / determinant;
    g[1] = (s[0] * yu - s[1] * xu) / determinant;
    g[2] = (s[2] * xv - s[1] * yv) / determinant;
    g[3] = (s[0] * yv - s[1] * xv) / determinant;
    return 1;
}
