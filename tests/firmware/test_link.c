/* The link on the host: what is torn, repeated, out of order or out of place changes nothing. */
#include <string.h>

#include "../core/check.h"
#include "link.h"
#include "settings.h"

typedef struct {
    link_state link;
    app_state app;
    app_inputs in;
    uint8_t answer[LINK_FRAME_BYTES];
    uint16_t update;
} bench;

static bench fresh(void)
{
    bench b;
    memset(&b, 0, sizeof b);
    app_init(&b.app, HP_FAULT_NONE);
    link_init(&b.link);
    b.update = 1000;
    return b;
}

/* A command as the computer would frame it. */
static uint8_t make(uint8_t *frame, uint8_t code, uint16_t sequence, const void *payload, uint8_t n)
{
    uint8_t bytes[FRAME_LONGEST];
    bytes[0] = code;
    hp_put_u16(bytes + 1, sequence);
    memcpy(bytes + 3, payload, n);
    return frame_encode(bytes, (uint8_t)(3 + n), frame);
}

/* Feed bytes; the result of the answer, 255 where none came, 254 for an identity. */
static uint8_t feed(bench *b, const uint8_t *bytes, uint8_t n)
{
    uint8_t k, result = 255;
    b->in.event = HP_EVENT_NONE;
    for (k = 0; k < n; ++k) {
        if (link_feed(&b->link, bytes[k])) {
            uint8_t length = link_take(&b->link, &settings, &b->app, b->update, &b->in, b->answer);
            if (length > 0) {
                length = frame_decode(b->answer, (uint8_t)(length - 1));
                CHECK(length > 0, "the answer is no frame: %d", length);
                result = b->answer[0] == HP_ACK ? b->answer[6] : 254;
            }
        }
    }
    return result;
}

static uint8_t ask(bench *b, uint8_t code, uint16_t sequence, const void *payload, uint8_t n)
{
    uint8_t frame[FRAME_LONGEST + 3];
    const uint8_t length = make(frame, code, sequence, payload, n);
    return feed(b, frame, length);
}

static uint8_t hello(bench *b, uint16_t version, uint16_t sequence)
{
    uint8_t payload[2];
    hp_put_u16(payload, version);
    return ask(b, HP_HELLO, sequence, payload, 2);
}

static uint16_t token_of(const bench *b)
{
    return hp_get_u16(b->answer + 3 + 4);
}

static void frames_come_back_whole_and_no_damaged_one_does(void)
{
    uint8_t bytes[FRAME_LONGEST], frame[FRAME_LONGEST + 3], back[FRAME_LONGEST + 3];
    uint32_t seed = 3;
    uint8_t n, k, length;
    for (n = 1; n <= FRAME_LONGEST - 2u; ++n) {
        for (k = 0; k < n; ++k) {
            bytes[k] = (uint8_t)(check_draw(&seed) >> 30 ? check_draw(&seed) >> 24 : 0);
        }
        length = frame_encode(bytes, n, frame);
        CHECK(length == n + 4, "%d of %d", length, n + 4);
        CHECK(memchr(frame, 0, length) == frame + length - 1, "a 0 inside, n = %d", n);
        memcpy(back, frame, length);
        CHECK(frame_decode(back, (uint8_t)(length - 1)) == n, "n = %d", n);
        CHECK(memcmp(back, bytes, n) == 0, "n = %d", n);
        for (k = 0; k + 1 < length; ++k) { /* any one bit: a CRC of 16 bits sees them all */
            memcpy(back, frame, length);
            back[k] ^= (uint8_t)(1u << (check_draw(&seed) >> 29));
            CHECK(frame_decode(back, (uint8_t)(length - 1)) == 0, "n = %d, byte %d", n, k);
        }
        for (k = 0; k + 1 < length; ++k) { /* torn */
            memcpy(back, frame, length);
            CHECK(frame_decode(back, k) == 0, "n = %d, %d bytes of it", n, k);
        }
    }
    CHECK(frame_encode(bytes, FRAME_LONGEST - 1u, frame) == 0, "%d", FRAME_LONGEST);
    CHECK(frame_crc(0xffffu, (const uint8_t *)"123456789", 9) == 0x29b1u, "CRC-16/CCITT-FALSE");
}

static void without_the_right_version_nothing_is_answered_or_done(void)
{
    bench b = fresh();
    CHECK(ask(&b, HP_REQUEST_ARMING, 1, "", 0) == 255, "%d", b.link.connected);
    CHECK(hello(&b, HP_VERSION + 1, 1) == 254 && !b.link.connected, "%d", b.link.connected);
    CHECK(ask(&b, HP_REQUEST_ARMING, 2, "", 0) == 255, "%d", b.link.connected);
    CHECK(hello(&b, HP_VERSION, 1) == 254 && b.link.connected, "%d", b.link.connected);
    CHECK(hp_get_u16(b.answer + 3) == HP_VERSION, "%d", hp_get_u16(b.answer + 3));
    CHECK(ask(&b, HP_REQUEST_ARMING, 2, "", 0) == HP_RESULT_ACCEPTED, "%d", b.link.sequence);
}

static void arming_takes_two_frames_and_their_token_once(void)
{
    bench b = fresh();
    uint8_t payload[2];
    hello(&b, HP_VERSION, 0);
    hp_put_u16(payload, 0);
    CHECK(ask(&b, HP_CONFIRM_ARMING, 1, payload, 2) == HP_RESULT_BAD_TOKEN, "without a request");
    CHECK(ask(&b, HP_REQUEST_ARMING, 2, "", 0) == HP_RESULT_ACCEPTED, "request");
    CHECK(token_of(&b) != 0 && b.in.event == HP_EVENT_NONE, "%d", token_of(&b));
    hp_put_u16(payload, (uint16_t)(token_of(&b) + 1u));
    CHECK(ask(&b, HP_CONFIRM_ARMING, 3, payload, 2) == HP_RESULT_BAD_TOKEN, "wrong token");
    CHECK(b.in.event == HP_EVENT_NONE, "%d", b.in.event);
    hp_put_u16(payload, (uint16_t)((1000u * 40503u) | 1u));
    CHECK(ask(&b, HP_CONFIRM_ARMING, 4, payload, 2) == HP_RESULT_BAD_TOKEN, "second attempt");
    CHECK(ask(&b, HP_REQUEST_ARMING, 5, "", 0) == HP_RESULT_ACCEPTED, "request");
    hp_put_u16(payload, token_of(&b));
    b.link.token_left = 0; /* too late */
    CHECK(ask(&b, HP_CONFIRM_ARMING, 6, payload, 2) == HP_RESULT_BAD_TOKEN, "late");
    CHECK(ask(&b, HP_REQUEST_ARMING, 7, "", 0) == HP_RESULT_ACCEPTED, "request");
    hp_put_u16(payload, token_of(&b));
    CHECK(ask(&b, HP_CONFIRM_ARMING, 8, payload, 2) == HP_RESULT_ACCEPTED, "confirm");
    CHECK(b.in.event == HP_EVENT_ARM, "%d", b.in.event);
}

static void repeated_old_and_distant_frames_are_dropped(void)
{
    const uint16_t dropped[] = {10, 9, 0, 65535u, 27, 1000, 32778u};
    bench b = fresh();
    size_t k;
    hello(&b, HP_VERSION, 9);
    CHECK(ask(&b, HP_KEEP_ALIVE, 10, "", 0) == HP_RESULT_ACCEPTED, "%d", b.link.sequence);
    for (k = 0; k < sizeof dropped / sizeof *dropped; ++k) {
        CHECK(ask(&b, HP_STOP, dropped[k], "", 0) == 255, "%d", dropped[k]);
        CHECK(b.in.event == HP_EVENT_NONE && b.link.sequence == 10, "%d", dropped[k]);
    }
    CHECK(ask(&b, HP_STOP, 26, "", 0) == HP_RESULT_ACCEPTED, "16 ahead");
    CHECK(b.in.event == HP_EVENT_STOP, "%d", b.in.event);
}

static void greeting_does_not_restart_the_count_while_the_output_may_be_on(void)
{
    bench b = fresh();
    hello(&b, HP_VERSION, 9);
    b.app.state = HP_STATE_RUNNING;
    CHECK(hello(&b, HP_VERSION, 0) == 255 && b.link.sequence == 9, "%d", b.link.sequence);
    CHECK(hello(&b, HP_VERSION, 10) == HP_RESULT_BAD_STATE, "in order");
}

static void what_is_outside_the_limits_is_refused(void)
{
    const float values[] = {0.2f, -0.2f, 1e30f};
    bench b = fresh();
    uint8_t payload[4];
    uint16_t sequence = 1;
    size_t k;
    hello(&b, HP_VERSION, 0);
    b.app.state = HP_STATE_RUNNING;
    for (k = 0; k < 3; ++k) {
        hp_put_f32(payload, values[k]);
        CHECK(ask(&b, HP_SET_REFERENCE, sequence++, payload, 4) == HP_RESULT_BAD_VALUE, "%g",
              (double)values[k]);
    }
    hp_put_u32(payload, 0x7fc00000u); /* NaN */
    CHECK(ask(&b, HP_SET_REFERENCE, sequence++, payload, 4) == HP_RESULT_BAD_VALUE, "NaN");
    CHECK(b.in.event == HP_EVENT_NONE, "%d", b.in.event);
    hp_put_f32(payload, 0.02f);
    CHECK(ask(&b, HP_SET_REFERENCE, sequence++, payload, 4) == HP_RESULT_ACCEPTED, "good");
    CHECK(ask(&b, HP_SET_REFERENCE, sequence++, payload, 3) == HP_RESULT_UNKNOWN, "short");
    CHECK(ask(&b, HP_RUN, sequence++, payload, 4) == HP_RESULT_BAD_STATE, "runs already");
    b.app.state = HP_STATE_ARMED;
    CHECK(ask(&b, HP_RUN, sequence++, payload, 4) == HP_RESULT_NOT_READY, "no strain yet");
    CHECK(ask(&b, 200, sequence++, payload, 4) == HP_RESULT_UNKNOWN, "no such command");
    CHECK(ask(&b, HP_CLEAR_FAULT, sequence++, "", 0) == HP_RESULT_BAD_STATE, "not tripped");
}

/* Noise, pieces of frames, floods: nothing is written beside its place (the sanitizers look), and
 * no event comes of it. */
static void garbage_gives_no_event(void)
{
    bench b = fresh();
    uint32_t seed = 11, k;
    hello(&b, HP_VERSION, 0);
    for (k = 0; k < 300000; ++k) {
        const uint8_t byte = (uint8_t)(check_draw(&seed) >> 24);
        feed(&b, &byte, 1);
        CHECK(b.in.event == HP_EVENT_NONE, "byte %u", (unsigned)k);
    }
}

static void status_comes_as_often_as_was_asked(void)
{
    bench b = fresh();
    app_outputs out;
    uint8_t payload[2] = {3, 0};
    int k, frames = 0;
    memset(&out, 0, sizeof out);
    hello(&b, HP_VERSION, 0);
    CHECK(ask(&b, HP_SET_TELEMETRY, 1, payload, 2) == HP_RESULT_ACCEPTED, "every third");
    for (k = 0; k < 30; ++k) {
        frames += link_report(&b.link, &b.app, &b.in, &out, b.update, b.answer) != 0;
    }
    CHECK(frames == 10, "%d", frames);
    payload[1] = 1;
    ask(&b, HP_SET_TELEMETRY, 2, payload, 2);
    k = link_report(&b.link, &b.app, &b.in, &out, b.update, b.answer);
    CHECK(frame_decode(b.answer, (uint8_t)(k - 1)) == 3 + HP_TRACE_SIZE, "%d bytes", k);
    CHECK(b.answer[0] == HP_TRACE, "%d", b.answer[0]);
    payload[1] = 2;
    CHECK(ask(&b, HP_SET_TELEMETRY, 3, payload, 2) == HP_RESULT_BAD_VALUE, "trace = 2");
}

int main(void)
{
    frames_come_back_whole_and_no_damaged_one_does();
    without_the_right_version_nothing_is_answered_or_done();
    arming_takes_two_frames_and_their_token_once();
    repeated_old_and_distant_frames_are_dropped();
    greeting_does_not_restart_the_count_while_the_output_may_be_on();
    what_is_outside_the_limits_is_refused();
    garbage_gives_no_event();
    status_comes_as_often_as_was_asked();
    return check_end();
}
