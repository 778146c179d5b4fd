/* Takes: resources/twin.bin, inputs and communication points. Gives: the outputs of the twin. */
#include "fmu/instance.h"

#include <math.h>
#include <string.h>

#define RAMP_PIECES 50
#define RAMP_S 1.0

/* ---- parameters ---- */

void fmu_reset(fmu_bench *b)
{
    uint32_t k;
    memset(b->now, 0, fmu_memory_size(b));
    b->now->owner = b->owner;
    b->now->seed = b->about.seed;
    b->now->input[FMU_CARRIER_HZ] = 2000.0;
    for (k = 0; k < b->about.parameters; ++k) {
        b->now->parameter[k] = b->records[k].start;
    }
}

void fmu_apply(fmu_bench *b)
{
    const double *x = b->composed;
    twin_parameters *p = &b->p;
    double moved_kg;
    uint32_t k;
    for (k = 0; k < b->about.parameters; ++k) {
        const int64_t place = b->records[k].place;
        if (place < 0) {
            b->composed[-place] = b->now->parameter[k];
        } else {
            memcpy((char *)p + place, &b->now->parameter[k], sizeof(double));
        }
    }
    p->gain = x[-FMU_GAIN] * (1.0 + x[-FMU_GAIN_ERROR]);
    p->amplifier_rad_s = TWO_PI * x[-FMU_BANDWIDTH_HZ];
    p->v_monitor = (1.0 + x[-FMU_V_MONITOR_GAIN_ERROR]) / x[-FMU_VOLT_PER_MONITOR_VOLT];
    p->i_monitor = (1.0 + x[-FMU_I_MONITOR_GAIN_ERROR]) / x[-FMU_AMPERE_PER_MONITOR_VOLT];
    p->second_rad_s = TWO_PI * x[-FMU_RESONANCE_HZ];
    moved_kg = fmax(x[-FMU_MASS_KG], b->about.clamp_kg);
    p->motion.inertia_kg = moved_kg + x[-FMU_ADDED_INERTIA_KG] + b->about.moving_kg;
    b->load_n = x[-FMU_MASS_KG] * b->about.gravity_m_s2;
    b->delay_samples = (int64_t)floor(x[-FMU_OUTPUT_DELAY_S] / p->sample_s + 0.5);
    twin_prepare(p);
}

void fmu_set_carrier(fmu_bench *b)
{
    b->p.carrier_v = b->now->carrier_v;
    b->p.carrier_rad_s = TWO_PI * b->now->carrier_hz;
}

static void pass(fmu_bench *b, double load_n, int32_t steps)
{
    const double off_v = 0.0;
    twin_move(&b->p, &b->now->twin, &off_v, 1, steps > 1 ? steps : 1, load_n, steps, NULL);
}

fmu_status fmu_settle(fmu_bench *b)
{
    twin_state *s = &b->now->twin;
    double step_s, left_s;
    int k;
    if (b->now->settled) {
        return FMU_OK;
    }
    fmu_apply(b);
    b->now->carrier_v = b->now->carrier_hz = 0.0;
    fmu_set_carrier(b);
    if (b->p.law.voltages > 1 &&
        b->p.gain * (fmax(b->about.drive_high_v, -b->about.drive_low_v) + 1.0) >
            b->about.highest_law_v * (1.0 + 1e-9)) {
        return fmu_fail(b, "The gain of the amplifier is %g V/V, but this FMU knows the actuator up to "
                       "%g V. Export it again from a TWIN.toml with this gain.",
                    b->p.gain, b->about.highest_law_v);
    }
    step_s = TWIN_SUB * b->p.sample_s;
    memset(s, 0, sizeof *s);
    s->since_limited = TWIN_LONG;
    twin_seed(s, (uint64_t)b->now->seed);
    motion_rest(&b->p.law, &b->p.motion, &s->motion, b->p.motion.free_length_m,
                b->p.motion.free_length_m);
    for (k = 1; k <= RAMP_PIECES; ++k) {
        pass(b, b->load_n * k / RAMP_PIECES, (int32_t)floor(RAMP_S / RAMP_PIECES / step_s + 0.5));
    }
    for (left_s = floor(b->about.settle_s / step_s + 0.5); left_s > 0.0; left_s -= 5e6) {
        pass(b, b->load_n, (int32_t)fmin(left_s, 5e6));
    }
    if (s->outside) {
        return fmu_fail(b, "Under %g kg the actuator leaves the lengths in which its law is valid. "
                       "Lower load.mass_kg.",
                    b->composed[-FMU_MASS_KG]);
    }
    s->field_v_m = 0.0;
    b->now->settled = 1;
    return FMU_OK;
}

fmu_status fmu_initialise(fmu_bench *b)
{
    fmu_status status;
    if (!b->now->started) {
        return fmu_fail(b, "The initialisation was not entered. Enter it before it is exited.");
    }
    status = fmu_settle(b);
    b->now->initialised = status == FMU_OK;
    return status;
}

/* ---- time ---- */

fmu_status fmu_start(fmu_bench *b, double time_s)
{
    if (b->now->initialised) {
        return fmu_fail(b, "The simulation has been initialised before. Reset it first.");
    }
    if (!isfinite(time_s)) {
        return fmu_fail(b, "The start time is %g s. State a finite time.", time_s);
    }
    b->now->start_s = time_s;
    b->now->started = 1;
    return FMU_OK;
}

fmu_status fmu_enter(fmu_bench *b)
{
    return fmu_start(b, b->now->started ? b->now->start_s : 0.0);
}

double fmu_time(const fmu_bench *b)
{
    return b->now->start_s + (double)b->now->steps * TWIN_SUB * b->p.sample_s;
}

static fmu_status check_inputs(fmu_bench *b)
{
    const double *in = b->now->input, nyquist_hz = 0.4 / b->p.sample_s;
    if (!(in[FMU_DRIVE_V] >= b->about.drive_low_v && in[FMU_DRIVE_V] <= b->about.drive_high_v)) {
        return fmu_fail(b, "drive_v is %g V, but the output gives %g to %g V. Limit it in the model.",
                    in[FMU_DRIVE_V], b->about.drive_low_v, b->about.drive_high_v);
    }
    if (!(in[FMU_CARRIER_V] >= 0.0 && in[FMU_CARRIER_V] <= 1.0 && in[FMU_CARRIER_HZ] > 0.0 &&
          in[FMU_CARRIER_HZ] < nyquist_hz)) {
        return fmu_fail(b, "The carrier is %g V at %g Hz, but it must be within 0 to 1 V, and between 0 "
                       "and %g Hz. Correct carrier_v or carrier_hz.",
                    in[FMU_CARRIER_V], in[FMU_CARRIER_HZ], nyquist_hz);
    }
    if (!isfinite(in[FMU_FORCE_N])) {
        return fmu_fail(b, "force_n is %g N. State a finite force.", in[FMU_FORCE_N]);
    }
    return FMU_OK;
}

/* Samples up to which one call of the twin may go, and the drive's change in them. */
static int32_t next_part(fmu_bench *b, int64_t from, int64_t until, double *after_v,
                         int32_t *switch_at)
{
    fmu_memory *m = b->now;
    int64_t n = until - from < b->about.block_samples ? until - from : b->about.block_samples;
    *after_v = m->drive_v;
    *switch_at = 0;
    if (m->pending > 0 && m->queue[m->first_pending].at < from + n) {
        const fmu_change next = m->queue[m->first_pending];
        m->first_pending = (m->first_pending + 1) % FMU_PENDING;
        --m->pending;
        *after_v = next.drive_v;
        *switch_at = (int32_t)(next.at - from);
        if (m->pending > 0 && m->queue[m->first_pending].at < from + n) {
            n = (m->queue[m->first_pending].at - from) / TWIN_SUB * TWIN_SUB;
        }
    }
    return (int32_t)n;
}

static void set_drive(fmu_bench *b)
{
    fmu_memory *m = b->now;
    if (m->input[FMU_DRIVE_V] != m->set_v) {
        const int64_t at = m->steps * TWIN_SUB + b->delay_samples;
        const int32_t last = (m->first_pending + m->pending - 1) % FMU_PENDING;
        if (m->pending == 0 || m->queue[last].at != at) { /* else no time has passed */
            ++m->pending;
        }
        m->set_v = m->input[FMU_DRIVE_V];
        m->queue[(m->first_pending + m->pending - 1) % FMU_PENDING] = (fmu_change){at, m->set_v};
    }
    if (m->input[FMU_CARRIER_V] != m->carrier_v || m->input[FMU_CARRIER_HZ] != m->carrier_hz) {
        m->carrier_v = m->input[FMU_CARRIER_V];
        m->carrier_hz = m->input[FMU_CARRIER_HZ];
        fmu_set_carrier(b);
        m->fresh = -fmu_settling_samples(b);
    }
}

void fmu_terminate(fmu_bench *b)
{
    b->now->terminated = 1;
}

fmu_status fmu_step(fmu_bench *b, double time_s, double step_s)
{
    fmu_memory *m = b->now;
    const double dt = TWIN_SUB * b->p.sample_s;
    const double end = floor((time_s - m->start_s + step_s) / dt + 0.5);
    fmu_status status;
    int64_t from, until;
    if (!m->initialised) {
        return fmu_fail(b, "A step was made before the initialisation. Initialise the FMU first.");
    }
    if (m->terminated) {
        return fmu_fail(b, "A step was made after the simulation was terminated. Reset it first, or "
                       "restore an earlier state.");
    }
    if (m->failed) {
        return fmu_fail(b, "An earlier step failed. Reset the simulation, or restore an earlier state.");
    }
    if (!(step_s >= 0.0 && isfinite(time_s) && end < 1e15)) {
        return fmu_fail(b, "The step goes from %g s for %g s. State a finite time and a step that is "
                       "not negative.", time_s, step_s);
    }
    if (fabs(time_s - fmu_time(b)) > 0.75 * dt) {
        return fmu_fail(b, "The step begins at %.9g s, but the last one ended at %.9g s. Step from "
                       "there, or restore an earlier state.", time_s, fmu_time(b));
    }
    status = check_inputs(b);
    if (status != FMU_OK) {
        return status;
    }
    set_drive(b);
    from = m->steps * TWIN_SUB;
    until = (int64_t)end * TWIN_SUB;
    if (from < until) {
        m->twin.field_v_m = 0.0;
    }
    while (from < until) {
        double after_v;
        int32_t switch_at, changed; /* samples since the last change */
        const int32_t n = next_part(b, from, until, &after_v, &switch_at);
        const double load_n = b->load_n + m->input[FMU_FORCE_N];
        twin_acquire(&b->p, &m->twin, m->drive_v, after_v, switch_at, load_n, n, b->codes,
                     b->lengths);
        fmu_keep_readings(b, n);
        changed = after_v != m->drive_v ? n - switch_at : TWIN_LONG;
        if (m->twin.since_limited < changed) {
            changed = m->twin.since_limited;
        }
        if (changed < TWIN_LONG) {
            const int64_t fresh = changed - fmu_settling_samples(b);
            m->fresh = fresh < m->fresh ? fresh : m->fresh;
        }
        m->drive_v = after_v;
        from += n;
    }
    m->steps = until / TWIN_SUB > m->steps ? until / TWIN_SUB : m->steps;
    if (m->twin.outside) {
        m->failed = 1;
        return fmu_fail(b, "The actuator left the lengths in which its law is valid, before %.9g s. "
                       "Lower the drive voltage or the load.", fmu_time(b));
    }
    fmu_sense(b);
    return FMU_OK;
}
