/* Takes: a plant and a reference. Gives: outputs on time, blocks in a ring, counts of what was not. */
#define _GNU_SOURCE
#include "loops/realtime.h"

#include <math.h>
#include <sched.h>
#include <string.h>
#include <time.h>

#ifdef __linux__
#include <sys/prctl.h>
#endif

/* ---- the loop's body ---- */

static uint8_t pick(const rt_control *c, const int16_t *codes, uint32_t channel, float *out)
{
    uint8_t reason = 0;
    uint32_t k;
    for (k = 0; k < c->count; ++k) {
        const int16_t code = codes[2 * (c->first + k) + channel];
        if (code >= c->full_scale || code <= -c->full_scale) {
            reason = HS_CLIPPED;
        }
        out[k] = (float)code;
    }
    return reason;
}

rt_result rt_step(const rt_control *c, rt_state *state, const int16_t *codes, float reference)
{
    float x[RT_MOST_SAMPLES];
    hs_phasor phasor[2];
    hs_impedance z;
    rt_result r;
    uint32_t channel;
    uint8_t limited, reason = 0;

    for (channel = 0; channel < 2; ++channel) {
        hs_sums sums;
        reason |= pick(c, codes, channel, x);
        hs_sum_pieces(x, c->count, c->cosine, c->sine, (uint16_t)c->count, &sums);
        phasor[channel] = hs_phasor_of_piece(c->inverse, &sums);
    }
    z = hs_impedance_of(&c->impedance, &phasor[0], &phasor[1]);
    r.reason = reason | z.reason;
    r.capacitance_f = z.capacitance_f;
    r.strain = r.reason ? NAN : hs_strain_from_capacitance(&c->strain_map, z.capacitance_f);
    if (isnan(reference)) {
        state->output_v = hs_voltage_from_strain(&c->voltage_map, 0.0f);
    } else if (!r.reason) {
        const float u = hs_pid_step(&c->pid, &state->pid, reference, r.strain);
        state->output_v = hs_voltage_from_strain(&c->voltage_map, u);
    }
    state->output_v = hs_limit(state->output_v, c->low_v, c->high_v, &limited);
    r.output_v = state->output_v;
    return r;
}

/* ---- time ---- */

static int64_t now_ns(void)
{
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return (int64_t)t.tv_sec * 1000000000 + t.tv_nsec;
}

static void sleep_until(int64_t deadline_ns)
{
#ifdef __linux__
    const struct timespec t = {(time_t)(deadline_ns / 1000000000), (long)(deadline_ns % 1000000000)};
    while (clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &t, NULL) != 0) {
    }
#else
    int64_t left;
    while ((left = deadline_ns - now_ns()) > 0) {
        const struct timespec t = {(time_t)(left / 1000000000), (long)(left % 1000000000)};
        nanosleep(&t, NULL);
    }
#endif
}

/* Sleeps until shortly before the deadline, and looks at the clock from then on: a processor that
 * was not given up need not be got back, which takes long where it is a virtual one. */
static void wait_until(int64_t deadline_ns, int64_t spin_ns)
{
    sleep_until(deadline_ns - spin_ns);
    while (spin_ns > 0 && now_ns() < deadline_ns) {
    }
}

static void be_quick(rt_loop *loop)
{
#ifdef __linux__
    prctl(PR_SET_TIMERSLACK, 1UL, 0UL, 0UL, 0UL); /* an ordinary thread may else sleep 50 us longer */
#endif
    if (loop->priority > 0) {
        struct sched_param how;
        memset(&how, 0, sizeof how);
        how.sched_priority = loop->priority;
        loop->has_priority = pthread_setschedparam(pthread_self(), SCHED_FIFO, &how) == 0;
    }
}

/* ---- one tick ---- */

static void count_into(uint64_t *bins, int64_t ns)
{
    const int64_t bin = ns < 0 ? 0 : ns / RT_BIN_NS;
    ++bins[bin < RT_BINS ? bin : RT_BINS - 1];
}

static int32_t count_tick(rt_loop *loop, int64_t latency_ns, int64_t work_ns)
{
    rt_counts *n = &loop->counts;
    ++n->ticks;
    count_into(n->latency, latency_ns);
    count_into(n->work, work_ns);
    if ((uint64_t)latency_ns > n->longest_ns) {
        n->longest_ns = (uint64_t)latency_ns;
    }
    n->late += latency_ns > loop->late_ns;
    if (latency_ns < loop->period_ns) {
        n->in_row = 0;
        return RT_RUNNING;
    }
    ++n->missed;
    ++n->in_row;
    if (n->in_row > n->most_missed) {
        n->most_missed = n->in_row;
    }
    return n->in_row >= loop->patience_missed ? RT_DEADLINES : RT_RUNNING;
}

static int32_t run(rt_loop *loop)
{
    const int64_t start_ns = now_ns();
    const uint32_t block = 2 * loop->control->samples;
    int64_t delay_ns = 0; /* of the output that stands, behind the start of its block */
    uint32_t lost = 0;
    size_t k;

    for (k = 0; k < loop->n_ticks; ++k) {
        const int64_t deadline_ns = start_ns + (int64_t)(k + 1) * loop->period_ns;
        const size_t slot = loop->written % loop->slots;
        int16_t *codes = loop->codes + slot * block;
        rt_row *row = loop->rows + slot;
        const double output_v = (double)loop->state.output_v;
        int64_t awake_ns, done_ns;
        int32_t outcome;
        rt_result r;

        wait_until(deadline_ns, loop->spin_ns);
        awake_ns = now_ns();
        if (__atomic_load_n(&loop->stopping, __ATOMIC_ACQUIRE)) {
            return RT_STOPPED;
        }
        if (loop->written - __atomic_load_n(&loop->taken, __ATOMIC_ACQUIRE) >= loop->slots) {
            return RT_OVERRUN;
        }
        if (loop->plant.exchange(loop->plant.context, output_v, delay_ns, codes, &row->start_s)) {
            return RT_PROTECTED;
        }
        r = rt_step(loop->control, &loop->state, codes, loop->reference[k]);
        done_ns = now_ns();
        delay_ns = done_ns - deadline_ns;
        row->drive_v = output_v;
        row->reference = (double)loop->reference[k];
        row->strain = (double)r.strain;
        row->latency_ns = (double)delay_ns;
        row->reason = (double)r.reason;
        __atomic_store_n(&loop->written, loop->written + 1, __ATOMIC_RELEASE);
        outcome = count_tick(loop, delay_ns, done_ns - awake_ns);
        lost = r.reason ? lost + 1 : 0;
        loop->counts.blind += r.reason != 0;
        if (lost >= loop->patience) {
            return RT_SENSING_LOST;
        }
        if (outcome != RT_RUNNING) {
            return outcome;
        }
    }
    return RT_DONE;
}

static void *thread_of(void *argument)
{
    rt_loop *loop = argument;
    int32_t outcome;
    be_quick(loop);
    outcome = run(loop);
    loop->plant.zero(loop->plant.context);
    __atomic_store_n(&loop->outcome, outcome, __ATOMIC_RELEASE);
    return NULL;
}

static void *idle_of(void *argument)
{
    rt_loop *loop = argument;
    const int64_t start_ns = now_ns();
    size_t k;
    be_quick(loop);
    for (k = 1; k <= loop->n_ticks; ++k) {
        const int64_t deadline_ns = start_ns + (int64_t)k * loop->period_ns;
        sleep_until(deadline_ns);
        count_tick(loop, now_ns() - deadline_ns, 0);
    }
    return NULL;
}

/* ---- for the caller ---- */

int rt_idle(int64_t period_ns, size_t n_ticks, int32_t priority, rt_counts *counts)
{
    rt_loop loop;
    int error;
    memset(&loop, 0, sizeof loop);
    loop.period_ns = loop.late_ns = period_ns;
    loop.n_ticks = n_ticks;
    loop.priority = priority;
    loop.patience_missed = UINT32_MAX;
    error = pthread_create(&loop.thread, NULL, idle_of, &loop);
    if (error == 0) {
        pthread_join(loop.thread, NULL);
        *counts = loop.counts;
    }
    return error;
}

int rt_start(rt_loop *loop)
{
    loop->written = loop->taken = 0;
    loop->stopping = loop->has_priority = 0;
    loop->outcome = RT_RUNNING;
    memset(&loop->counts, 0, sizeof loop->counts);
    hs_pid_init(&loop->state.pid, 0.0f);
    loop->state.output_v = hs_voltage_from_strain(&loop->control->voltage_map, 0.0f);
    return pthread_create(&loop->thread, NULL, thread_of, loop);
}

void rt_stop(rt_loop *loop)
{
    __atomic_store_n(&loop->stopping, 1, __ATOMIC_RELEASE);
}

void rt_join(rt_loop *loop)
{
    pthread_join(loop->thread, NULL);
}

int32_t rt_outcome(const rt_loop *loop)
{
    return __atomic_load_n(&loop->outcome, __ATOMIC_ACQUIRE);
}

size_t rt_available(const rt_loop *loop, size_t *first)
{
    *first = loop->taken % loop->slots;
    return __atomic_load_n(&loop->written, __ATOMIC_ACQUIRE) - loop->taken;
}

void rt_release(rt_loop *loop, size_t count)
{
    __atomic_store_n(&loop->taken, loop->taken + count, __ATOMIC_RELEASE);
}
