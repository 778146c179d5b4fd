/* Takes: latched readings and one event. Gives: enable pin, output code, intermediate values. */
#include "app.h"

void app_init(app_state *state, uint8_t fault)
{
    state->updates = 0;
    state->reference = 0.0f;
    state->drive_v = 0.0f;
    state->silent = 0;
    state->settled = 0;
    state->state = fault == HP_FAULT_NONE ? HP_STATE_OFF : HP_STATE_TRIPPED;
    state->fault = fault;
    state->blind = 0;
    state->slipped = 0;
    state->code = 0;
    state->wrong_output = 0;
}

/* ---- sensing ---- */

static uint8_t is_inside(float x, float low, float high)
{
    return x >= low && x <= high; /* not for NaN */
}

/* The same for positive numbers, whose bits have the same order: a fifth of the cycles. */
static uint8_t is_inside_positive(float x, float low, float high)
{
    union {
        float value;
        uint32_t bits;
    } a, b, c;
    a.value = x;
    b.value = low;
    c.value = high;
    return a.bits >= b.bits && a.bits <= c.bits;
}

static void sense(const app_config *c, const app_inputs *in, app_outputs *out)
{
    const hs_capacitance farad =
        hs_capacitance_of(&c->sensing, hs_demodulate_quadrature(in->v),
                          hs_demodulate_quadrature(in->i));

    out->reason = farad.reason;
    out->capacitance_f = farad.capacitance_f;
    out->strain = 0.0f;
    if (farad.reason != 0) {
        return;
    }
    if (!is_inside_positive(farad.capacitance_f, c->capacitance_low_f,
                            c->capacitance_high_f)) {
        out->reason = HP_REASON_IMPLAUSIBLE;
        return;
    }
    out->strain = hs_strain_from_capacitance(&c->strain, farad.capacitance_f);
}

/* A lost conversion invalidates this update and the next one, whose windows contain it. */
static void judge_readings(app_state *s, const app_inputs *in, app_outputs *out)
{
    if (in->alarms & HP_ALARM_LOST_SAMPLE) {
        s->slipped = 2;
    }
    if (s->slipped > 0) {
        --s->slipped;
        out->reason |= HP_REASON_SLIPPED;
    }
    if (in->alarms & HP_ALARM_RAIL) {
        out->reason |= HP_REASON_CLIPPED;
    }
    if (out->reason == 0) {
        s->blind = 0;
    } else if (s->blind < 255) {
        ++s->blind;
    }
}

/* The high voltage follows the output within one update; a longer deviation is a broken module. */
static void judge_level(const app_config *c, app_state *s, const app_inputs *in)
{
    const uint16_t expected = (uint16_t)(((uint32_t)s->code * c->level_share) >> 16);
    const int16_t off = (int16_t)(in->v[HS_QUADRATURE_SAMPLES / 2] - (int16_t)expected);
    if (off <= c->level_off && off >= -c->level_off) {
        s->wrong_output = 0;
    } else if (s->wrong_output < 255) {
        ++s->wrong_output;
    }
}

uint8_t app_is_ready(const app_config *config, const app_state *state)
{
    return state->state == HP_STATE_ARMED && state->settled >= config->settle_updates &&
           state->blind == 0;
}

/* ---- state machine ---- */

static void trip(app_state *s, uint8_t fault)
{
    s->state = HP_STATE_TRIPPED;
    s->fault = fault;
    s->drive_v = 0.0f;
}

static void start_arming(app_state *s)
{
    s->state = HP_STATE_ARMED;
    s->settled = 0;
    s->silent = 0;
}

static void start_running(const app_config *c, app_state *s, float reference)
{
    hs_controller_init(&c->controller, &s->controller);
    s->updates = 0;
    s->reference = reference;
    s->state = HP_STATE_RUNNING;
}

static void take_event(const app_config *c, app_state *s, const app_inputs *in)
{
    if (in->event != HP_EVENT_NONE) {
        s->silent = 0;
    }
    switch (in->event) {
    case HP_EVENT_ARM:
        if (s->state == HP_STATE_OFF) {
            start_arming(s);
        }
        break;
    case HP_EVENT_RUN:
        if (app_is_ready(c, s) && is_inside(in->reference, c->reference_low, c->reference_high)) {
            start_running(c, s, in->reference);
        }
        break;
    case HP_EVENT_SET_REFERENCE:
        if (is_inside(in->reference, c->reference_low, c->reference_high)) {
            s->reference = in->reference;
        }
        break;
    case HP_EVENT_STOP:
        if (s->state == HP_STATE_ARMED || s->state == HP_STATE_RUNNING) {
            s->state = HP_STATE_STOPPING;
        }
        break;
    case HP_EVENT_CLEAR:
        if (s->state == HP_STATE_TRIPPED) {
            app_init(s, HP_FAULT_NONE);
        }
        break;
    default:
        break;
    }
}

/* Reasons to stop, the most urgent last. Off and tripped do not change. */
static void judge(const app_config *c, app_state *s, const app_inputs *in)
{
    const uint8_t live = s->state != HP_STATE_OFF && s->state != HP_STATE_TRIPPED;
    if (s->state > HP_STATE_TRIPPED) {
        trip(s, HP_FAULT_LOST_STATE);
        return;
    }
    if (!live) {
        return;
    }
    if (s->silent < 65535u) {
        ++s->silent;
    }
    if (s->settled < 65535u) {
        ++s->settled;
    }
    if (s->silent > c->link_updates && s->state != HP_STATE_STOPPING) {
        s->state = HP_STATE_STOPPING;
        s->fault = HP_FAULT_LINK;
    }
    if (s->blind >= c->blind_updates && s->settled > c->settle_updates) {
        trip(s, HP_FAULT_SENSING);
    }
    if (s->wrong_output >= c->wrong_output_updates) {
        trip(s, HP_FAULT_WRONG_OUTPUT);
    }
    if (in->alarms & HP_ALARM_LATE) {
        trip(s, HP_FAULT_LATE);
    }
    if (in->alarms & HP_ALARM_RAIL) {
        trip(s, HP_FAULT_BREAKDOWN);
    }
}

/* ---- output ---- */

static float toward(float from, float to, float most)
{
    const float change = to - from;
    if (change > most) {
        return from + most;
    }
    if (change < -most) {
        return from - most;
    }
    return to;
}

static void close_loop(const app_config *c, app_state *s, app_outputs *out)
{
    const hs_measurement seen = {out->strain, out->capacitance_f, s->drive_v, s->updates++,
                                 out->reason == 0};
    const float u = hs_controller_step(&c->controller, &s->controller, s->reference, &seen);

    if (!seen.valid) {
        return; /* keep the output for up to blind_updates */
    }
    out->corrected = u;
    s->drive_v = toward(s->drive_v, c->in_volts ? u : hs_table_at(&c->voltage, u), c->rise_v);
}

static void ramp_down(const app_config *c, app_state *s)
{
    s->drive_v = toward(s->drive_v, 0.0f, c->ramp_v);
    if (!(s->drive_v > 0.0f)) {
        s->drive_v = 0.0f;
        s->state = s->fault == HP_FAULT_NONE ? HP_STATE_OFF : HP_STATE_TRIPPED;
    }
}

/* The table is within the drive's limits, so anything else, or NaN, is a fault. */
static void put_out(const app_config *c, app_state *s, app_outputs *out)
{
    uint8_t limited;
    if (s->state == HP_STATE_RUNNING || s->state == HP_STATE_STOPPING) {
        s->drive_v = hs_limit(s->drive_v, 0.0f, c->drive_high_v, &limited);
        if (limited) {
            trip(s, HP_FAULT_NOT_FINITE);
        }
    } else {
        s->drive_v = 0.0f;
    }
    out->enable = s->state == HP_STATE_ARMED || s->state == HP_STATE_RUNNING ||
                  s->state == HP_STATE_STOPPING;
    out->code = (uint16_t)(s->drive_v * c->codes_per_v); /* rounded down: never above */
    if (out->code > c->code_high) {
        out->code = c->code_high;
    }
    s->code = out->code;
}

void app_step(const app_config *config, app_state *state, const app_inputs *in, app_outputs *out)
{
    out->corrected = 0.0f;
    sense(config, in, out);
    judge_readings(state, in, out);
    judge_level(config, state, in);
    take_event(config, state, in);
    judge(config, state, in);
    if (state->state == HP_STATE_RUNNING) {
        close_loop(config, state, out);
    } else if (state->state == HP_STATE_STOPPING) {
        ramp_down(config, state);
    }
    put_out(config, state, out);
}
