/* The twin as the plant of a loop in real time: it is stepped by one block a tick. */
#ifndef REALTIME_TWIN_H
#define REALTIME_TWIN_H

#include "loops/realtime.h"
#include "twin/twin.h"

typedef struct {
    const twin_parameters *parameters;
    twin_state *state;
    double load_n;
    int32_t samples;       /* a multiple of TWIN_SUB */
    int32_t switch_sample; /* of a block: an output that is ready sooner waits for it */
    double before_v;       /* output of the block before */
    double lengths[RT_MOST_SAMPLES / TWIN_SUB];
} rt_twin;

rt_plant rt_plant_of_twin(rt_twin *twin);

#endif
