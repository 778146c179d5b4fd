/* All points of a clip in one frame: where they should be, where they are, which to believe.
 *
 * One step, points in arrays of `count` rows:
 *   1. Each point is expected where its velocity puts it, the velocity smoothed over its
 *      neighbours (an affine fit); its subset is deformed as the neighbours' displacements say.
 *   2. track_refine finds it.
 *   3. It is believed when the solve converged, correlation and residual allow it, its contrast is
 *      above 5 deviations of what noise alone shows of any template, its own deviation below 1 px,
 *      and it lies within `jump_px` of the median of what its believed neighbours extrapolate to.
 *   4. What is not believed is tried again from that median, then those around it, until nothing
 *      new is found. Where too few neighbours are believed, a whole-pixel search comes first.
 *      When less than a third is believed in the end, nothing is.
 *   5. What is still not believed keeps its reasons, and rides with its neighbours until it is
 *      found again; without neighbours it waits where it was last seen.
 * Without neighbours (`near` null) steps 1 and 3 stand on the point alone.
 */
#ifndef HASELAB_TRACK_STEP_H
#define HASELAB_TRACK_STEP_H

#include "tracking/track.h"

/* Why a point is not valid in a frame; bits. */
enum track_reason {
    TRACK_UNLIKE = 1,    /* the correlation is below the least quality, the contrast is not above
                            what noise shows, or the place is known to a pixel at best */
    TRACK_LEFT = 2,      /* the subset reaches over the edge of the frame */
    TRACK_BENT = 4,      /* deformed beyond a factor 1.8 */
    TRACK_UNSETTLED = 8, /* the solve did not converge */
    TRACK_STRAYED = 16,  /* not where the neighbours put it */
    TRACK_COVERED = 32,  /* residual or contrast are not like the others': it shows other things */
    TRACK_AMBIGUOUS = 128 /* set by the caller: another place explains the frame as well */
};

enum { TRACK_WHITE_STEPS = 32 };

/* Of one point: covariances as xx, xy, yy. */
struct track_noise {
    float even[3];      /* of the displacement times amplitude^2, for a variance of 1 that is even */
    float shaped[3];    /* and for one that follows the shape */
    float reference[3]; /* of the reference, px^2 */
    float norm, level;  /* of the template */
    float residual_share; /* of white noise that the residual keeps */
    float averaged;       /* one over the frames averaged into the template */
};

struct track_points {
    int count, side, stride, unknowns;
    const float *shape, *gradient, *inverse, *place; /* templates, track.h, one after the other */
    const double *centre; /* of each subset in the first reference, px: x, y */
    const double *offset; /* the point less its subset's centre, px */
    const double *base;   /* inverse of the deformation gradient at which the template was taken */
    const struct track_noise *noise;
    const float *white; /* share of white noise left by sampling at fraction k / 32 */

    int neighbours;        /* of each point, 0 for none */
    const int *near;       /* their indices */
    const double *lever;   /* the point less each neighbour, px: x, y */
    const double *weights; /* displacement gradient from displacements relative to the point's */
    const double *smooth;  /* weights of an affine fit at the point: its own, then neighbours' */
    const double *rough;   /* what a quadratic fit leaves at the point: its own, then neighbours';
                              then of an affine fit; all zero where they cannot tell */
};

/* How far displacements scatter about a smooth field, over what their deviations explain: the mean
 * ratio of the squares, and how many numbers it is the mean of. */
struct track_audit {
    float ratio;
    int numbers;
};

struct track_rules {
    struct track_settings settings;
    float minimum_quality;
    float jump_px;
    float most_residual; /* a point's excess, mean square residual over what the noise explains,
                            over the median of all points in the frame: blur, lossy compression
                            and marks that do not stretch lift it for all alike */
    float most_gain;     /* a point's gain over the common one, or the other way round */
    int search_px;
    int noise_known;
    float noise_floor, noise_slope; /* variance = floor + slope * grey */
};

/* What is carried from frame to frame: poses, last motion px (x, y), reasons; and the
 * common gain, the median over the points of their contrast over the reference's, 0 before the
 * first frame. It may double or halve from one frame to the next, no more, unless three quarters of
 * the points agree on it to a quarter: then the light has changed. A frame in which most points
 * sit on something else does not make that the rule. */
struct track_memory {
    struct track_pose *poses;
    double *velocity;
    unsigned char *reasons;
    double *gain;
};

/* All points and their deviations, px; NaN where one is not valid. And correlations. */
struct track_found {
    double *x, *y, *std_x, *std_y, *quality;
};

size_t track_step_size(const struct track_points *points, const struct track_frame *frame,
                       int search_px);

/* What the caller must look into after a step. */
struct track_summary {
    int due;             /* believed points that are due for a new template: stretched by more than
                            1.4 or to less than two thirds */
    int believed, strayed;
    int newly_lost;      /* believed in the frame before and not in this one, but for those that
                            left */
    int believed_before; /* before this frame */
    int ambiguous;       /* points whose name was in doubt before this frame */
    float surprise_px, most_surprise_px; /* median and largest distance of believed points from
                                            where their velocities put them */
    float unevenness; /* of the light: how far a point's grey level over the reference's is from the
                         median of all, at most, for nine tenths of them */
    float largest_std_px; /* of the believed points */
    float reach_px;       /* along x or y from where a point was expected to the farthest pixel that
                             was read; the frame's larger side if points were searched for */
    struct track_audit audit;
};

/* `after` may not be `before`. */
struct track_summary track_step(const struct track_kernels *kernels,
                                const struct track_points *points, const struct track_rules *rules,
                                const struct track_frame *frame, const struct track_memory *before,
                                const struct track_memory *after, const struct track_found *found,
                                void *scratch);

/* The audit of one frame, from a sample of at most 60 points; the quality does not matter.
 * `scratch` of 4 doubles a point. */
struct track_audit track_audit_frame(const struct track_points *points,
                                     const struct track_found *found, double *scratch);

/* The frame's grey levels, less half the range, at the samples of each point's subset as its pose
 * puts them: `stride` floats a point. A point whose subset reaches over the edge has only NaN. */
void track_samples(const struct track_kernels *kernels, const struct track_points *points,
                   const struct track_frame *frame, const struct track_pose *poses, float *out,
                   void *scratch);

#endif
