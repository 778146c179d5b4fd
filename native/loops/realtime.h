/* The closed loop in a thread of its own: one block a tick, absolute deadlines, nothing but C.
 *
 * A tick is one block of both monitors. At its end the plant hands the block over, `rt_step` turns
 * it into an output, the output goes to the plant, and the block to a ring from which the recorder
 * takes it. The time from the deadline, which is the block's last sample, to the output is the
 * latency. Every way out of the thread ends with the plant's `zero`.
 *
 * The caller owns all memory and keeps it until `rt_join` has returned. Desktop only, POSIX.
 * Takes hs.h: the arithmetic of the loop is that of the microcontroller, bit for bit.
 */
#ifndef REALTIME_H
#define REALTIME_H

#include <pthread.h>
#include <stddef.h>
#include <stdint.h>

#include "hs.h"

#define RT_BINS 2000        /* of the histogram of latencies, the last for all beyond */
#define RT_BIN_NS 5000
#define RT_MOST_SAMPLES 4096

/* Why the loop ended. */
enum { RT_RUNNING, RT_DONE, RT_STOPPED, RT_SENSING_LOST, RT_DEADLINES, RT_PROTECTED, RT_OVERRUN };

/* ---- the loop's body ---------------------------------------------------------------------- */

typedef struct {
    uint32_t samples;            /* of a block and channel */
    uint32_t first, count;       /* samples of it that count: behind the settling of an update */
    const float *cosine, *sine;  /* of the carrier, `count` values from phase 0 */
    float inverse[8];            /* as hs_phasor_of_piece takes it, for `count` samples */
    hs_impedance_config impedance;
    hs_strain_map strain_map;
    hs_pid_config pid;
    hs_voltage_map voltage_map;
    float low_v, high_v;         /* of the drive: the last line before the output */
    int16_t full_scale;          /* a code of this size, of either sign, does not count */
} rt_control;

typedef struct {
    hs_pid_state pid;
    float output_v;              /* stays while there is no strain */
} rt_state;

typedef struct {
    float output_v, strain, capacitance_f;
    uint8_t reason;              /* bits of hs.h; 0: the strain holds */
} rt_result;

/* One block to one output. Where the reference is NaN the loop is open: the voltage of no strain. */
rt_result rt_step(const rt_control *control, rt_state *state, const int16_t *codes,
                  float reference);

/* ---- the plant ---------------------------------------------------------------------------- */

typedef struct {
    void *context;
    /* Waits for nothing: the block that has just ended, in which the output went to `output_v` at
     * `delay_ns` behind the block's start. Returns 0, else the plant has protected itself. */
    int (*exchange)(void *context, double output_v, int64_t delay_ns, int16_t *codes,
                    double *start_s);
    void (*zero)(void *context); /* 0 V now; cannot fail */
} rt_plant;

/* ---- the thread --------------------------------------------------------------------------- */

/* What is kept of a tick beside its codes. `latency_ns` is that of the output made from this block. */
typedef struct {
    double start_s, drive_v, reference, strain, latency_ns, reason;
} rt_row;

typedef struct {
    uint64_t ticks, late, missed, blind, most_missed, longest_ns, in_row;
    uint64_t latency[RT_BINS], work[RT_BINS]; /* from the deadline; from waking up */
} rt_counts;

typedef struct {
    const rt_control *control;
    rt_plant plant;
    int64_t period_ns;
    int64_t late_ns;             /* an output later than this after its block is late */
    uint32_t patience;           /* blocks without a strain that trip the loop */
    uint32_t patience_missed;    /* missed ticks in a row that trip it */
    int32_t priority;            /* of SCHED_FIFO; 0: ordinary */
    int64_t spin_ns;             /* before a deadline, in which the clock is looked at */
    const float *reference;      /* one a tick */
    size_t n_ticks;
    rt_row *rows;                /* the ring: `slots` rows, and `slots` blocks of codes */
    int16_t *codes;
    size_t slots;
    /* from here on the thread's own; read by rt_* alone */
    size_t written, taken;
    int32_t stopping, outcome, has_priority;
    rt_state state;
    rt_counts counts;
    pthread_t thread;
} rt_loop;

/* Starts the thread; returns 0, else an error number of the system. */
int rt_start(rt_loop *loop);
/* Asks it to end; returns at once. */
void rt_stop(rt_loop *loop);
void rt_join(rt_loop *loop);
/* RT_RUNNING, or why it has ended; counts are whole once it has. */
int32_t rt_outcome(const rt_loop *loop);
/* Blocks in the ring, oldest at slot `*first`; rt_release gives them back. */
size_t rt_available(const rt_loop *loop, size_t *first);
void rt_release(rt_loop *loop, size_t count);

/* A thread of the same kind that does nothing each tick: what the machine itself takes. Returns when
 * it is through, 0 or an error number of the system. */
int rt_idle(int64_t period_ns, size_t n_ticks, int32_t priority, rt_counts *counts);

#endif
