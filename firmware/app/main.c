/* The firmware: one update per frame of readings. A command takes effect in the next update, so the
 * delay from a reading to its output does not depend on the link's traffic. */
#include "app.h"
#include "board.h"
#include "link.h"
#include "settings.h" /* generated: static const app_config settings */

#define MOST_BYTES 32u /* of the link per update, so that heavy traffic cannot delay the update */
#define FRAME_CYCLES 16000u

static app_state state;
static app_inputs in;
static app_outputs out;
static link_state link;
static uint16_t update;
static uint8_t bytes[LINK_FRAME_BYTES];

static void listen(void)
{
    uint8_t k, byte;
    in.event = HP_EVENT_NONE;
    for (k = 0; k < MOST_BYTES && board_receive(&byte); ++k) {
        if (link_feed(&link, byte)) {
            const uint8_t n = link_take(&link, &settings, &state, update, &in, bytes);
            board_send(bytes, n);
            return; /* one command per update */
        }
    }
}

static void send_report(uint16_t start)
{
    const uint8_t n =
        link_report(&link, &state, &in, &out, update, bytes);
    uint16_t busy;
    board_send(bytes, n);
    busy = board_cycles();
    busy = (uint16_t)(busy >= start ? (unsigned)(busy - start)
                                    : busy + FRAME_CYCLES - start);
    if (busy > link.busy_cycles) {
        link.busy_cycles = busy;
    }
}

int main(void)
{
    app_init(&state, board_init());
    link_init(&link);
    link.supply = board_supply();
    update = board_wait(0, &in);
    for (;;) {
        const uint16_t last = update;
        uint16_t start;
        update = board_wait(last, &in);
        start = board_cycles();
        link.overruns = (uint8_t)(link.overruns + (uint16_t)(update - last) - 1u);
        app_step(&settings, &state, &in, &out);
        board_output(out.code, out.enable);
        board_done(update);
        send_report(start);
        listen();
    }
}
