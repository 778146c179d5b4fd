/* Processing of a reading in the sampling interrupt, without registers. Eight slots make a frame:
 * the first is the level of the high voltage, the other even ones voltage, odd ones current. A
 * timer gives the slot, so a lost conversion cannot shift the phase of the lock-in. Of three frames
 * one is written while two are read. */
#ifndef SAMPLER_H
#define SAMPLER_H

#include "hs.h"
#include "hs_protocol.h"

#define SAMPLER_SLOTS 8u
#define SAMPLER_FRAMES 3u
#define SAMPLER_LATE 4u /* frames without an update before the output is switched off */

typedef struct {
    int16_t code[SAMPLER_FRAMES * SAMPLER_SLOTS];
    uint16_t frames; /* complete */
    uint16_t level;  /* of the last first slot */
    uint8_t taken;   /* of them, the last one that an update completed, modulo 256 */
    uint8_t start;   /* of the frame that is written: 0, 8 or 16 */
    uint8_t slot;    /* of the last reading */
    uint8_t alarms;  /* HP_ALARM_ bits */
} sampler;

/* Returns HP_ALARM_LATE if no update has used the last frames. */
static inline uint8_t sampler_end_frame(sampler *s)
{
    const uint8_t next = (uint8_t)(s->start + SAMPLER_SLOTS);
    s->start = next >= SAMPLER_FRAMES * SAMPLER_SLOTS ? 0 : next;
    ++s->frames;
    return (uint8_t)((uint8_t)(s->frames & 0xffu) - s->taken) >= SAMPLER_LATE ? HP_ALARM_LATE : 0;
}

/* code: of a converter with readings 0 to `highest`. fall: codes of level that may be lost in a
 * frame, five times the largest fall of the output. Nonzero: switch the output off now. */
static inline uint8_t sampler_take(sampler *s, uint8_t slot, uint16_t code, uint16_t highest,
                                   uint16_t fall, uint8_t enabled)
{
    const uint8_t last = s->slot;
    uint8_t alarms = s->alarms, at;
    s->slot = slot;
    if (slot != (uint8_t)((last + 1u) & (SAMPLER_SLOTS - 1u))) {
        alarms |= HP_ALARM_LOST_SAMPLE;
        if (slot <= last && last != SAMPLER_SLOTS - 1u) {
            alarms |= sampler_end_frame(s); /* the last slot itself was lost */
        }
    }
    at = (uint8_t)(s->start + slot);
    if (at < SAMPLER_FRAMES * SAMPLER_SLOTS) { /* safe even if memory was damaged */
        s->code[at] = (int16_t)code;
    }
    if (slot == 0) {
        if (enabled && s->level > code && (uint16_t)(s->level - code) > fall) {
            alarms |= HP_ALARM_RAIL;
        }
        s->level = code;
    } else if (enabled && (uint16_t)(code - 1u) >= highest - 1u) { /* 0 or highest */
        alarms |= HP_ALARM_RAIL;
    }
    if (slot == SAMPLER_SLOTS - 1u) {
        alarms |= sampler_end_frame(s);
    }
    s->alarms = alarms;
    return alarms & (HP_ALARM_RAIL | HP_ALARM_LATE);
}

/* The two complete frames, oldest first, while the frame at `start` is written. */
static inline void sampler_window(const sampler *s, uint8_t start, int16_t v[HS_QUADRATURE_SAMPLES],
                                  int16_t i[HS_QUADRATURE_SAMPLES])
{
    uint8_t at = start, half, k, to = 0;
    for (half = 0; half < 2u; ++half) {
        const int16_t *from;
        at = at >= (SAMPLER_FRAMES - 1u) * SAMPLER_SLOTS ? 0 : (uint8_t)(at + SAMPLER_SLOTS);
        from = s->code + at;
        for (k = 0; k < SAMPLER_SLOTS / 2u; ++k) {
            v[to] = *from++;
            i[to] = *from++;
            ++to;
        }
    }
}

#endif
