/* What the kernels of one instruction set do. Inside the tracker only; see track.h. */
#ifndef HASELAB_TRACK_KERNELS_H
#define HASELAB_TRACK_KERNELS_H

#include "tracking/track.h"

enum {
    TRACK_REACH = 7,          /* pixels that the inverse spline filter reads on each side */
    TRACK_FRACTION_BITS = 20, /* of a position in fixed point */
    TRACK_LANES = 16
};

/* The samples of a subset, in fixed point of TRACK_FRACTION_BITS. */
struct track_grid {
    const int16_t *values; /* coefficient at position (0, 0) */
    int pitch;
    int32_t x, y;                       /* of the first sample, at least 1.0 */
    int32_t along_x, along_y;           /* from one sample of a row to the next */
    int32_t down_x, down_y;             /* from one row to the next */
    int side, stride;
    float scale; /* grey levels per coefficient step and unit of the weights along x, 2^-15 */
};

/* Sums over the samples of a subset against its template. */
struct track_sums {
    float mean, amplitude; /* of w; shape . w */
    float square;          /* r . r */
    float weighted;        /* sum of r^2 (gx^2 + gy^2) over the sum of gx^2 + gy^2 */
    float descent[6];      /* gx . r, its moments along x and y, the same of gy */
};

struct track_kernels {
    const char *name;
    /* Inverse spline filter over (columns + 14) x (rows + 14) pixels. Rows of `pitch` entries, a
     * multiple of 32 and at least columns + 14, in the buffers; the result, rows x columns, in
     * rows of `out_pitch`, of which columns rounded up to 32 are written.
     * filter: `pixels` are 10 bits less 512; they are overwritten, as is `work` of the same size.
     * filter_bytes: bytes of a frame, `line` bytes from one row to the next, of which pitch + 2
     * are read. Needs both buffers too. */
    void (*filter)(int16_t *pixels, int16_t *work, int columns, int rows, int pitch, int16_t *out,
                   int out_pitch);
    void (*filter_bytes)(const unsigned char *bytes, ptrdiff_t line, int16_t *spare, int16_t *work,
                         int columns, int rows, int pitch, int16_t *out, int out_pitch);
    /* Pixels of one row to 10 bits less 512, `count` a multiple of 32. */
    void (*widen)(const void *pixels, int count, int bytes, int bits, int16_t *out);
    /* The samples, row by row; zeros in the padding. `out` has 16 floats more than stride. */
    void (*sample)(const struct track_grid *grid, float *out);
    void (*sums)(const struct track_template *t, const float *w, int moments,
                 struct track_sums *out);
};

extern const struct track_kernels track_portable, track_avx2, track_avx512;

#endif
