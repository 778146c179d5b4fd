/* The controller as one step, the same on every board: readings in, output code out.
 *
 *     readings -> capacitance -> strain -> controller -> voltage table -> rate, clamp -> code
 *
 * inside the state machine off -> armed -> running -> stopping -> off, and tripped. A step is a
 * function of configuration, state and latched inputs; it reads no clock: time is counted in
 * updates. No heap, no recursion, no globals.
 */
#ifndef APP_H
#define APP_H

#include "hs_controller.h"
#include "hs_protocol.h"

/* Not inlined: one stack frame for all functions would be too large for fast access. */
#define APP_APART __attribute__((noinline))

typedef struct {
    hs_quadrature_config sensing; /* scale: siemens per ratio of codes, with the channels' skew */
    float capacitance_low_f, capacitance_high_f; /* calibrated */
    hs_strain_map strain;
    hs_controller_setting controller;
    hs_table voltage;                    /* corrected strain to drive, V */
    uint8_t in_volts;                    /* 1: the controller gives the drive itself */
    float reference_low, reference_high; /* range of the desired strain */
    float drive_high_v;                  /* the lowest is 0 */
    float rise_v;                        /* largest change of the drive in one update, V */
    float ramp_v;                        /* the same when ramping down */
    float codes_per_v;
    uint16_t code_high;      /* of the output converter */
    uint16_t level_share;    /* level codes per output code, times 65536 */
    int16_t level_off;       /* largest deviation of the level, in codes */
    uint16_t link_updates;   /* without a message from the computer, before the ramp */
    uint16_t settle_updates; /* after arming, until the strain must be valid */
    uint16_t token_updates;  /* validity of an arming token */
    uint8_t blind_updates;   /* without a strain, before a trip */
    uint8_t wrong_output_updates;  /* with a wrong level, before a trip */
    uint16_t rate_hz;
    uint32_t crc; /* of the settings, for the handshake */
} app_config;

/* All inputs of an update, latched at one instant. */
typedef struct {
    /* Oldest first; the last four are new. The first reading of a frame does not count for the
     * carrier: in its place v[0] and v[4] are the level, the voltage monitor without a filter. */
    int16_t v[HS_QUADRATURE_SAMPLES], i[HS_QUADRATURE_SAMPLES];
    float reference;                        /* with run and set_reference */
    uint8_t event;                          /* HP_EVENT_ */
    uint8_t alarms;                         /* HP_ALARM_ bits since the last update */
} app_inputs;

typedef struct {
    hs_controller_state controller;
    uint32_t updates; /* since running began */
    float reference;
    float drive_v;
    uint16_t silent;  /* updates since the last message from the computer */
    uint16_t settled; /* updates since arming */
    uint8_t state;    /* HP_STATE_ */
    uint8_t fault;    /* HP_FAULT_ */
    uint8_t blind;    /* updates in a row without a strain */
    uint16_t code;    /* of the last update */
    uint8_t wrong_output;   /* updates in a row with a wrong level */
    uint8_t slipped;  /* updates whose window contains a lost conversion */
} app_state;

typedef struct {
    float capacitance_f, strain, corrected;
    uint16_t code;
    uint8_t reason; /* HP_REASON_ bits, 0: the strain is valid */
    uint8_t enable; /* of the high-voltage module */
} app_outputs;

/* fault: HP_FAULT_NONE starts in off, any other one in tripped. */
void app_init(app_state *state, uint8_t fault);

/* One update; the budget on the ATmega2560 is 9,600 cycles with all interrupts. */
APP_APART void app_step(const app_config *config, app_state *state, const app_inputs *in,
                        app_outputs *out);

/* The strain is valid now, and running may begin. */
uint8_t app_is_ready(const app_config *config, const app_state *state);

#endif
