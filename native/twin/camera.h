/* The twin's camera: expected grey levels of a speckled sheet between two clamps, and their exposure.
 *
 * x runs right, y runs down, pixel centres lie at integers. The upper clamp line is y = top; the lower
 * one is y = top + length. A material point (S, X), S in [0, 1] along the length and X in [-1, 1]
 * across, is seen at
 *     y = top + S * length
 *     x = mid + half_width * (X - contraction * 4 S (1 - S) * X |X|^p)
 *     contraction = neck * max(0, length / free_length - 1)
 * so all points of the clamp lines, S = 0 and S = 1, are rigid.
 *
 * Expected level, averaged over the sub-positions k of one exposure:
 *     (illumination_x + illumination_y) * (background + (clamp - background) * C + (sheet - background) * M)
 *         - sum over blobs of depth * exp(-r^2 / (2 sigma^2))
 * C and M are the coverages by the two clamps and by the sheet; all edges are logistic,
 * 1 / (1 + exp(-d / edge)). Blobs of the sheet vanish under the clamps with M's profile along y.
 * Blobs are cut at 5 sigma (4e-6 of the depth), edges at 16 edge widths (1e-7).
 *
 * The caller owns all memory, nothing is kept between calls, and no function writes to the scene: any
 * number of threads may share one. Pixels are float; positions are double. */
#ifndef HASELAB_CAMERA_H
#define HASELAB_CAMERA_H

#include <stddef.h> /* size_t */
#include <stdint.h> /* uint8_t, uint64_t */

#define CAMERA_SIGMA_MAX_PX 6.0
#define CAMERA_EDGE_MAX_PX 2.0
#define CAMERA_TABLE_SIZE 4096
#define CAMERA_SAMPLES_MAX 64 /* of an exposure */

typedef struct {
    double along;         /* S */
    double across;        /* X */
    double across_necked; /* X |X|^p */
    double sigma_px;      /* at most CAMERA_SIGMA_MAX_PX */
    double depth_grey;    /* positive: darker than what lies below */
} camera_blob;

typedef struct {
    int width, height;
    double top_px, mid_px, half_width_px, free_length_px;
    double neck;             /* growth of the contraction with the stretch */
    double edge_px;          /* at most CAMERA_EDGE_MAX_PX */
    double clamp_inside_px;  /* a clamp covers this much of the sheet, measured from its line */
    double clamp_outside_px; /* and reaches this far to the other side */
    float background_grey, sheet_grey, clamp_grey;
    const float *illumination_x; /* width values */
    const float *illumination_y; /* height values */
    const float *clamp_x;        /* width values: the clamps' coverage across the picture */
    const camera_blob *blobs;
    size_t blob_count;
} camera_scene;

typedef struct {
    int first, stop; /* the first one, and the one after the last */
} camera_span;

/* What is drawn: rows within the height, in spans of columns within the width. */
typedef struct {
    camera_span rows;
    const camera_span *columns;
    size_t count; /* of the spans of columns */
} camera_part;

typedef struct {
    float shot_gain_grey;  /* variance = shot_gain * level + read_noise^2, in grey^2 */
    float read_noise_grey;
    uint64_t seed;
    const float *table; /* CAMERA_TABLE_SIZE equally probable values of mean 0 and variance 1/2 */
} camera_noise;

/* Floats of scratch memory that camera_expect needs. */
size_t camera_scratch_size(const camera_scene *scene, size_t samples);

/* A part of the mean of the images at `samples` lengths, at most CAMERA_SAMPLES_MAX, in grey levels.
 * `level` holds width * height floats. Those of other rows stay as they are; those of other columns
 * in the same rows are undefined. */
void camera_expect(const camera_scene *scene, const double *lengths_px, size_t samples,
                   const camera_part *part, float *scratch, float *level);

/* A part of one noisy 8-bit exposure of the levels, rounded to nearest, saturated at 0 and 255; the
 * other pixels stay as they are. The noise depends on (seed, frame, pixel) alone, so frames and their
 * parts may be made in any order. */
void camera_expose(const camera_scene *scene, const float *level, const camera_part *part,
                   const camera_noise *noise, uint64_t frame, uint8_t *out);

#endif
