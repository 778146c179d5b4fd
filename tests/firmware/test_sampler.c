/* Frames of readings: complete ones only, and a lost conversion never turns the reference. */
#include <string.h>

#include "../core/check.h"
#include "sampler.h"

#define FALL 20u /* codes of level that may be lost in a frame */

static void feed(sampler *s, uint8_t from, uint8_t to, uint16_t base)
{
    uint8_t slot;
    for (slot = from; slot < to; ++slot) {
        sampler_take(s, slot, (uint16_t)(base + slot), 1023, FALL, 1);
    }
}

static sampler fresh(void)
{
    sampler s;
    memset(&s, 0, sizeof s);
    s.slot = SAMPLER_SLOTS - 1u;
    return s;
}

static void a_window_is_the_last_two_frames_oldest_first(void)
{
    sampler s = fresh();
    int16_t v[HS_QUADRATURE_SAMPLES], i[HS_QUADRATURE_SAMPLES];
    uint16_t frame;
    int k;
    for (frame = 0; frame < 7; ++frame) {
        feed(&s, 0, 8, (uint16_t)(100 + 10 * frame));
        s.taken = (uint8_t)s.frames;
        feed(&s, 0, 3, (uint16_t)(105 + 10 * frame)); /* the next one has begun */
        sampler_window(&s, s.start, v, i);
        for (k = 0; k < 4 && frame > 0; ++k) {
            CHECK(v[k] == 90 + 10 * frame + 2 * k, "%d", v[k]);
            CHECK(i[k + 4] == 101 + 10 * frame + 2 * k, "%d", i[k + 4]);
        }
        s.slot = SAMPLER_SLOTS - 1u;
    }
    CHECK(s.alarms == 0, "%d", s.alarms);
}

static void a_lost_conversion_is_told_and_the_next_ones_keep_their_places(void)
{
    uint8_t lost;
    for (lost = 0; lost < SAMPLER_SLOTS; ++lost) {
        sampler s = fresh();
        int16_t v[HS_QUADRATURE_SAMPLES], i[HS_QUADRATURE_SAMPLES];
        feed(&s, 0, 8, 100);
        feed(&s, 0, lost, 200);
        feed(&s, (uint8_t)(lost + 1u), 8, 200);
        feed(&s, 0, 8, 300);
        CHECK(s.alarms == HP_ALARM_LOST_SAMPLE, "slot %d: %d", lost, s.alarms);
        CHECK(s.frames == 3, "slot %d: %d frames", lost, s.frames);
        sampler_window(&s, s.start, v, i);
        CHECK(v[4] == 300 && i[7] == 307, "slot %d: %d %d", lost, v[4], i[7]);
        CHECK(lost == 2 || v[1] == 202, "slot %d: %d", lost, v[1]);
    }
}

static void a_rail_counts_while_enabled_and_asks_for_the_output_at_once(void)
{
    sampler s = fresh();
    CHECK(sampler_take(&s, 0, 0, 1023, FALL, 1) == 0 && s.alarms == 0, "level 0: %d", s.alarms);
    s = fresh();
    CHECK(sampler_take(&s, 0, 1023, 1023, FALL, 0) == 0 && s.alarms == 0, "%d", s.alarms);
    CHECK(sampler_take(&s, 1, 1022, 1023, FALL, 1) == 0 && s.alarms == 0, "%d", s.alarms);
    CHECK(sampler_take(&s, 2, 1, 1023, FALL, 1) == 0 && s.alarms == 0, "%d", s.alarms);
    CHECK(sampler_take(&s, 3, 0, 1023, FALL, 1) != 0 && s.alarms == HP_ALARM_RAIL, "%d", s.alarms);
    s = fresh();
    feed(&s, 0, 1, 500);
    CHECK(sampler_take(&s, 1, 1023, 1023, FALL, 1) != 0, "%d", s.alarms);
    CHECK(s.alarms == HP_ALARM_RAIL, "%d", s.alarms);
}

static void a_level_that_collapses_asks_for_the_output_at_once(void)
{
    sampler s = fresh();
    feed(&s, 0, 1, 300);
    feed(&s, 1, 8, 500);
    CHECK(sampler_take(&s, 0, 300 - FALL, 1023, FALL, 1) == 0, "%d", s.alarms);
    feed(&s, 1, 8, 500);
    CHECK(sampler_take(&s, 0, 900, 1023, FALL, 1) == 0, "%d: a rise", s.alarms);
    feed(&s, 1, 8, 500);
    CHECK(sampler_take(&s, 0, 0, 1023, FALL, 0) == 0, "%d: not enabled", s.alarms);
    s = fresh();
    feed(&s, 0, 1, 300);
    feed(&s, 1, 8, 500);
    CHECK(sampler_take(&s, 0, 299 - FALL, 1023, FALL, 1) != 0, "%d", s.alarms);
}

static void updates_that_stay_away_are_seen_in_the_fourth_frame(void)
{
    sampler s = fresh();
    uint8_t frame;
    for (frame = 0; frame < SAMPLER_LATE; ++frame) {
        CHECK(s.alarms == 0, "frame %d", frame);
        feed(&s, 0, 8, 100);
    }
    CHECK(s.alarms == HP_ALARM_LATE, "%d", s.alarms);
}

static void damaged_memory_does_not_make_it_write_elsewhere(void)
{
    struct {
        sampler s;
        uint8_t guard[512];
    } room;
    uint32_t start;
    for (start = 0; start < 256; ++start) {
        size_t k;
        memset(&room, 0, sizeof room);
        room.s.start = (uint8_t)start;
        feed(&room.s, 0, 8, 100);
        for (k = 0; k < sizeof room.guard; ++k) {
            CHECK(room.guard[k] == 0, "start %u", (unsigned)start);
        }
        CHECK(room.s.start < SAMPLER_FRAMES * SAMPLER_SLOTS, "%d", room.s.start);
    }
}

int main(void)
{
    a_window_is_the_last_two_frames_oldest_first();
    a_lost_conversion_is_told_and_the_next_ones_keep_their_places();
    a_rail_counts_while_enabled_and_asks_for_the_output_at_once();
    a_level_that_collapses_asks_for_the_output_at_once();
    updates_that_stay_away_are_seen_in_the_fourth_frame();
    damaged_memory_does_not_make_it_write_elsewhere();
    return check_end();
}
