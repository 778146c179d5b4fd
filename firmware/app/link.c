/* Takes: received bytes and results of updates. Gives: events and frames. */
#include "link.h"

#define HEADER 3u /* code, sequence */

void link_init(link_state *link)
{
    link->count = 0;
    link->connected = 0;
    link->every = 10;
    link->trace = 0;
    link->until_status = 10;
    link->bad_frames = 0;
    link->sequence = 0;
    link->sent = 0;
    link->token = 0;
    link->token_left = 0;
    link->busy_cycles = 0;
    link->overruns = 0;
    link->supply = 0;
}

uint8_t link_feed(link_state *link, uint8_t byte)
{
    if (byte != 0) {
        if (link->count < LINK_COMMAND_BYTES) {
            link->bytes[link->count] = byte;
        }
        if (link->count <= LINK_COMMAND_BYTES) {
            ++link->count;
        }
        return 0;
    }
    if (link->count > 0 && link->count <= LINK_COMMAND_BYTES) {
        link->count = frame_decode(link->bytes, link->count);
        if (link->count >= HEADER) {
            return 1;
        }
        ++link->bad_frames;
    } else if (link->count > 0) {
        ++link->bad_frames;
    }
    link->count = 0;
    return 0;
}

static uint8_t finish(link_state *link, uint8_t *bytes, uint8_t code, uint8_t size, uint8_t *frame)
{
    bytes[0] = code;
    hp_put_u16(bytes + 1, link->sent++);
    return frame_encode(bytes, (uint8_t)(HEADER + size), frame);
}

/* ---- commands ---- */

static uint8_t is_off(const app_state *s)
{
    return s->state == HP_STATE_OFF || s->state == HP_STATE_TRIPPED;
}

static uint8_t has_size(const link_state *link, uint8_t size)
{
    return link->count == HEADER + size;
}

static uint8_t request(link_state *link, const app_config *c, const app_state *s, uint16_t update)
{
    if (!link->connected) {
        return HP_RESULT_BAD_VERSION;
    }
    if (s->state != HP_STATE_OFF) {
        return HP_RESULT_BAD_STATE;
    }
    /* A different number each time, never 0, so that a repeated frame does not contain it. */
    link->token = (uint16_t)((update * 40503u) | 1u);
    link->token_left = c->token_updates;
    return HP_RESULT_ACCEPTED;
}

static uint8_t confirm(link_state *link, const app_state *s, app_inputs *in)
{
    hp_confirm_arming m;
    const uint16_t token = link->token;
    hp_get_confirm_arming(link->bytes + HEADER, &m);
    link->token = 0; /* one attempt */
    if (s->state != HP_STATE_OFF) {
        return HP_RESULT_BAD_STATE;
    }
    if (token == 0 || link->token_left == 0 || m.token != token) {
        return HP_RESULT_BAD_TOKEN;
    }
    in->event = HP_EVENT_ARM;
    return HP_RESULT_ACCEPTED;
}

static uint8_t drive(link_state *link, const app_config *c, const app_state *s, app_inputs *in)
{
    const uint8_t runs = link->bytes[0] == HP_RUN;
    hp_run m; /* set_reference has the same fields */
    hp_get_run(link->bytes + HEADER, &m);
    if (s->state != (runs ? HP_STATE_ARMED : HP_STATE_RUNNING)) {
        return HP_RESULT_BAD_STATE;
    }
    if (!(m.reference >= c->reference_low && m.reference <= c->reference_high)) {
        return HP_RESULT_BAD_VALUE;
    }
    if (runs && !app_is_ready(c, s)) {
        return HP_RESULT_NOT_READY;
    }
    in->reference = m.reference;
    in->event = runs ? HP_EVENT_RUN : HP_EVENT_SET_REFERENCE;
    return HP_RESULT_ACCEPTED;
}

static uint8_t set_telemetry(link_state *link)
{
    hp_set_telemetry m;
    hp_get_set_telemetry(link->bytes + HEADER, &m);
    if (m.trace > 1) {
        return HP_RESULT_BAD_VALUE;
    }
    link->every = m.every;
    link->trace = m.trace;
    link->until_status = m.every;
    return HP_RESULT_ACCEPTED;
}

static uint8_t obey(link_state *link, const app_config *c, const app_state *s, uint16_t update,
                    app_inputs *in)
{
    switch (link->bytes[0]) {
    case HP_HELLO:
        return HP_RESULT_BAD_STATE;
    case HP_REQUEST_ARMING:
        return has_size(link, 0) ? request(link, c, s, update) : HP_RESULT_UNKNOWN;
    case HP_CONFIRM_ARMING:
        return has_size(link, HP_CONFIRM_ARMING_SIZE) ? confirm(link, s, in) : HP_RESULT_UNKNOWN;
    case HP_RUN:
    case HP_SET_REFERENCE:
        return has_size(link, HP_RUN_SIZE) ? drive(link, c, s, in) : HP_RESULT_UNKNOWN;
    case HP_SET_TELEMETRY:
        return has_size(link, HP_SET_TELEMETRY_SIZE) ? set_telemetry(link) : HP_RESULT_UNKNOWN;
    case HP_KEEP_ALIVE:
        in->event = has_size(link, 0) ? HP_EVENT_ALIVE : HP_EVENT_NONE;
        break;
    case HP_STOP:
        in->event = has_size(link, 0) ? HP_EVENT_STOP : HP_EVENT_NONE;
        break;
    case HP_CLEAR_FAULT:
        if (s->state != HP_STATE_TRIPPED) {
            return HP_RESULT_BAD_STATE;
        }
        in->event = has_size(link, 0) ? HP_EVENT_CLEAR : HP_EVENT_NONE;
        break;
    default:
        return HP_RESULT_UNKNOWN;
    }
    return in->event == HP_EVENT_NONE ? HP_RESULT_UNKNOWN : HP_RESULT_ACCEPTED;
}

static uint8_t connect_link(link_state *link, const app_config *c, uint16_t sequence, uint8_t *frame)
{
    uint8_t bytes[HEADER + HP_IDENTITY_SIZE + 2u];
    const hp_identity identity = {HP_VERSION, c->crc, c->rate_hz, link->supply};
    hp_hello m;
    hp_get_hello(link->bytes + HEADER, &m);
    link->connected = m.version == HP_VERSION;
    link->sequence = sequence;
    hp_put_identity(bytes + HEADER, &identity);
    return finish(link, bytes, HP_IDENTITY, HP_IDENTITY_SIZE, frame);
}

uint8_t link_take(link_state *link, const app_config *config, const app_state *state,
                  uint16_t update, app_inputs *in, uint8_t *frame)
{
    const uint16_t sequence = hp_get_u16(link->bytes + 1);
    const uint16_t ahead = (uint16_t)(sequence - link->sequence);
    uint8_t bytes[HEADER + HP_ACK_SIZE + 2u];
    hp_ack ack;
    uint8_t length = 0;

    if (link->bytes[0] == HP_HELLO && has_size(link, HP_HELLO_SIZE) && is_off(state)) {
        length = connect_link(link, config, sequence, frame);
    } else if (link->connected && ahead >= 1u && ahead <= LINK_AHEAD) {
        link->sequence = sequence;
        ack.command = link->bytes[0];
        ack.answered = sequence;
        ack.result = obey(link, config, state, update, in);
        ack.token = ack.command == HP_REQUEST_ARMING ? link->token : 0;
        hp_put_ack(bytes + HEADER, &ack);
        length = finish(link, bytes, HP_ACK, HP_ACK_SIZE, frame);
    }
    link->count = 0;
    return length;
}

/* ---- telemetry ---- */

static APP_APART uint8_t report_trace(link_state *link, const app_state *state,
                                      const app_inputs *in, const app_outputs *out,
                                      uint16_t update, uint8_t *frame)
{
    uint8_t bytes[HEADER + HP_TRACE_SIZE + 2u];
    hp_trace m;
    uint8_t k;
    m.update = update;
    for (k = 0; k < 8; ++k) { /* the new readings of the window, in the order of conversion */
        const uint8_t at = (uint8_t)(HS_QUADRATURE_SAMPLES / 2u + k / 2u);
        if (k % 2u) {
            m.codes[k] = in->i[at];
        } else {
            m.codes[k] = in->v[at];
        }
    }
    m.event = in->event;
    m.alarms = in->alarms;
    m.state = state->state;
    m.reference = state->reference;
    m.strain = out->strain;
    m.corrected = out->corrected;
    m.code = out->code;
    hp_put_trace(bytes + HEADER, &m);
    return finish(link, bytes, HP_TRACE, HP_TRACE_SIZE, frame);
}

static APP_APART uint8_t report_status(link_state *link, const app_state *state,
                                       const app_outputs *out, uint16_t update, uint8_t *frame)
{
    uint8_t bytes[HEADER + HP_STATUS_SIZE + 2u];
    hp_status m;
    m.update = update;
    m.state = state->state;
    m.fault = state->fault;
    m.reason = out->reason;
    m.strain = out->strain;
    m.capacitance_f = out->capacitance_f;
    m.code = out->code;
    m.busy_cycles = link->busy_cycles;
    m.overruns = link->overruns;
    m.bad_frames = link->bad_frames;
    link->busy_cycles = 0;
    hp_put_status(bytes + HEADER, &m);
    return finish(link, bytes, HP_STATUS, HP_STATUS_SIZE, frame);
}

uint8_t link_report(link_state *link, const app_state *state, const app_inputs *in,
                    const app_outputs *out, uint16_t update, uint8_t *frame)
{
    if (link->token_left > 0) {
        --link->token_left;
    }
    if (link->trace) {
        return report_trace(link, state, in, out, update, frame);
    }
    if (link->every == 0 || --link->until_status > 0) {
        return 0;
    }
    link->until_status = link->every;
    return report_status(link, state, out, update, frame);
}
