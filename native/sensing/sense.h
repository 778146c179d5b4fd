/* Lock-in over a block of segments: phasors, noise, disturbances; sensing on the desktop.
 *
 * A block is cut into segments of at least one carrier period. core/hs_lockin.c makes the sums of
 * each segment in one pass over the samples; everything else here uses these sums: least squares over
 * the segments that are used, noise from the residuals of each segment, and the search for an output
 * update at an unknown time in the block.
 */
#ifndef HASELAB_SENSE_H
#define HASELAB_SENSE_H

#include <stddef.h>
#include <stdint.h>

#include "sensing/sum_segments.h"

#ifdef __cplusplus
extern "C" {
#endif

#define SENSE_SEGMENTS 32 /* full segments in a block, at most */
#define SENSE_ALL (SENSE_SEGMENTS + 8) /* and the rest; a multiple of 8 */

/* Functions over a block: the ramp goes from -1/2 to 1/2, the step is 1 after the update. */
enum { SENSE_COS, SENSE_SIN, SENSE_LEVEL, SENSE_RAMP, SENSE_STEP, SENSE_BASIS };

typedef enum { SENSE_INT16, SENSE_FLOAT, SENSE_DOUBLE } sense_type;

/* Which segments are used, which are after an update, and the resulting least squares. */
typedef struct {
    double used[SENSE_ALL];
    double after[SENSE_ALL];
    double inverse[SENSE_BASIS][SENSE_BASIS];
    double samples;     /* that count */
    double full;        /* full segments that are used */
    double after_share; /* fraction of the used samples that is after the update */
} sense_choice;

/* Constants of all blocks; the owner fills it once. */
typedef struct {
    sum_segments_fn sum;
    size_t samples; /* a block */
    size_t segment;   /* samples of a full segment */
    size_t segments;  /* full ones; the remaining samples are one shorter segment */
    size_t start;   /* first segment that is used */
    size_t padded;  /* segments and rest, rounded up to a multiple of 8 for the vector units */
    const float *cosine, *sine;         /* of the carrier, `segment` values each */
    const float *cosine3, *sine3;       /* of its third harmonic */
    double table[2][2];                 /* sums of cosine and sine: full segment, rest */
    double turn_cos[SENSE_ALL], turn_sin[SENSE_ALL]; /* phase at each segment's first sample */
    double local_inverse[4][4];         /* (B'B)^-1 of one full segment: cos, sin, 1, ramp */
    double local_whitening[2][2];       /* inverse of its upper left 2 x 2 */
    double period_s;                    /* between samples */
    double omega_rad_s;                 /* nominal carrier */
    float full_scale, current_limit;    /* unit of the readings */
    const sense_choice *choices;        /* the first as planned, the others for the search */
    size_t choice_count;                /* 1: no search */
} sense_plan;

/* Results of a block. */
typedef struct {
    double v_re, v_im, i_re, i_im; /* peak phasors at the block's first sample */
    double v_noise, i_noise;       /* variance of one reading */
    double v_level, i_level;       /* mean over the used samples, at the block's middle */
    double v_slope, i_slope;       /* per s */
    double excess; /* variance of the segments' phasors over that of the noise; 1: no excess */
    double offset_rad_s;           /* of the carrier from its nominal frequency */
    double v3_re, v3_im, i3_re, i3_im; /* third harmonic of the carrier, at the first sample */
    uint32_t choice;               /* index of the choice that was taken */
    uint32_t reason;               /* HS_CLIPPED and the like */
    uint32_t suspicion;            /* SENSE_DRIVE and the like; 0: the plain model explains it all */
} sense_result;

/* Misfits of the plain model; noise exceeds each in about one block of 10,000. */
#define SENSE_DRIVE 1u  /* levels of the segments about a straight line */
#define SENSE_SCATTER 2u /* phasors of the segments about a straight line */
#define SENSE_COLOUR 4u /* one residual and the next */
#define SENSE_THIRD 8u  /* third harmonic */
#define SENSE_PEAK 16u  /* a single reading */
#define SENSE_CROSS 32u /* both channels' residuals at one instant */

/* Floats of room that one call of sense_block needs: both channels of a segment. */
size_t sense_room(const sense_plan *plan);

/* One block of `plan->samples` readings a channel, `stride` apart. ahead: memory so many bytes
 * further on is prefetched as the block is read; 0 if none follows. tested: whether the residuals
 * of the plain model are tested, which takes longer than the fit. */
void sense_block(const sense_plan *plan, sense_type type, const void *v, const void *i,
                 size_t stride, size_t ahead, int tested, float *room, sense_result *out);

#ifdef __cplusplus
}
#endif

#endif
