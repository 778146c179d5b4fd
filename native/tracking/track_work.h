/* What the parts of one tracking step share. */
#ifndef HASELAB_TRACK_WORK_H
#define HASELAB_TRACK_WORK_H

#include "tracking/track_step.h"

/* The parts of the scratch memory, and all else that one step hands around. */
struct track_work {
    const struct track_kernels *kernels;
    const struct track_points *points;
    const struct track_rules *rules;
    const struct track_frame *frame;
    const struct track_patch *whole;
    double *poses;              /* of this frame */
    unsigned char *reasons;
    double *expected;           /* displacement gradients predicted for this frame */
    double *moved;              /* displacements of the subsets' centres in this frame */
    double *excess;             /* residual over what the noise explains */
    double *stds;               /* of the displacements, px: x, y; of believed points alone */
    struct track_result *results;
    double common_excess, common_gain;
    unsigned char *tried;
    void *refine, *search;
};

/* The summary of the step that is done. */
struct track_summary track_summarise(const struct track_work *w, const struct track_memory *before);

#endif
