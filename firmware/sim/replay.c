/* SPDX-License-Identifier: BSD-3-Clause
 *
 * Replays the microcontroller's updates on this machine: app_step with latched inputs.
 *
 * Input, one line per update: 8 codes (V I V I ...), event, alarms, bits of the reference in hex.
 * Output, one line each: state, fault, reason, code, enable, and the bits of strain, corrected
 * strain and drive in hex.
 */
#include <inttypes.h>
#include <stdint.h>
#include <stdio.h>

#include "app.h"
#include "hs_motion_step.h" /* bits_of */
#include "settings.h"

static int read_update(app_inputs *in)
{
    union {
        uint32_t bits;
        float value;
    } reference;
    unsigned event, alarms;
    int k;
    for (k = 0; k < 4; ++k) {
        int v, i;
        in->v[k] = in->v[k + 4];
        in->i[k] = in->i[k + 4];
        if (scanf("%d %d", &v, &i) != 2) {
            return 0;
        }
        in->v[k + 4] = (int16_t)v;
        in->i[k + 4] = (int16_t)i;
    }
    if (scanf("%u %u %" SCNx32, &event, &alarms, &reference.bits) != 3) {
        return 0;
    }
    in->event = (uint8_t)event;
    in->alarms = (uint8_t)alarms;
    in->reference = reference.value;
    return 1;
}

int main(void)
{
    static app_inputs in;
    static app_outputs out;
    static app_state state;
    app_init(&state, HP_FAULT_NONE);
    while (read_update(&in)) {
        app_step(&settings, &state, &in, &out);
        printf("%u %u %u %u %u", state.state, state.fault, out.reason, out.code, out.enable);
        printf(" %08" PRIx32 " %08" PRIx32 " %08" PRIx32 "\n", bits_of(out.strain),
               bits_of(out.corrected), bits_of(state.drive_v));
    }
    return 0;
}
