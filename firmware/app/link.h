/* The link to the computer: frames to events, results to frames. Checked outside of all interrupts;
 * a damaged, repeated or out-of-order frame has no effect. */
#ifndef LINK_H
#define LINK_H

#include "app.h"
#include "frame.h"

#define LINK_COMMAND_BYTES (HP_LONGEST_COMMAND + 3u + 2u + 1u)     /* header, CRC, COBS */
#define LINK_FRAME_BYTES (HP_LONGEST_TELEMETRY + 3u + 2u + 1u + 1u) /* and the 0 */
#define LINK_AHEAD 16u /* frames that may have been lost between two commands */

typedef struct {
    uint8_t bytes[LINK_COMMAND_BYTES]; /* of the frame being received */
    uint8_t count;                     /* of bytes; beyond the array: too long, wait for the 0 */
    uint8_t connected;                   /* the computer uses this version */
    uint8_t every, trace;              /* telemetry */
    uint8_t until_status;
    uint8_t bad_frames;
    uint16_t sequence;     /* of the last command */
    uint16_t sent;         /* telemetry frames */
    uint16_t token;        /* 0: none */
    uint16_t token_left;   /* updates for which it is valid */
    uint16_t busy_cycles;  /* longest since the last status */
    uint8_t overruns;
    uint16_t supply; /* of board_supply */
} link_state;

void link_init(link_state *link);

/* Receive one byte. Returns 1 when it ends a command; then call link_take. */
uint8_t link_feed(link_state *link, uint8_t byte);

/* The command that link_feed ended: event and reference for the coming update. Returns the bytes
 * of the reply in frame (LINK_FRAME_BYTES long), 0 for none. */
APP_APART uint8_t link_take(link_state *link, const app_config *config, const app_state *state,
                            uint16_t update, app_inputs *in, uint8_t *frame);

/* Telemetry that is due after an update; as link_take. */
APP_APART uint8_t link_report(link_state *link, const app_state *state, const app_inputs *in,
                              const app_outputs *out, uint16_t update, uint8_t *frame);

#endif
