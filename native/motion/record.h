/* A record: an actuator under voltages and loads that are constant between edges, its lengths at
 * given times, and its mean capacitance between edges. With a tangent, their derivatives too. Where
 * neither is wanted and only creep is left, the steps are longer. */
#ifndef MOTION_RECORD_H
#define MOTION_RECORD_H

#include "motion/motion.h"

typedef struct {
    int32_t intervals;
    const double *edge_s;                        /* intervals + 1, rising */
    const motion_input *input;                   /* of each interval */
    const double *mass_kg;                       /* of each interval, added to p->inertia_kg */
    const uint8_t *sensed;                       /* of each interval: capacitance wanted */
    int32_t times;
    const double *time_s;                        /* rising, from the first edge to the last */
} motion_record;

/* lengths, speeds: [times]; means and drifts (change of the capacitance from an interval's start to
 * its end, over its duration): [intervals], 0 where not sensed. The derivatives have
 * [times][columns] and [sensed intervals][columns] values and may be NULL without a tangent, whose rows
 * and 2 * MOTION_ROWS * columns values of `kept` the caller gives. */
typedef struct {
    double *length_m, *speed_m_s, *mean_f, *drift_f_s;
    double *length_by, *mean_by;
    double *kept;
} motion_output;

void motion_play(const motion_law *law, const motion_parameters *p, motion_state *s,
                 motion_tangent *tangent, const motion_record *record, const motion_output *output);

#endif
