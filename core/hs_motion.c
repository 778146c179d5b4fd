/* Takes: an acceleration, a reference. Gives: the drive for it, the motion that leads there. */
#include "hs_motion_step.h"

/* Roots of 1, 1 + 1/16, ... 4 in Q15. */
static const uint16_t ROOT[49] = {
    32768u, 33776u, 34756u, 35708u, 36636u, 37540u, 38424u, 39287u, 40132u, 40960u,
    41771u, 42567u, 43348u, 44115u, 44869u, 45611u, 46341u, 47059u, 47767u, 48465u,
    49152u, 49830u, 50499u, 51159u, 51811u, 52454u, 53090u, 53719u, 54340u, 54954u,
    55561u, 56162u, 56756u, 57344u, 57926u, 58503u, 59073u, 59639u, 60199u, 60753u,
    61303u, 61848u, 62388u, 62924u, 63455u, 63982u, 64504u, 65022u, 65535u,
};

uint16_t hs_motion_root(uint32_t w, uint8_t *shift)
{
    uint8_t n = 0, k;
    uint16_t low, more;
    *shift = 0;
    if (w == 0) {
        return 0;
    }
    if (w < 0x10000u) {
        w <<= 16;
        n = 8;
    }
    if (w < 0x1000000u) {
        w <<= 8;
        n = (uint8_t)(n + 4);
    }
    while (w < 0x40000000u) {
        w <<= 2;
        ++n;
    }
    k = (uint8_t)((uint8_t)(w >> 26) - 16u);
    low = ROOT[k];
    more = (uint16_t)(ROOT[k + 1] - low);
    *shift = n;
    return (uint16_t)(low + (uint16_t)(((uint32_t)more * (uint16_t)((w << 6) >> 16)) >> 16));
}

int32_t hs_motion_x(const hs_motion_config *config, float strain)
{
    const float x = (strain - config->low) * config->per_strain;
    const uint32_t bits = bits_of(x);
    if ((bits & 0x7fffffffu) >= 0x4ea00000u) { /* 1.25 ONE or more, or NaN */
        return bits >> 31 ? -ONE / 4 : ONE / 4 * 5;
    }
    return kept((int32_t)x);
}

int16_t hs_motion_drive(const hs_motion_config *config, float voltage_v)
{
    const float drive = voltage_v * config->per_volt + 0.5f;
    if (!(drive > 0.0f)) {
        return 0;
    }
    return (int16_t)(drive < (float)FULL ? (int32_t)drive : FULL);
}

/* ---- wanted motion ------------------------------------------------------------------------ */

void hs_motion_begin(const hs_motion_config *config, hs_motion_state *state, int32_t x,
                     float voltage_v)
{
    const int32_t rest = rest_at(config, place_of(x));
    uint8_t k;
    state->wanted.next_x = state->wanted.target = state->wanted.asked = x;
    state->wanted.next_v = 0;
    state->wanted.reference = 3.0e38f;
    for (k = 0; k < HS_MOTION_MOVES; ++k) {
        state->wanted.move[k].step = 0;
    }
    for (k = 0; k < HS_MOTION_BRANCHES; ++k) {
        state->creep[k] = k < config->branches ? 2 * scaled(rest, config->branch_share[k]) : 0;
    }
    state->drive = hs_motion_drive(config, voltage_v);
    state->updates = 0;
    state->started = 1;
}

static uint16_t between(uint16_t low, uint16_t high, uint16_t share)
{
    return low < high ? (uint16_t)(low + (uint16_t)(((uint32_t)(high - low) * share) >> 16))
                      : (uint16_t)(low - (uint16_t)(((uint32_t)(low - high) * share) >> 16));
}

/* Step of the phase from one length to another: 2^16 over the updates that it takes. */
static uint16_t step_of(const hs_motion_config *c, int32_t from, int32_t to)
{
    const uint8_t up = to > from;
    const int32_t apart = up ? to - from : from - to;
    const int32_t start = from < 0 ? 0 : from >= ONE ? ONE - 1 : from;
    const uint16_t along = (uint16_t)(((uint32_t)start << 5) >> 16);
    const uint16_t *row;
    uint16_t way = apart >= ONE ? 0xffffu : (uint16_t)((uint32_t)apart >> 14);
    uint16_t across;
    uint8_t k = HS_MOTION_WAYS - 2;
    while (way < 0x8000u && k > 0) {
        way = (uint16_t)(way << 1);
        --k;
    }
    across = (uint16_t)(way < 0x8000u ? 0u : (uint32_t)way << 1);
    row = &c->move[((up ? HS_MOTION_STARTS : 0) + ((uint16_t)(start >> 16) >> 11)) *
                       HS_MOTION_WAYS + k];
    return between(between(row[0], row[1], across),
                   between(row[HS_MOTION_WAYS], row[HS_MOTION_WAYS + 1], across), along);
}

/* Conversion and start are in different updates: together they would be the longest. */
void hs_motion_aim(const hs_motion_config *config, hs_wanted *wanted, float reference)
{
    hs_move *move = wanted->move;
    int32_t peak;
    uint8_t k = 0;
    while (k < HS_MOTION_MOVES && move->step != 0) {
        ++k;
        ++move;
    }
    if (k == HS_MOTION_MOVES || wanted->asked == wanted->target) {
        if (bits_of(reference) != bits_of(wanted->reference)) {
            wanted->reference = reference;
            wanted->asked = hs_motion_x(config, reference);
        }
        return;
    }
    move->step = step_of(config, wanted->target, wanted->asked);
    move->phase = 0;
    peak = limited(part(wanted->asked - wanted->target, move->step), config->most >> 1) *
           ((int32_t)1 << config->shift);
    move->peak = 2 * peak - (peak >> 3); /* 30 / 16 */
    wanted->target = wanted->asked;
}

/* 16 p^2 (1 - p)^2 of a phase, in Q16. */
static uint16_t bell(uint16_t phase)
{
    const uint32_t u = ((uint32_t)phase * (uint16_t)(0u - phase)) >> 14;
    const uint16_t s = u > 0xffffu ? 0xffffu : (uint16_t)u;
    return (uint16_t)(((uint32_t)s * s) >> 16);
}

void hs_motion_next(const hs_motion_config *config, hs_wanted *wanted)
{
    int32_t next = 0;
    uint8_t k, busy = 0;
    wanted->x = wanted->next_x;
    wanted->v = wanted->next_v;
    for (k = 0; k < HS_MOTION_MOVES; ++k) {
        hs_move *m = &wanted->move[k];
        if (m->step != 0) {
            m->phase = (uint16_t)(m->phase + m->step);
            if (m->phase < m->step) { /* at the end */
                m->step = 0;
            } else {
                next += part(m->peak, bell(m->phase));
                busy = 1;
            }
        }
    }
    next = limited(next, ONE - 1);
    wanted->next_v = next;
    wanted->next_x =
        busy ? wanted->x + (((wanted->v >> 1) + (next >> 1)) >> config->shift) : wanted->target;
    wanted->a = limited(next - wanted->v, config->most) * ((int32_t)1 << config->shift);
}

/* ---- drive -------------------------------------------------------------------------------- */

/* Drive that pushes with an acceleration, not limited but by 0 and FULL. */
static int16_t drive_of(const hs_motion_config *c, hs_place p, int32_t needed)
{
    const int32_t w = scaled(limited(needed, ONE), value_at(c->inverse, p)) - c->carrier_w;
    uint16_t root;
    uint8_t shift;
    if (w <= 0) {
        return 0;
    }
    root = hs_motion_root((uint32_t)w, &shift);
    if (shift < c->root_shift) {
        return FULL;
    }
    root = (uint16_t)((((uint32_t)root * c->root_unit) >> 16) >> (shift - c->root_shift));
    return (int16_t)(root < FULL ? root : FULL);
}

int32_t hs_motion_put(const hs_motion_config *config, hs_motion_state *state, hs_place place,
                      int32_t needed, uint8_t valid)
{
    const int16_t before = state->drive, high = value_at(config->highest, place);
    const int16_t free = drive_of(config, place, needed);
    int16_t drive = (int16_t)(free < config->lowest ? config->lowest : free);
    if (drive > high) {
        drive = high;
    }
    if (drive - before > config->rise) {
        drive = (int16_t)(before + config->rise);
    } else if (before - drive > config->rise) {
        drive = (int16_t)(before - config->rise);
    }
    if (!valid) {
        drive = before;
    }
    state->drive = drive;
    ++state->updates;
    if (drive == free && drive != 0 && drive != FULL) {
        return 0;
    }
    return pushed_by(config, place, drive) - needed;
}
