/* The groups by one instruction set, which defines WIDTH and what is used below:
 *   vf, vd  WIDTH floats, WIDTH / 2 doubles        vm  a mask of WIDTH lanes
 * What is added and multiplied, and in which order, is loops_one() in loops.c and hs_pid_step.h;
 * a multiplication is never fused with an addition. Tests compare the bits. */

#define INLINE static inline __attribute__((always_inline))

struct wide {
    vd low, high; /* WIDTH doubles */
};

INLINE struct wide get(const double *x)
{
    return (struct wide){vd_load(x), vd_load(x + WIDTH / 2)};
}

INLINE void put(double *to, struct wide x)
{
    vd_store(to, x.low);
    vd_store(to + WIDTH / 2, x.high);
}

INLINE struct wide plus(struct wide a, struct wide b)
{
    return (struct wide){vd_add(a.low, b.low), vd_add(a.high, b.high)};
}

INLINE struct wide times(struct wide a, struct wide b)
{
    return (struct wide){vd_mul(a.low, b.low), vd_mul(a.high, b.high)};
}

/* plant_step() of loops.c */
INLINE vf plant_step(struct loops_group *g, int at, unsigned slow, vf output)
{
    const struct wide u = {vd_of_low(output), vd_of_high(output)};
    const struct wide z1 = get(g->z1 + at), z2 = get(g->z2 + at);
    struct wide arriving = plus(z1, times(get(g->feed + at), u));

    for (unsigned i = 0; i < slow; ++i) {
        const struct wide x = get(g->slow[i] + at);
        arriving = plus(arriving, x);
        put(g->slow[i] + at,
            plus(times(get(g->decay[i] + at), x), times(get(g->push[i] + at), u)));
    }
    put(g->z1 + at, plus(plus(times(get(g->a11 + at), z1), times(get(g->a12 + at), z2)),
                         times(get(g->b1 + at), u)));
    put(g->z2 + at, plus(plus(times(get(g->a21 + at), z1), times(get(g->a22 + at), z2)),
                         times(get(g->b2 + at), u)));
    return vf_of(arriving.low, arriving.high);
}

/* The filter takes the first measurement that is a number as its start. */
static void start(struct loops_group *g, int at, const float *desired, vf measured)
{
    float value[WIDTH];
    vf_store(value, measured);
    for (int j = 0; j < WIDTH; ++j) {
        const uint32_t bit = 1u << (at + j);
        const float error = *desired - value[j];
        if ((g->fresh & bit) && error == error) {
            g->filtered[at + j] = value[j];
            g->fresh &= ~bit;
        }
    }
}

/* The PID of the core, on many floats. */
struct wide_config {
    vf kp, ki, kd, period_s, filter_constant, u_low, u_high;
};

struct wide_state {
    vf integral, filtered;
};

#define PID_NUMBER vf
#define PID_STEP wide_pid_step
#define PID_CONFIG struct wide_config
#define PID_STATE struct wide_state
#define PID_TRUTH vm
#define PID_INLINE INLINE
#define PID_ZERO vf_set(0.0f)
#define PID_ADD vf_add
#define PID_SUB vf_sub
#define PID_MUL vf_mul
#define PID_DIV vf_div
#define PID_ABOVE vm_above
#define PID_OR vm_or
#define PID_AND vm_and
#define PID_AND_NOT vm_and_not
#define PID_CHOOSE vf_select
#include "hs_pid_step.h"

/* hs_pid_step() of core/hs_pid.c, then hs_limit(): NaN becomes 0. */
INLINE vf pid_step(struct loops_group *g, int at, vf desired, vf measured, vf period)
{
    const struct wide_config config = {
        vf_load(g->kp + at),    vf_load(g->ki + at), vf_load(g->kd + at),
        period,                 vf_load(g->filter_constant + at),
        vf_load(g->u_low + at), vf_load(g->u_high + at)};
    struct wide_state state = {vf_load(g->integral + at), vf_load(g->filtered + at)};
    const vf error = vf_sub(desired, measured);
    const vf u = wide_pid_step(&config, &state, error, measured, vm_number(error));

    vf_store(g->filtered + at, state.filtered);
    vf_store(g->integral + at, state.integral);
    return vf_limit(u, config.u_low, config.u_high);
}

/* sum_up() of loops.c */
INLINE void sum_up(struct loops_group *g, int at, vf desired, vf arrived, vf band, vf sample, vf u)
{
    float *const sum = g->error_sum + at, *const top = g->top + at, *const low = g->bottom + at;
    float *const last = g->last_outside + at, *const limited = g->limited + at;
    const vf size = vf_size(vf_sub(desired, arrived)), count = vf_load(limited);
    const vm at_limit = vm_or(vm_reaches(u, vf_load(g->u_high + at)),
                              vm_reaches(vf_load(g->u_low + at), u));

    vf_store(sum, vf_add(vf_load(sum), size));
    vf_store(top, vf_larger(arrived, vf_load(top)));
    vf_store(low, vf_smaller(arrived, vf_load(low)));
    vf_store(last, vf_select(vm_above(size, band), sample, vf_load(last)));
    vf_store(limited, vf_select(at_limit, vf_add(count, vf_set(1.0f)), count));
}

/* Lanes [at, at + WIDTH) of a group at one sample. */
INLINE void step(struct loops_group *g, int at, const struct loops_span *span, size_t k,
                 const unsigned slow, const int noisy, const int traced)
{
    const size_t row = (k - span->from) * LOOPS_LANES + (size_t)at;
    const vf desired = vf_set(span->reference[k]);
    vf arrived, measured, u;

    if (g->delay) {
        arrived = vf_load(g->line + ((k - g->delay) & g->mask) * LOOPS_LANES + at);
    } else {
        arrived = vf_gather(g->line, (int32_t)(k & g->mask) * LOOPS_LANES, g->back + at,
                            (int32_t)(g->mask * LOOPS_LANES + LOOPS_LANES - 1));
    }
    measured = noisy ? vf_add(arrived, vf_load(g->noise + row)) : arrived;
    if (g->fresh) {
        start(g, at, span->reference + k, measured);
    }
    u = pid_step(g, at, desired, measured, vf_set(g->period_s));
    vf_store(g->line + (k & g->mask) * LOOPS_LANES + at, plant_step(g, at, slow, u));
    if (traced) {
        vf_store(g->measured + row, measured);
        vf_store(g->u + row, u);
    } else {
        sum_up(g, at, desired, arrived, vf_set(span->band), vf_set((float)(k - span->first)), u);
    }
}

INLINE void run(struct loops_group *groups, size_t count, const struct loops_span *span,
                const unsigned slow, const int noisy, const int traced)
{
    for (size_t k = span->from; k < span->to; ++k) {
        for (size_t g = 0; g < count; ++g) {
            for (int at = 0; at < LOOPS_LANES; at += WIDTH) {
                step(groups + g, at, span, k, slow, noisy, traced);
            }
        }
    }
}

INLINE void run_slow(struct loops_group *groups, size_t count, const struct loops_span *span,
                     const int noisy, const int traced)
{
    switch (span->slow) {
    case 0: run(groups, count, span, 0, noisy, traced); break;
    case 1: run(groups, count, span, 1, noisy, traced); break;
    case 2: run(groups, count, span, 2, noisy, traced); break;
    default: run(groups, count, span, 3, noisy, traced); break;
    }
}

static void run_any(struct loops_group *groups, size_t count, const struct loops_span *span)
{
    const int noisy = groups->noise != NULL, traced = groups->u != NULL;
    if (noisy && traced) {
        run_slow(groups, count, span, 1, 1);
    } else if (noisy) {
        run_slow(groups, count, span, 1, 0);
    } else if (traced) {
        run_slow(groups, count, span, 0, 1);
    } else {
        run_slow(groups, count, span, 0, 0);
    }
}

/* noise_value() of loops_noise.h, stage by stage: short chains of operations side by side. */
enum { AT_ONCE = 4 };
static void make_noise(const struct loops_group *group, uint32_t seed, size_t from, size_t to,
                       float *rows)
{
    enum { COUNT = AT_ONCE * LOOPS_LANES };
    float uniform[COUNT], depth[COUNT], std[COUNT];

    for (int j = 0; j < COUNT; ++j) {
        std[j] = group->noise_std[j % LOOPS_LANES];
    }
    for (; from < to; from += AT_ONCE, rows += COUNT) {
        for (int i = 0; i < AT_ONCE; ++i) {
            const uint32_t count = noise_count(from + (size_t)i, seed);
            for (int j = 0; j < LOOPS_LANES; ++j) {
                uniform[i * LOOPS_LANES + j] =
                    noise_uniform(noise_mix(count ^ group->noise_key[j]));
            }
        }
        for (int j = 0; j < COUNT; ++j) {
            depth[j] = noise_depth(uniform[j]);
        }
        for (int j = 0; j < COUNT; ++j) {
            rows[j] = std[j] * noise_quantile(uniform[j], depth[j]);
        }
    }
}
