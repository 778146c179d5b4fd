/* Closed loops: a resonance with slow branches and any delay, under the core's controller.
 *
 * The plant is stepped in double, from one sample to the next without error of discretisation; its
 * coefficients are the caller's (src/haselab/control/plants/held.py). Single precision would lose
 * slow branches: above 2^-24 tau / period of its size a state no longer moves. The controller is
 * core/hs_pid.c in float. loops_one() is the definition; the groups of sixteen loops give its bits.
 */
#ifndef HASELAB_LOOPS_H
#define HASELAB_LOOPS_H

#include <stddef.h>
#include <stdint.h>

#include "hs.h"

#ifdef __cplusplus
extern "C" {
#endif

enum {
    LOOPS_SLOW = 3,  /* slow branches at most */
    LOOPS_LANES = 16 /* loops of a group */
};

/* One step: v = z1 + sum(slow) + feed u is the output that arrives `delay` samples later; then
 * z <- (a11 a12; a21 a22) z + (b1 b2) u, slow <- decay slow + push u. */
struct loops_plant {
    double a11, a12, a21, a22;
    double b1, b2;
    double feed;
    double decay[LOOPS_SLOW], push[LOOPS_SLOW];
};

struct loops_state {
    double z1, z2, slow[LOOPS_SLOW];
};

struct loops_loop {
    struct loops_plant plant;
    struct loops_state start;
    hs_pid_config pid;
    float u;             /* output before the first sample */
    float rest;          /* measurement before the first output arrives */
    uint32_t delay;      /* samples, 1 or more */
    float noise_std;     /* of generated noise */
    uint32_t noise_key;  /* distinct for each loop, mixed */
};

/* Summary of the samples of a segment. The error is the reference minus the output that arrives,
 * without the noise. */
struct loops_summary {
    float error_sum; /* of sizes */
    float top, bottom;
    float last_outside; /* last sample, from the stretch's first on, with an error beyond the band;
                         * -1 without one */
    float limited;      /* samples with the controller's output at a limit */
};

struct loops_task {
    const float *reference; /* one value a sample */
    const size_t *ends;     /* first sample behind each stretch; the last ends the run */
    size_t stretches;
    unsigned slow; /* branches that are counted in */
    float band;
    int generated;       /* noise is made as it is needed (loops_noise.h) */
    uint32_t noise_seed; /* common to all loops */
};

/* Results of a run: traces of every sample, or (if `u` is null) a summary of each segment. */
struct loops_traces {
    float *measured, *u;
};

/* Floats of a line that holds `delay` samples: a power of two. */
size_t loops_line_size(uint32_t delay);

/* The key of the n-th loop. */
uint32_t loops_noise_key(uint32_t n, uint32_t seed);

/* One loop from start to end, ~13 ns a sample. `noise`: added to the measurements, one value a
 * sample, NaN for a lost one; or null. `line` has loops_line_size(delay) floats. */
void loops_one(const struct loops_loop *loop, const struct loops_task *task, const float *noise,
               float *line, struct loops_traces traces, struct loops_summary *summaries);

/* hs_pid_config in double. */
struct loops_exact_pid {
    double kp, ki, kd, period_s, filter_constant, u_low, u_high;
};

/* One loop in double, its PID too. Any number of slow branches; `state` holds z1, z2 and theirs.
 * `line`: `delay` measurements before the first output arrives, oldest first, used as a ring. */
struct loops_exact {
    double a11, a12, a21, a22, b1, b2, feed;
    const double *decay, *push;
    double *state;
    size_t slow;
    struct loops_exact_pid pid;
    double u; /* output before the first sample */
    double *line;
    size_t delay; /* samples, 1 or more */
};

void loops_run_exact(const struct loops_exact *loop, const double *reference, const double *noise,
                     size_t samples, double *measured, double *u);

/* ---- sixteen at a time ----------------------------------------------------------------------- */

#ifdef __GNUC__
#define LOOPS_ALIGNED __attribute__((aligned(64)))
#else
#define LOOPS_ALIGNED
#endif

/* Parameters and state of each loop, lane by lane. */
struct LOOPS_ALIGNED loops_group {
    double a11[LOOPS_LANES], a12[LOOPS_LANES], a21[LOOPS_LANES], a22[LOOPS_LANES];
    double b1[LOOPS_LANES], b2[LOOPS_LANES], feed[LOOPS_LANES];
    double decay[LOOPS_SLOW][LOOPS_LANES], push[LOOPS_SLOW][LOOPS_LANES];
    double z1[LOOPS_LANES], z2[LOOPS_LANES], slow[LOOPS_SLOW][LOOPS_LANES];
    float kp[LOOPS_LANES], ki[LOOPS_LANES], kd[LOOPS_LANES], filter_constant[LOOPS_LANES];
    float u_low[LOOPS_LANES], u_high[LOOPS_LANES];
    float integral[LOOPS_LANES], filtered[LOOPS_LANES];
    /* as in struct loops_summary */
    float error_sum[LOOPS_LANES], top[LOOPS_LANES], bottom[LOOPS_LANES];
    float last_outside[LOOPS_LANES], limited[LOOPS_LANES];
    int32_t back[LOOPS_LANES];           /* 16 delay - lane: distance of a delayed reading */
    float noise_std[LOOPS_LANES];
    uint32_t noise_key[LOOPS_LANES];
    float period_s;                      /* common to all loops */
    uint32_t delay;                      /* of all lanes, 0 where they differ */
    uint32_t fresh;                      /* lanes whose filter has not started, a bit each */
    uint32_t mask;                       /* samples of the line less 1 */
    float *line;                         /* rows of 16; 64-byte aligned */
    const float *noise;                  /* rows of 16 from the span's first sample on, or null */
    float *measured, *u;                 /* likewise; both null for summaries */
};

/* Samples [from, to) of a run, in the stretch that begins at `first`. */
struct loops_span {
    const float *reference;
    size_t first, from, to;
    unsigned slow;
    float band;
};

/* `line` has 16 loops_line_size(longest delay) floats. */
void loops_pack(struct loops_group *group, const struct loops_loop loops[LOOPS_LANES], float *line);
void loops_clear(struct loops_group *group);

struct loops_kernel {
    /* Groups in step with each other: a few at a time hide each other's latency. */
    void (*run)(struct loops_group *groups, size_t count, const struct loops_span *span);
    /* Generated noise of a group for the samples [from, to), in rows of 16; up to 3 rows more are
     * written. */
    void (*noise)(const struct loops_group *group, uint32_t seed, size_t from, size_t to,
                  float *rows);
};

/* The widest of at most `bits` that this machine has, null for none. */
const struct loops_kernel *loops_select(int bits);

extern const struct loops_kernel loops_avx2, loops_avx512;

#ifdef __cplusplus
}
#endif

#endif
