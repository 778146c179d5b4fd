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
    struct track_pose *poses;   /* of this frame */
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

/* ---- one point: track_point.c ---- */

struct track_template track_template_of(const struct track_points *p, int i);

/* f = (1 + gradient) * base: how the template is deformed when the sheet is by `gradient`. */
void track_put_deformation(const double *gradient, const double *base, double *f);

/* Its displacement, from its pose. */
void track_note_moved(const struct track_work *w, int i);

/* From its pose on to where it is found, and why it is not believed. */
void track_refine_point(const struct track_work *w, int i);

/* ---- a point beside the others: track_step.c ---- */

int track_is_covered(const struct track_work *w, int i);
void track_mark_covered(const struct track_work *w);

/* Marks the points that strayed. All are judged by the same neighbours before any is marked. */
void track_mark_strays(const struct track_work *w);

/* ---- points that are not believed: track_rescue.c ---- */

int track_any_lost(const struct track_work *w);

/* Tries them again from where their neighbours put them, and by a search. */
void track_rescue(const struct track_work *w, const struct track_memory *before);

/* When few points are believed, those are believed no more: the whole scene has jumped, and they
 * sit on each other's neighbours. All wait where they were. */
int track_lost_hold(const struct track_work *w, const struct track_memory *before);

/* Lost points ride with their neighbours, from the found ones inwards; or wait. */
void track_settle(const struct track_work *w, const struct track_memory *before);

#endif
