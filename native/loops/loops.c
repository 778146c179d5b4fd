/* One loop after the other, the definition; and the packing of sixteen. */
#include "loops/loops.h"

#include "loops/loops_noise.h"

#include <math.h>
#include <string.h>

uint32_t loops_noise_key(uint32_t n, uint32_t seed) { return noise_mix(n + seed); }

size_t loops_line_size(uint32_t delay)
{
    size_t size = 2;
    while (size <= delay) {
        size *= 2;
    }
    return size;
}

/* Output that arrives `delay` samples later; then the plant is advanced to the next sample. */
static float plant_step(const struct loops_plant *plant, struct loops_state *x, unsigned slow,
                        double u)
{
    const double z1 = x->z1, z2 = x->z2;
    double arriving = z1 + plant->feed * u;

    for (unsigned i = 0; i < slow; ++i) {
        arriving += x->slow[i];
        x->slow[i] = plant->decay[i] * x->slow[i] + plant->push[i] * u;
    }
    x->z1 = (plant->a11 * z1 + plant->a12 * z2) + plant->b1 * u;
    x->z2 = (plant->a21 * z1 + plant->a22 * z2) + plant->b2 * u;
    return (float)arriving;
}

static const struct loops_summary nothing = {0.0f, -INFINITY, INFINITY, -1.0f, 0.0f};

static void sum_up(struct loops_summary *sum, float reference, float arrived, float band,
                   size_t sample, float u, const hs_pid_config *pid)
{
    const float size = fabsf(reference - arrived);
    sum->error_sum += size;
    sum->top = arrived > sum->top ? arrived : sum->top;
    sum->bottom = arrived < sum->bottom ? arrived : sum->bottom;
    sum->last_outside = size > band ? (float)sample : sum->last_outside;
    sum->limited = u >= pid->u_high || u <= pid->u_low ? sum->limited + 1.0f : sum->limited;
}

static float noisy(const struct loops_loop *loop, const struct loops_task *task,
                   const float *noise, size_t k, float arrived)
{
    if (task->generated) {
        return arrived +
               noise_value(noise_count(k, task->noise_seed), loop->noise_key, loop->noise_std);
    }
    return noise ? arrived + noise[k] : arrived;
}

void loops_one(const struct loops_loop *loop, const struct loops_task *task, const float *noise,
               float *line, struct loops_traces traces, struct loops_summary *summaries)
{
    const size_t size = loops_line_size(loop->delay), mask = size - 1;
    struct loops_state x = loop->start;
    hs_pid_state pid;
    size_t k = 0;

    hs_pid_init(&pid, loop->u);
    for (size_t i = 0; i < size; ++i) {
        line[i] = loop->rest;
    }
    for (size_t s = 0; s < task->stretches; ++s) {
        struct loops_summary sum = nothing;
        for (size_t sample = 0; k < task->ends[s]; ++k, ++sample) {
            const float desired = task->reference[k];
            const float arrived = line[(k - loop->delay) & mask];
            const float measured = noisy(loop, task, noise, k, arrived);
            uint8_t limited;
            const float u = hs_limit(hs_pid_step(&loop->pid, &pid, desired, measured),
                                     loop->pid.u_low, loop->pid.u_high, &limited);
            line[k & mask] = plant_step(&loop->plant, &x, task->slow, (double)u);
            if (traces.u) {
                traces.measured[k] = measured;
                traces.u[k] = u;
            } else {
                sum_up(&sum, desired, arrived, task->band, sample, u, &loop->pid);
            }
        }
        if (!traces.u) {
            summaries[s] = sum;
        }
    }
}

struct exact_state {
    double integral, filtered;
};

#define PID_NUMBER double
#define PID_STEP exact_pid_step
#define PID_CONFIG struct loops_exact_pid
#define PID_STATE struct exact_state
#include "hs_pid_step.h"

/* plant_step() in double, with any number of slow branches. */
static double exact_plant_step(const struct loops_exact *p, double u)
{
    double *const x = p->state, z1 = x[0], z2 = x[1];
    double arriving = z1 + p->feed * u;

    for (size_t i = 0; i < p->slow; ++i) {
        arriving += x[2 + i];
        x[2 + i] = p->decay[i] * x[2 + i] + p->push[i] * u;
    }
    x[0] = (p->a11 * z1 + p->a12 * z2) + p->b1 * u;
    x[1] = (p->a21 * z1 + p->a22 * z2) + p->b2 * u;
    return arriving;
}

void loops_run_exact(const struct loops_exact *loop, const double *reference, const double *noise,
                     size_t samples, double *measured, double *u)
{
    const struct loops_exact_pid *const pid = &loop->pid;
    struct exact_state state = {loop->u, loop->line[0] + noise[0]};

    for (size_t k = 0; k < samples; ++k) {
        double *const place = loop->line + k % loop->delay;
        const double y = *place + noise[k];
        const double free_u = exact_pid_step(pid, &state, reference[k] - y, y, 1);
        measured[k] = y;
        u[k] = fmin(fmax(free_u, pid->u_low), pid->u_high);
        *place = exact_plant_step(loop, u[k]);
    }
}

void loops_pack(struct loops_group *group, const struct loops_loop loops[LOOPS_LANES], float *line)
{
    uint32_t longest = 0;
    size_t samples;

    group->period_s = loops[0].pid.period_s;
    group->delay = loops[0].delay;
    for (int j = 0; j < LOOPS_LANES; ++j) {
        const struct loops_plant *plant = &loops[j].plant;
        const struct loops_state *start = &loops[j].start;
        const hs_pid_config *pid = &loops[j].pid;
        hs_pid_state state;
        group->a11[j] = plant->a11, group->a12[j] = plant->a12;
        group->a21[j] = plant->a21, group->a22[j] = plant->a22;
        group->b1[j] = plant->b1, group->b2[j] = plant->b2;
        group->feed[j] = plant->feed;
        group->z1[j] = start->z1, group->z2[j] = start->z2;
        for (int i = 0; i < LOOPS_SLOW; ++i) {
            group->decay[i][j] = plant->decay[i];
            group->push[i][j] = plant->push[i];
            group->slow[i][j] = start->slow[i];
        }
        group->kp[j] = pid->kp, group->ki[j] = pid->ki, group->kd[j] = pid->kd;
        group->filter_constant[j] = pid->filter_constant;
        group->u_low[j] = pid->u_low, group->u_high[j] = pid->u_high;
        hs_pid_init(&state, loops[j].u);
        group->integral[j] = state.integral, group->filtered[j] = state.filtered;
        group->back[j] = (int32_t)(loops[j].delay * LOOPS_LANES) - j;
        group->delay = loops[j].delay == group->delay ? group->delay : 0;
        group->noise_std[j] = loops[j].noise_std;
        group->noise_key[j] = loops[j].noise_key;
        longest = loops[j].delay > longest ? loops[j].delay : longest;
    }
    samples = loops_line_size(longest);
    for (size_t i = 0; i < samples * LOOPS_LANES; ++i) {
        line[i] = loops[i % LOOPS_LANES].rest;
    }
    group->fresh = (1u << LOOPS_LANES) - 1;
    group->mask = (uint32_t)(samples - 1);
    group->line = line;
    group->noise = NULL;
    group->measured = group->u = NULL;
    loops_clear(group);
}

void loops_clear(struct loops_group *group)
{
    for (int j = 0; j < LOOPS_LANES; ++j) {
        group->error_sum[j] = nothing.error_sum;
        group->top[j] = nothing.top;
        group->bottom[j] = nothing.bottom;
        group->last_outside[j] = nothing.last_outside;
        group->limited[j] = nothing.limited;
    }
}

const struct loops_kernel *loops_select(int bits)
{
#ifdef HASELAB_LOOPS_X86
    __builtin_cpu_init();
    if (bits >= 512 && __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512dq")) {
        return &loops_avx512;
    }
    if (bits >= 256 && __builtin_cpu_supports("avx2")) {
        return &loops_avx2;
    }
#endif
    (void)bits;
    return NULL;
}
