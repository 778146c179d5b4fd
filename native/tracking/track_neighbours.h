/* Estimates for a point from its neighbours' displacements. Inside the tracker only.
 *
 * `moved` holds the displacement x, y of every point's subset, px; `unusable` is not zero for the
 * points that do not count. A gradient is u_x, u_y, v_x, v_y.
 */
#ifndef HASELAB_TRACK_NEIGHBOURS_H
#define HASELAB_TRACK_NEIGHBOURS_H

#include "tracking/track_step.h"

enum { TRACK_FEWEST = 3 }; /* fewest neighbours for an estimate */

/* Displacement gradient at point i from all its neighbours. */
void track_full_gradient(const struct track_points *p, const double *moved, int i, double *g);

/* Do point i and all its neighbours count? */
int track_all_usable(const struct track_points *p, const unsigned char *unusable, int i);

/* Median of `count` values, which it sorts. */
double track_median(double *values, int count);

/* Displacement of point i by the median of what its usable neighbours extrapolate to; the number
 * of those, `guess` untouched below TRACK_FEWEST. The median does not follow a few neighbours that
 * jumped to a wrong dot. */
int track_median_guess(const struct track_points *p, const double *moved,
                       const unsigned char *unusable, const double *g, int i, double *guess);

/* Gradient at point i by least squares over its usable neighbours alone; 0 when they are too few
 * or stand in a line. */
int track_partial_gradient(const struct track_points *p, const double *moved,
                           const unsigned char *unusable, int i, double *g);

#endif
