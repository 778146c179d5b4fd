/* Subset tracking at given points: inverse-compositional Gauss-Newton and an integer search.
 *
 * A subset is a square of side * side reference pixels (side odd) around an integer centre. Its
 * template holds, row by row and padded with zeros to `stride` = a multiple of 16:
 *   shape     f, mean removed, norm 1
 *   gradient  two rows: the slope of f along x and y (smoothed, per px), over the norm of f
 *   inverse   inverse of (gradient x derivative), unknowns * unknowns, in px
 * With r = w - mean(w) - (f . w) f, the part of the frame's samples w that neither gain nor offset
 * explains, one step is   inverse * (gradient . r) / (f . w).
 * Two unknowns (u, v), or six (u, u_x, u_y, v, v_x, v_y).
 *
 * Frames are sampled with the interpolating cubic B-spline (Unser 1999), in integers: pixels of 10
 * bits, coefficients of 16 bits, 21.3 steps to a grey level of 8 bits. The inverse filter
 * 6 / (4 + s), s = q + 1/q, is the finite product
 *     (4 - s)(14 + s2)(194 + s4) * 6 / 37632,   s2 = q^2 + q^-2,  s4 = q^4 + q^-4,
 * exact to 1e-4, so a coefficient depends on 15 x 15 pixels and on nothing else: filtered around
 * one subset or over the whole frame, it is the same number. Integers, and sums of 16 lanes in one
 * order, make all kernels (portable, AVX2, AVX-512) give the same bits.
 *
 * No globals, no heap: the caller owns all memory.
 */
#ifndef HASELAB_TRACK_H
#define HASELAB_TRACK_H

#include <stddef.h> /* size_t, ptrdiff_t */
#include <stdint.h> /* int16_t */

enum { TRACK_MAX_SIDE = 101 };

/* How one refinement ended. */
enum track_status {
    TRACK_CONVERGED = 0,
    TRACK_SLOW = 1,     /* the step was still above the tolerance after the last iteration */
    TRACK_OUTSIDE = 2,  /* the subset reached over the edge of the frame */
    TRACK_DEFORMED = 3, /* deformed beyond a factor 1.8, or not finite */
    TRACK_DIVERGED = 4  /* a step beyond half the side, or no positive correlation */
};

/* A frame of 1 or 2 bytes a pixel; `pitch` pixels from one row to the next. `bits` of a pixel are
 * in use (8 to 16): what is above counts as the largest. */
struct track_frame {
    const void *pixels;
    int width, height;
    ptrdiff_t pitch;
    int bytes, bits;
};

static inline float track_larger_side(const struct track_frame *frame)
{
    return (float)(frame->width > frame->height ? frame->width : frame->height);
}

struct track_template {
    const float *shape, *gradient, *inverse;
    const float *place; /* distance of each sample from the centre along x, then y, px */
    int side, stride, unknowns;
};

/* Position of the subset's centre in the frame, px, and deformation gradient (rows x, y). */
struct track_pose {
    double x, y, f[4];
};

struct track_result {
    float quality;   /* zero-mean normalised cross-correlation, -1 to 1; 0 of an even grey */
    float amplitude; /* shape . w: reference norm times gain, grey */
    float level;     /* mean of w, grey */
    float residual;  /* mean square of r, weighted with the gradient's energy, grey^2 */
    float iterations;
    float status;
    float reach; /* along x or y from the subset's centre at the start to the farthest pixel read, px */
};

struct track_settings {
    int max_iterations;
    float tolerance_px;
};

/* Spline coefficients of a part of a frame. */
struct track_patch {
    const int16_t *values; /* values[(y - top) * pitch + (x - left)] */
    int left, top, columns, rows;
    int pitch; /* at least columns + 32, so that reading 32 at once stays inside */
};

struct track_kernels; /* track_kernels.h */

/* The kernels of that name ("avx512", "avx2", "portable"), or the fastest ones that this machine
 * runs when `name` is empty; null when there are none. */
const struct track_kernels *track_select(const char *name);
const char *track_kernels_name(const struct track_kernels *kernels);

/* Bytes of scratch memory that track_refine and track_search need for subsets of this side. */
size_t track_scratch_size(int side);
size_t track_search_size(int side, int radius);

/* Bytes that the coefficients of a whole frame take. */
size_t track_coefficients_size(int width, int height);

/* The coefficients of the whole frame, for many subsets that overlap. ~0.1 ms for 512 x 512 px. */
void track_filter_frame(const struct track_kernels *kernels, const struct track_frame *frame,
                        int16_t *coefficients, struct track_patch *patch);

/* Moves `pose` until the step falls below the tolerance. `whole` holds the frame's coefficients,
 * or is null. ~0.6 us for 15 px subsets. */
void track_refine(const struct track_kernels *kernels, const struct track_frame *frame,
                  const struct track_patch *whole, const struct track_template *t,
                  const struct track_settings *settings, struct track_pose *pose,
                  struct track_result *result, void *scratch);

/* The frame's grey levels, less half the range, at the template's samples as the pose puts them, zeros
 * in the padding; 0 when the subset cannot be sampled. `out` has `stride` floats. */
int track_sample(const struct track_kernels *kernels, const struct track_frame *frame,
                 const struct track_template *t, const struct track_pose *pose, float *out,
                 void *scratch);

/* Moves `pose` by whole pixels to the best correlation within `radius` of where it is; returns
 * that correlation, or -2 when no place within the radius holds the whole subset. The template is
 * deformed as the pose says, to the nearest pixel. Costs (2 radius + 1)^2 * side^2 multiply-adds.
 */
float track_search(const struct track_frame *frame, const struct track_template *t, int radius,
                   struct track_pose *pose, void *scratch);

/* Asks the cache for the pixels that track_refine will need at this pose. */
void track_prefetch(const struct track_frame *frame, int side, const struct track_pose *pose);

#endif
