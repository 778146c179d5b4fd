/* The state machine and what stands between a number and the output. */
#include <math.h>
#include <string.h>

#include "../core/check.h"
#include "app.h"
#include "settings.h"

/* Readings of a capacitor that the settings take for a strain near `wanted`: amplitudes are found by
 * trying, as a bench would. */
static void readings(app_inputs *in, float share)
{
    /* Both carriers about 512; the current leads by 90 degrees and is seen 225 degrees later. */
    const double v = 290.0, i = 190.0 * (double)share;
    int k;
    for (k = 0; k < HS_QUADRATURE_SAMPLES; ++k) {
        const double angle = 1.5707963267948966 * k;
        in->v[k] = (int16_t)lrint(512.0 + v * cos(angle));
        in->i[k] = (int16_t)lrint(512.0 + i * cos(angle + 1.5707963267948966 + 3.9269908169872414));
    }
    in->event = HP_EVENT_NONE;
    in->alarms = 0;
    in->reference = 0.0f;
}

static int16_t level_of(uint16_t code)
{
    return (int16_t)((double)code * settings.level_share / 65536.0);
}

/* An update of a module that follows. */
static app_outputs step(app_state *s, const app_inputs *in)
{
    app_inputs follows = *in;
    app_outputs out;
    follows.v[4] = level_of(s->code);
    app_step(&settings, s, &follows, &out);
    return out;
}

static app_outputs step_with(app_state *s, app_inputs *in, uint8_t event, float reference)
{
    app_outputs out;
    in->event = event;
    in->reference = reference;
    out = step(s, in);
    in->event = HP_EVENT_NONE;
    return out;
}

/* A loop that is closed, with valid readings in *in. */
static void run(app_state *s, app_inputs *in)
{
    int k;
    app_init(s, HP_FAULT_NONE);
    readings(in, 1.0f);
    step_with(s, in, HP_EVENT_ARM, 0.0f);
    for (k = 0; k < 60; ++k) {
        step_with(s, in, HP_EVENT_ALIVE, 0.0f);
    }
    step_with(s, in, HP_EVENT_RUN, 0.02f);
    CHECK(s->state == HP_STATE_RUNNING, "%d", s->state);
    for (k = 0; k < 100; ++k) {
        step_with(s, in, HP_EVENT_ALIVE, 0.0f);
    }
}

static void it_starts_disarmed_and_no_other_event_arms_it(void)
{
    app_state s;
    app_inputs in;
    uint8_t event;
    app_init(&s, HP_FAULT_NONE);
    readings(&in, 1.0f);
    for (event = 0; event < 20; ++event) {
        if (event != HP_EVENT_ARM) {
            const app_outputs out = step_with(&s, &in, event, 0.05f);
            CHECK(s.state == HP_STATE_OFF && !out.enable && out.code == 0, "event %d", event);
        }
    }
}

static void armed_means_enabled_at_zero_and_running_waits_for_a_strain(void)
{
    app_state s;
    app_inputs in;
    app_outputs out;
    int k;
    app_init(&s, HP_FAULT_NONE);
    readings(&in, 1.0f);
    out = step_with(&s, &in, HP_EVENT_ARM, 0.0f);
    CHECK(s.state == HP_STATE_ARMED && out.enable && out.code == 0, "%d", s.state);
    step_with(&s, &in, HP_EVENT_RUN, 0.02f); /* too early */
    CHECK(s.state == HP_STATE_ARMED && !app_is_ready(&settings, &s), "%d", s.state);
    for (k = 0; k < 60; ++k) {
        out = step(&s, &in);
        CHECK(out.code == 0 && out.reason == 0, "%d, %d", out.code, out.reason);
    }
    CHECK(app_is_ready(&settings, &s), "%d", s.settled);
    step_with(&s, &in, HP_EVENT_RUN, NAN);
    step_with(&s, &in, HP_EVENT_RUN, 0.5f); /* beyond what was compiled in */
    CHECK(s.state == HP_STATE_ARMED, "%d", s.state);
    step_with(&s, &in, HP_EVENT_RUN, 0.02f);
    CHECK(s.state == HP_STATE_RUNNING, "%d", s.state);
}

static void the_output_rises_no_faster_than_its_rate_and_stays_below_its_clamps(void)
{
    app_state s;
    app_inputs in;
    app_outputs out;
    float before;
    int k;
    run(&s, &in);
    s.reference = settings.reference_high;
    for (k = 0; k < 3000; ++k) {
        before = s.drive_v;
        out = step_with(&s, &in, HP_EVENT_ALIVE, 0.0f);
        CHECK(s.drive_v - before <= settings.rise_v * 1.001f, "%g", (double)(s.drive_v - before));
        CHECK(s.drive_v <= settings.drive_high_v, "%g", (double)s.drive_v);
        CHECK(out.code <= settings.code_high, "%d", out.code);
        CHECK(out.corrected <= settings.controller.u_high, "%g", (double)out.corrected);
    }
    CHECK(out.corrected == settings.controller.u_high, "%g: wound up", (double)out.corrected);
}

static void what_is_no_number_or_too_large_ends_at_zero(void)
{
    const float bad[] = {NAN, INFINITY, -INFINITY, 1e30f, 2.5f};
    size_t k;
    for (k = 0; k < sizeof bad / sizeof *bad; ++k) {
        app_state s;
        app_inputs in;
        app_outputs out;
        run(&s, &in);
        s.drive_v = bad[k];
        out = step(&s, &in);
        if (s.state == HP_STATE_TRIPPED) {
            CHECK(s.fault == HP_FAULT_NOT_FINITE && out.code == 0, "%u: %d", (unsigned)k, s.fault);
        } else { /* the rate limit brought it back at once */
            CHECK(out.code <= settings.code_high, "%u: %d", (unsigned)k, out.code);
        }
        run(&s, &in);
        s.controller.pid.integral = bad[k];
        out = step(&s, &in);
        CHECK(out.code <= settings.code_high, "%u: %d", (unsigned)k, out.code);
        CHECK(s.drive_v >= 0.0f && s.drive_v <= settings.drive_high_v, "%g", (double)s.drive_v);
    }
}

static void lost_sensing_holds_the_output_for_its_patience_and_then_trips(void)
{
    app_state s;
    app_inputs in, dark;
    app_outputs out;
    uint16_t held;
    uint8_t k;
    run(&s, &in);
    readings(&dark, 0.0f);
    held = step(&s, &in).code;
    CHECK(held > 0, "%d", held);
    for (k = 1; k < settings.blind_updates; ++k) {
        out = step(&s, &dark);
        CHECK(out.code == held && out.reason == HP_REASON_AMPLITUDE_LOST, "%d of %d", out.code, held);
    }
    out = step(&s, &dark);
    CHECK(s.fault == HP_FAULT_SENSING && !out.enable && out.code == 0, "%d", s.fault);
}

static void a_phase_of_no_capacitor_and_a_capacitance_of_no_strain_do_not_count(void)
{
    app_state s;
    app_inputs in;
    int16_t swap[HS_QUADRATURE_SAMPLES];
    run(&s, &in);
    readings(&in, 5.0f);
    CHECK(step(&s, &in).reason == HP_REASON_IMPLAUSIBLE, "too large");
    readings(&in, 0.5f);
    CHECK(step(&s, &in).reason == HP_REASON_IMPLAUSIBLE, "too small");
    run(&s, &in);
    memcpy(swap, in.v, sizeof swap);
    memcpy(in.v, in.i, sizeof swap);
    memcpy(in.i, swap, sizeof swap);
    CHECK(step(&s, &in).reason & (HP_REASON_PHASE_OUT | HP_REASON_AMPLITUDE_LOST), "swapped");
    run(&s, &in);
    memcpy(in.i, in.v, sizeof swap); /* 225 degrees off: a reference that slipped by a slot */
    CHECK(step(&s, &in).reason != 0, "slipped");
}

static void a_lost_conversion_spoils_two_updates_and_no_third(void)
{
    app_state s;
    app_inputs in;
    run(&s, &in);
    in.alarms = HP_ALARM_LOST_SAMPLE;
    CHECK(step(&s, &in).reason == HP_REASON_SLIPPED, "first");
    in.alarms = 0;
    CHECK(step(&s, &in).reason == HP_REASON_SLIPPED, "second");
    CHECK(step(&s, &in).reason == 0, "third");
    CHECK(s.state == HP_STATE_RUNNING, "%d", s.state);
}

static void silence_ramps_down_within_200_ms_and_then_trips(void)
{
    app_state s;
    app_inputs in;
    float before, down = 0.0f;
    int k, begun = 0;
    run(&s, &in);
    for (k = 1; k < 2000 && s.state != HP_STATE_TRIPPED; ++k) {
        before = s.drive_v;
        step(&s, &in);
        if (!begun && s.state == HP_STATE_STOPPING) {
            begun = k;
        }
        if (begun && before - s.drive_v > down) {
            down = before - s.drive_v;
        }
    }
    CHECK(begun > 0 && begun <= 200, "after %d updates", begun);
    CHECK(down <= settings.ramp_v * 1.001f, "%g V in an update", (double)down);
    CHECK(s.fault == HP_FAULT_LINK && s.state == HP_STATE_TRIPPED, "%d %d", s.fault, s.state);
    step_with(&s, &in, HP_EVENT_ALIVE, 0.0f);
    CHECK(s.state == HP_STATE_TRIPPED, "%d: it came back by itself", s.state);
}

static void a_sign_of_life_during_the_ramp_does_not_stop_it(void)
{
    app_state s;
    app_inputs in;
    int k;
    run(&s, &in);
    for (k = 0; k < 200; ++k) {
        step(&s, &in);
    }
    CHECK(s.state == HP_STATE_STOPPING, "%d", s.state);
    for (k = 0; k < 1000; ++k) {
        step_with(&s, &in, HP_EVENT_SET_REFERENCE, 0.02f);
    }
    CHECK(s.state == HP_STATE_TRIPPED && s.fault == HP_FAULT_LINK, "%d %d", s.state, s.fault);
}

static void stop_ramps_down_to_off(void)
{
    app_state s;
    app_inputs in;
    app_outputs out;
    int k;
    run(&s, &in);
    out = step_with(&s, &in, HP_EVENT_STOP, 0.0f);
    CHECK(s.state == HP_STATE_STOPPING && out.code > 0, "%d", s.state);
    for (k = 0; k < 1000; ++k) {
        out = step(&s, &in);
    }
    CHECK(s.state == HP_STATE_OFF && !out.enable && out.code == 0, "%d", s.state);
    CHECK(s.fault == HP_FAULT_NONE, "%d", s.fault);
}

static void alarms_of_the_interrupt_trip_and_stay(uint8_t alarm, uint8_t fault)
{
    app_state s;
    app_inputs in;
    app_outputs out;
    uint8_t event;
    run(&s, &in);
    in.alarms = alarm;
    out = step(&s, &in);
    in.alarms = 0;
    CHECK(s.state == HP_STATE_TRIPPED && s.fault == fault, "%d %d", s.state, s.fault);
    CHECK(!out.enable && out.code == 0, "%d", out.code);
    for (event = 0; event < 20; ++event) {
        if (event != HP_EVENT_CLEAR) {
            out = step_with(&s, &in, event, 0.02f);
            CHECK(s.state == HP_STATE_TRIPPED && !out.enable && !out.code, "event %d", event);
        }
    }
    step_with(&s, &in, HP_EVENT_CLEAR, 0.0f);
    CHECK(s.state == HP_STATE_OFF && s.fault == HP_FAULT_NONE, "%d %d", s.state, s.fault);
}

static void a_module_that_does_not_follow_trips(int16_t off, uint8_t trips)
{
    app_state s;
    app_inputs in;
    app_outputs out;
    int k;
    run(&s, &in);
    for (k = 0; k < 100; ++k) {
        in.event = HP_EVENT_ALIVE;
        in.v[4] = (int16_t)(level_of(s.code) + off);
        app_step(&settings, &s, &in, &out);
        CHECK(k >= settings.wrong_output_updates - 1 || s.state == HP_STATE_RUNNING, "update %d", k);
    }
    CHECK((s.fault == HP_FAULT_WRONG_OUTPUT) == trips, "%d codes off: %d", off, s.fault);
    CHECK(!trips || (!out.enable && out.code == 0), "%d", out.code);
}

/* Whatever comes in, in whatever order: no output while off or tripped, never above the clamp. */
static void nothing_puts_the_output_above_its_clamp(void)
{
    app_state s;
    app_inputs in;
    uint32_t seed = 5, k;
    app_init(&s, HP_FAULT_NONE);
    readings(&in, 1.0f);
    for (k = 0; k < 200000; ++k) {
        const uint32_t dice = check_draw(&seed) >> 16;
        app_outputs out;
        uint8_t n;
        in.event = dice % 7u == 0 ? (uint8_t)(check_draw(&seed) >> 28) : HP_EVENT_NONE;
        in.alarms = dice % 997u == 0 ? (uint8_t)(check_draw(&seed) >> 29) : 0;
        in.reference = check_uniform(&seed, -0.1f, 0.2f);
        if (dice % 50u == 0) {
            readings(&in, check_uniform(&seed, 0.5f, 2.5f));
        }
        if (dice % 5000u == 0) { /* memory is damaged */
            n = (uint8_t)((check_draw(&seed) >> 16) % sizeof s);
            ((uint8_t *)&s)[n] ^= (uint8_t)(1u << (check_draw(&seed) >> 29));
        }
        out = step(&s, &in);
        CHECK(out.code <= settings.code_high, "%d", out.code);
        CHECK(out.enable || out.code == 0, "code %d without the enable pin", out.code);
        CHECK(s.state != HP_STATE_ARMED || out.code == 0, "code %d while armed", out.code);
    }
}

int main(void)
{
    it_starts_disarmed_and_no_other_event_arms_it();
    armed_means_enabled_at_zero_and_running_waits_for_a_strain();
    the_output_rises_no_faster_than_its_rate_and_stays_below_its_clamps();
    what_is_no_number_or_too_large_ends_at_zero();
    lost_sensing_holds_the_output_for_its_patience_and_then_trips();
    a_phase_of_no_capacitor_and_a_capacitance_of_no_strain_do_not_count();
    a_lost_conversion_spoils_two_updates_and_no_third();
    silence_ramps_down_within_200_ms_and_then_trips();
    a_sign_of_life_during_the_ramp_does_not_stop_it();
    stop_ramps_down_to_off();
    alarms_of_the_interrupt_trip_and_stay(HP_ALARM_RAIL, HP_FAULT_BREAKDOWN);
    alarms_of_the_interrupt_trip_and_stay(HP_ALARM_LATE, HP_FAULT_LATE);
    a_module_that_does_not_follow_trips(0, 0);
    a_module_that_does_not_follow_trips((int16_t)(settings.level_off - 1), 0);
    a_module_that_does_not_follow_trips((int16_t)(settings.level_off + 1), 1);
    a_module_that_does_not_follow_trips((int16_t)(-settings.level_off - 2), 1);
    nothing_puts_the_output_above_its_clamp();
    return check_end();
}
