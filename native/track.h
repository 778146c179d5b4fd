/* Subset tracking at given points: inverse-compositional Gauss-Newton and an integer search.
 *
 * A subset is a square of side * side reference pixels (side odd) around an integer centre. Its
 * template holds, row by row and padded with zeros to `stride` = a multiple of 8:
 *   shape     f, mean removed, norm 1
 *   gradient  one row per unknown: steepest descent of f, made orthogonal to {1, f}
 *   weight    gradient energy, sum 1; weighs the residual
 *   inverse   inverse of (gradient x derivative), unknowns * unknowns
 * The rows are orthogonal to 1 and f, so gain and offset of a frame drop out of the solve:
 *   step = inverse * (gradient . w) / (shape . w),   w = frame samples under the present pose.
 * Two unknowns (u, v), or six (u, u_x, u_y, v, v_x, v_y).
 *
 * Frames are sampled with the interpolating cubic B-spline (Unser 1999). Its recursive prefilter
 * runs over the pixels around one subset only; TRACK_MARGIN extra pixels damp the start-up to
 * (2 - sqrt 3)^8 = 3e-5 of a grey step. No globals, no heap: the caller owns all memory.
 */
#ifndef HASELAB_TRACK_H
#define HASELAB_TRACK_H

#include <stddef.h> /* size_t, ptrdiff_t */

enum { TRACK_MARGIN = 8, TRACK_MAX_SIDE = 101, TRACK_RESULTS = 6 };

/* How one refinement ended. */
enum track_status {
    TRACK_CONVERGED = 0,
    TRACK_SLOW = 1,     /* the step was still above the tolerance after the last iteration */
    TRACK_OUTSIDE = 2,  /* the subset reached over the edge of the frame */
    TRACK_DEFORMED = 3, /* deformed beyond a factor 1.5, or not finite */
    TRACK_DIVERGED = 4  /* a step beyond half the side, or no positive correlation */
};

/* A frame of 1 or 2 bytes a pixel; `pitch` pixels from one row to the next. */
struct track_frame {
    const void *pixels;
    int width, height;
    ptrdiff_t pitch;
    int bytes;
};

struct track_template {
    const float *shape, *gradient, *weight, *inverse;
    int side, stride, unknowns;
};

/* Position of the subset's centre in the frame, px, and deformation gradient (rows x, y). */
struct track_pose {
    double x, y, f[4];
};

struct track_result {
    float quality;   /* zero-mean normalised cross-correlation, -1 to 1 */
    float amplitude; /* shape . w: reference norm times gain, grey */
    float level;     /* mean of w, grey */
    float residual;  /* weighted mean square of w - level - amplitude * shape, grey^2 */
    float iterations;
    float status;
};

struct track_settings {
    int max_iterations;
    float tolerance_px;
};

/* Floats of scratch memory that track_refine needs for subsets of this side. */
size_t track_scratch_size(int side, int stride);

/* Moves `pose` until the step falls below the tolerance. ~8 us a step for 21 px subsets. */
void track_refine(const struct track_frame *frame, const struct track_template *t,
                  const struct track_settings *settings, struct track_pose *pose,
                  struct track_result *result, float *scratch);

/* Moves `pose` by whole pixels to the best correlation within `radius` of where it is; returns
 * that correlation, or -2 when no place within the radius holds the whole subset. Ignores the
 * deformation. Costs (2 radius + 1)^2 * side^2 multiply-adds. Scratch as for track_refine. */
float track_search(const struct track_frame *frame, const struct track_template *t, int radius,
                   struct track_pose *pose, float *scratch);

#endif
