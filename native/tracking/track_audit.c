/* The audit of a frame, see track_step.h. */
#include <math.h>   /* isnan */
#include <string.h> /* memcpy */

#include "tracking/track_step.h"

enum { AUDITED = 60 };

/* A ratio beyond this is a point that has gone astray, not the scatter of all. */
static const double MOST_RATIO = 2500.0, LARGE_ERRORS = 4.0;

/* The point at rest. */
static void rest_place(const struct track_points *p, int n, double *rest)
{
    const double *o = p->offset + 2 * n, *b = p->base + 4 * n;
    for (int m = 0; m < 2; ++m) {
        rest[m] = p->centre[2 * n + m] + b[2 * m] * o[0] + b[2 * m + 1] * o[1];
    }
}

/* What the quadratic fit over all neighbours leaves at point i, x and y, then the affine fit; NaN
 * where a neighbour is lost. */
static void left_by_all(const struct track_points *p, const double *moves, int i, double *left,
                        double *spread)
{
    const int k_all = p->neighbours;
    const double *quadratic = p->rough + 2 * (ptrdiff_t)i * (k_all + 1);
    const double *affine = quadratic + k_all + 1;
    for (int k = 0; k <= k_all; ++k) {
        const double *moved = moves + 4 * (k ? p->near[(ptrdiff_t)i * k_all + k - 1] : i);
        const double *variance = moved + 2;
        for (int m = 0; m < 2; ++m) {
            left[m] += quadratic[k] * moved[m];
            spread[m] += quadratic[k] * quadratic[k] * variance[m];
            left[2 + m] += affine[k] * moved[m];
            spread[2 + m] += affine[k] * affine[k] * variance[m];
        }
    }
}

/* The point less what an affine fit over those neighbours that were found says; 0 when they are too
 * few or stand in a line. */
static int left_by_some(const struct track_points *p, const double *moves, int i, double *left,
                        double *spread)
{
    const ptrdiff_t first = (ptrdiff_t)i * p->neighbours;
    double s[6] = {0.0}, here[2], there[2]; /* 1, x, y, xx, xy, yy */
    rest_place(p, i, here);
    for (int k = 0; k < p->neighbours; ++k) {
        if (!isnan(moves[4 * p->near[first + k]])) {
            rest_place(p, p->near[first + k], there);
            const double x = here[0] - there[0], y = here[1] - there[1];
            const double part[6] = {1.0, x, y, x * x, x * y, y * y};
            for (int m = 0; m < 6; ++m) {
                s[m] += part[m];
            }
        }
    }
    /* first row of the inverse of the normal equations */
    const double a = s[3] * s[5] - s[4] * s[4], b = s[2] * s[4] - s[1] * s[5];
    const double c = s[1] * s[4] - s[2] * s[3], whole = s[0] * a + s[1] * b + s[2] * c;
    memcpy(left, moves + 4 * i, 2 * sizeof *left);
    memcpy(spread, moves + 4 * i + 2, 2 * sizeof *spread);
    if (s[0] < 5.0 || isnan(left[0]) || !(whole > 1e-3 * s[0] * s[3] * s[5])) {
        return 0;
    }
    for (int k = 0; k < p->neighbours; ++k) {
        const int n = p->near[first + k];
        if (!isnan(moves[4 * n])) {
            rest_place(p, n, there);
            const double weight = (a + b * (here[0] - there[0]) + c * (here[1] - there[1])) / whole;
            for (int m = 0; m < 2; ++m) {
                left[m] -= weight * moves[4 * n + m];
                spread[m] += weight * weight * moves[4 * n + 2 + m];
            }
        }
    }
    return 1;
}

static double ratio_of(double left, double spread)
{
    const double ratio = left * left / spread;
    return ratio < MOST_RATIO ? ratio : MOST_RATIO;
}

struct track_audit track_audit_frame(const struct track_points *p,
                                     const struct track_found *found, double *scratch)
{
    const int count = p->count, step = (count + AUDITED - 1) / AUDITED;
    double quadratic = 0.0, affine = 0.0, *moves = scratch;
    int numbers = 0;
    for (int i = 0; p->neighbours && i < count; ++i) {
        double rest[2];
        rest_place(p, i, rest);
        moves[4 * i] = found->x[i] - rest[0];
        moves[4 * i + 1] = found->y[i] - rest[1];
        moves[4 * i + 2] = found->std_x[i] * found->std_x[i];
        moves[4 * i + 3] = found->std_y[i] * found->std_y[i];
    }
    for (int i = 0; p->neighbours && i < count; i += step) {
        double left[4] = {0.0}, spread[4] = {0.0};
        left_by_all(p, moves, i, left, spread);
        if (isnan(spread[2])) { /* one is lost */
            if (!left_by_some(p, moves, i, left, spread)) {
                continue;
            }
            memcpy(left + 2, left, 2 * sizeof *left);
            memcpy(spread + 2, spread, 2 * sizeof *spread);
        }
        for (int m = 0; m < 2 && spread[0] > 0.0; ++m) {
            quadratic += ratio_of(left[m], spread[m]);
            affine += ratio_of(left[2 + m], spread[2 + m]);
            ++numbers;
        }
    }
    /* A quadratic fit follows the field, and some of errors that neighbours share; an affine one
     * follows neither. Where the errors are large, they outweigh the field. */
    const double most = quadratic > LARGE_ERRORS * numbers && affine > quadratic ? affine : quadratic;
    const struct track_audit audit = {numbers ? (float)(most / numbers) : 0.0f, numbers};
    return audit;
}
