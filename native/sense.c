/* Takes: readings of both monitors and a plan. Gives: phasors, noise, levels, disturbances. */
#include "sense.h"

#include <math.h>
#include <string.h>

/* The build sets it to have a function compiled for several instruction sets. */
#ifndef HS_CLONES
#define HS_CLONES
#endif

#define PIECE_MOST 65535

/* ---- readings of any type as floats ------------------------------------------------------- */

#define DEFINE_LOAD(type, name)                                                                    \
    HS_CLONES static void load_pairs_of_##name(const type *restrict x, size_t n,                   \
                                               float *restrict v, float *restrict i)               \
    {                                                                                              \
        size_t k;                                                                                  \
        for (k = 0; k < n; ++k) {                                                                  \
            v[k] = (float)x[2 * k];                                                                \
            i[k] = (float)x[2 * k + 1];                                                            \
        }                                                                                          \
    }                                                                                              \
    HS_CLONES static void load_##name(const type *restrict x, size_t n, float *restrict out)       \
    {                                                                                              \
        size_t k;                                                                                  \
        for (k = 0; k < n; ++k) {                                                                  \
            out[k] = (float)x[k];                                                                  \
        }                                                                                          \
    }

DEFINE_LOAD(int16_t, codes)
DEFINE_LOAD(float, floats)
DEFINE_LOAD(double, doubles)

static const void *later(sense_type type, const void *x, size_t samples)
{
    static const size_t size[] = {sizeof(int16_t), sizeof(float), sizeof(double)};
    return (const char *)x + size[type] * samples;
}

/* `n` readings of both channels from sample `from`. */
static void load(sense_type type, const void *v, const void *i, size_t stride, size_t from,
                 size_t n, float *out_v, float *out_i)
{
    const void *a = later(type, v, stride * from), *b = later(type, i, stride * from);
    if (stride == 2) { /* current follows voltage */
        if (type == SENSE_INT16) {
            load_pairs_of_codes(a, n, out_v, out_i);
        } else if (type == SENSE_FLOAT) {
            load_pairs_of_floats(a, n, out_v, out_i);
        } else {
            load_pairs_of_doubles(a, n, out_v, out_i);
        }
    } else if (type == SENSE_INT16) {
        load_codes(a, n, out_v);
        load_codes(b, n, out_i);
    } else if (type == SENSE_FLOAT) {
        load_floats(a, n, out_v);
        load_floats(b, n, out_i);
    } else {
        load_doubles(a, n, out_v);
        load_doubles(b, n, out_i);
    }
}

#define AT_ONCE 2048 /* readings of a channel that stay in the first-level cache */

/* Largest reading without its sign, as bits: those of positive floats are in the values' order. */
HS_CLONES static int32_t largest(const float *x, size_t n, int32_t most)
{
    size_t k;
    for (k = 0; k < n; ++k) {
        int32_t size;
        memcpy(&size, &x[k], sizeof size);
        size &= 0x7fffffff;
        most = size > most ? size : most;
    }
    return most;
}

/* ---- one channel of a block --------------------------------------------------------------- */

/* Pieces of one channel; sums over a block's basis about one reading, `first`. */
typedef struct {
    double first;
    double known_a, known_b; /* carrier that was taken off before */
    double cosine[SENSE_ALL], sine[SENSE_ALL], level[SENSE_ALL], ramp[SENSE_ALL];
    double square[SENSE_ALL];
    /* Each full piece on its own: phasor (a cos + b sin) from its first sample, level, residual. */
    double a[SENSE_ALL], b[SENSE_ALL], height[SENSE_ALL], rest[SENSE_ALL];
} channel;

/* Raw sums, one array a kind so that all pieces go through one vector instruction. */
typedef struct {
    double first[SENSE_ALL], cosine[SENSE_ALL], sine[SENSE_ALL], level[SENSE_ALL];
    double ramp[SENSE_ALL], square[SENSE_ALL];
} columns;

static void keep(columns *all, size_t p, const hs_sums *one)
{
    all->first[p] = (double)one->first;
    all->cosine[p] = (double)one->cosine;
    all->sine[p] = (double)one->sine;
    all->level[p] = (double)one->level;
    all->ramp[p] = (double)one->ramp;
    all->square[p] = (double)one->square;
}

/* Full pieces on their own: least squares over cos, sin, 1, ramp. */
HS_CLONES static void fit_pieces(const sense_plan *plan, const columns *x, channel *out)
{
    const double m = (double)plan->piece, middle = 0.5 * (m - 1.0), first = x->first[plan->start];
    const double *w = plan->local_inverse;
    size_t p;
    for (p = 0; p < plan->padded; ++p) {
        const double c = x->cosine[p], s = x->sine[p], l = x->level[p];
        const double u = (x->ramp[p] - middle * l) / m;
        const double a = w[0] * c + w[1] * s + w[2] * l + w[3] * u;
        const double b = w[4] * c + w[5] * s + w[6] * l + w[7] * u;
        const double h = w[8] * c + w[9] * s + w[10] * l + w[11] * u;
        const double g = w[12] * c + w[13] * s + w[14] * l + w[15] * u;
        out->a[p] = a;
        out->b[p] = b;
        out->height[p] = h + x->first[p] - first;
        out->rest[p] = x->square[p] - a * c - b * s - h * l - g * u;
    }
}

/* The pieces' sums about one reading and over the basis of the whole block. */
HS_CLONES static void turn_pieces(const sense_plan *plan, const columns *x, channel *out)
{
    const double m = (double)plan->piece, n = (double)plan->samples, first = x->first[plan->start];
    const size_t rest = plan->samples - plan->pieces * plan->piece;
    size_t p;
    for (p = 0; p < plan->padded; ++p) {
        const double size = p < plan->pieces ? m : (double)rest;
        const double *table = plan->table[p < plan->pieces ? 0 : 1];
        const double shift = x->first[p] - first;
        const double c = x->cosine[p] + shift * table[0], s = x->sine[p] + shift * table[1];
        const double l = x->level[p] + shift * size;
        const double r = x->ramp[p] + shift * 0.5 * size * (size - 1.0);
        out->cosine[p] = plan->turn_cos[p] * c - plan->turn_sin[p] * s;
        out->sine[p] = plan->turn_sin[p] * c + plan->turn_cos[p] * s;
        out->level[p] = l;
        out->ramp[p] = (r + (m * (double)p - 0.5 * (n - 1.0)) * l) / n;
        out->square[p] = x->square[p] + shift * (2.0 * x->level[p] + shift * size);
    }
    out->first = first;
    out->known_a = out->known_b = 0.0;
}

/* ---- least squares over the pieces of a choice -------------------------------------------- */

typedef struct {
    double x[SENSE_BASIS]; /* cos, sin, level, ramp, step */
    double noise;          /* variance of a reading, from the pieces on their own */
    double explained;      /* sum of squares that the fit takes */
} fit;

HS_CLONES static void solve(const sense_plan *plan, const channel *ch, const sense_choice *choice,
                            fit *out)
{
    double b[SENSE_BASIS] = {0};
    size_t p, i, j;
    for (p = 0; p < plan->padded; ++p) {
        b[0] += choice->used[p] * ch->cosine[p];
        b[1] += choice->used[p] * ch->sine[p];
        b[2] += choice->used[p] * ch->level[p];
        b[3] += choice->used[p] * ch->ramp[p];
        b[4] += choice->after[p] * ch->level[p];
    }
    out->explained = 0.0;
    for (i = 0; i < SENSE_BASIS; ++i) {
        out->x[i] = 0.0;
        for (j = 0; j < SENSE_BASIS; ++j) {
            out->x[i] += choice->inverse[SENSE_BASIS * i + j] * b[j];
        }
        out->explained += out->x[i] * b[i];
    }
}

static double noise_of(const sense_plan *plan, const channel *ch, const sense_choice *choice)
{
    double rest = 0.0;
    size_t p;
    for (p = 0; p < plan->pieces; ++p) {
        rest += choice->used[p] * ch->rest[p];
    }
    rest /= choice->full * ((double)plan->piece - 4.0);
    return rest > 0.0 ? rest : 0.0;
}

/* Squared residual over the pieces of a choice. */
static double left_over(const sense_plan *plan, const channel *ch, const sense_choice *choice,
                        const fit *f)
{
    double square = 0.0;
    size_t p;
    for (p = 0; p < plan->padded; ++p) {
        square += choice->used[p] * ch->square[p];
    }
    return square - f->explained;
}

/* ---- what disturbs a block ---------------------------------------------------------------- */

#define CLEAR 25.0    /* five standard deviations, squared */
#define ROUNDED 1e-12 /* of the carrier's power: what the table in single precision adds to noise */

#define ROUNDED_LEVEL 1e-14 /* of the level's square: what readings in single precision add */

/* Scatter of the pieces' phasors about a straight line through them. */
typedef struct {
    double chi2;        /* in variances of the noise */
    double freedom;     /* of chi2 */
    double turn;        /* rad a piece that the phasor runs ahead of the nominal carrier */
    double turn_weight; /* 1 / its variance; 0 where there is none */
} scatter;

/* turn: rad a piece, taken out before. */
HS_CLONES static void scatter_of(const sense_plan *plan, const channel *ch,
                                 const sense_choice *choice, double noise, double turn,
                                 scatter *out)
{
    const double *w = plan->local_whitening, size = choice->full;
    double re[SENSE_ALL], im[SENSE_ALL], at[SENSE_ALL], counts[SENSE_ALL];
    double middle = 0.0, spread = 0.0, re0 = 0.0, im0 = 0.0, re1 = 0.0, im1 = 0.0, chi2 = 0.0;
    double square;
    size_t p;

    memset(out, 0, sizeof *out);
    if (size < 4.0 || !(noise > 0.0)) {
        return;
    }
    for (p = 0; p < plan->padded; ++p) { /* a cos + b sin = Re (a - jb) e^jwt, turned back */
        counts[p] = p < plan->pieces ? choice->used[p] : 0.0;
        re[p] = ch->a[p] * plan->turn_cos[p] - ch->b[p] * plan->turn_sin[p];
        im[p] = -ch->b[p] * plan->turn_cos[p] - ch->a[p] * plan->turn_sin[p];
        middle += counts[p] * (double)p;
    }
    middle /= size;
    if (turn != 0.0) {
        for (p = 0; p < plan->pieces; ++p) {
            const double angle = turn * ((double)p - middle), c = cos(angle), s = sin(angle);
            const double x = re[p];
            re[p] = x * c + im[p] * s;
            im[p] = im[p] * c - x * s;
        }
    }
    for (p = 0; p < plan->padded; ++p) {
        at[p] = (double)p - middle;
        spread += counts[p] * at[p] * at[p];
        re0 += counts[p] * re[p];
        im0 += counts[p] * im[p];
        re1 += counts[p] * at[p] * re[p];
        im1 += counts[p] * at[p] * im[p];
    }
    re0 /= size;
    im0 /= size;
    re1 /= spread;
    im1 /= spread;
    for (p = 0; p < plan->padded; ++p) {
        const double x = re[p] - re0 - re1 * at[p], y = im[p] - im0 - im1 * at[p];
        const double a = x * plan->turn_cos[p] - y * plan->turn_sin[p];
        const double b = -x * plan->turn_sin[p] - y * plan->turn_cos[p];
        chi2 += counts[p] * (w[0] * a * a + 2.0 * w[1] * a * b + w[2] * b * b);
    }
    square = re0 * re0 + im0 * im0;
    noise += ROUNDED * square + ROUNDED_LEVEL * ch->first * ch->first;
    out->chi2 = chi2 / noise;
    out->freedom = 2.0 * size - 4.0;
    if (square > 0.0) {
        out->turn = turn + (im1 * re0 - re1 * im0) / square;
        out->turn_weight = square * spread * 0.5 * (w[0] + w[2]) / noise;
    }
}

/* Both channels, turned with the carrier where it is clearly off its nominal frequency: that moves
 * both phasors alike and leaves their ratio. Returns the turn in rad a piece. */
static double scatter_of_both(const sense_plan *plan, const channel ch[2],
                              const sense_choice *choice, const double noise[2], scatter s[2])
{
    double turn = 0.0, weight;
    size_t j, round;
    for (round = 0; round < 3; ++round) {
        for (j = 0; j < 2; ++j) {
            scatter_of(plan, &ch[j], choice, noise[j], turn, &s[j]);
        }
        weight = s[0].turn_weight + s[1].turn_weight;
        if (!(weight > 0.0)) {
            return 0.0;
        }
        {
            const double found =
                (s[0].turn * s[0].turn_weight + s[1].turn * s[1].turn_weight) / weight;
            const double change = found - turn;
            if (change * change * weight <= CLEAR) {
                return found * found * weight > CLEAR ? found : 0.0;
            }
            turn = found;
        }
    }
    return turn;
}

/* Levels of the pieces about the fit's straight line, in variances of the noise. */
static double level_misfit(const sense_plan *plan, const channel *ch, const sense_choice *choice,
                           const fit *f, double noise)
{
    const double m = (double)plan->piece, n = (double)plan->samples;
    double sum = 0.0;
    size_t p;
    if (!(noise > 0.0)) {
        return 0.0;
    }
    for (p = 0; p < plan->pieces; ++p) {
        const double at = (m * (double)p + 0.5 * (m - 1.0) - 0.5 * (n - 1.0)) / n;
        const double off = ch->height[p] - f->x[2] - f->x[3] * at;
        sum += choice->used[p] * off * off;
    }
    return sum / (noise * plan->local_inverse[10]);
}

/* Noise that one disturbed place cannot raise: the smaller of both halves of the block. */
static double calm_noise(const sense_plan *plan, const channel *ch)
{
    const size_t half = plan->pieces / 2;
    const double freedom = (double)half * ((double)plan->piece - 4.0);
    double early = 0.0, late = 0.0;
    size_t p;
    for (p = 0; p < half; ++p) {
        early += ch->rest[p];
        late += ch->rest[plan->pieces - 1 - p];
    }
    early = early < late ? early : late;
    return early > 0.0 ? early / freedom : 0.0;
}

/* The choice under which both channels together leave least, if an update hit the block at all. */
static size_t find_update(const sense_plan *plan, const channel ch[2])
{
    const sense_choice *planned = plan->choices;
    const double expected = (double)plan->pieces;
    double noise[2], best = -30.0; /* an update must explain more than chance */
    scatter s[2];
    size_t at = 0, k, j;
    int hit = 0;

    for (j = 0; j < 2; ++j) {
        noise[j] = calm_noise(plan, &ch[j]);
        if (!(noise[j] > 0.0)) {
            return 0;
        }
    }
    scatter_of_both(plan, ch, planned, noise, s);
    for (j = 0; j < 2; ++j) {
        fit f;
        solve(plan, &ch[j], planned, &f);
        hit |= level_misfit(plan, &ch[j], planned, &f, noise[j]) >
               expected + 8.0 * sqrt(2.0 * expected);
        hit |= j == 0 && s[j].chi2 > s[j].freedom + 8.0 * sqrt(2.0 * s[j].freedom);
        best += left_over(plan, &ch[j], planned, &f) / noise[j] - planned->samples;
    }
    for (k = 1; hit && k < plan->choice_count; ++k) {
        const sense_choice *choice = &plan->choices[k];
        double left = 0.0;
        for (j = 0; j < 2; ++j) {
            fit f;
            solve(plan, &ch[j], choice, &f);
            left += left_over(plan, &ch[j], choice, &f) / noise[j] - choice->samples;
        }
        if (left < best) {
            best = left;
            at = k;
        }
    }
    return at;
}

/* ---- a block ------------------------------------------------------------------------------ */

#define DROWNED 1e-5      /* rounding errs by some 2e-7 of the squares: 2 % of such a noise */
#define BIASED 9.0        /* scatter in variances at which C is off by four standard deviations */
#define CARRIER_OFF 0.005 /* of the carrier; it is the relative error of C */

static unsigned judge(const sense_plan *plan, const scatter s[2], double turn, sense_result *out)
{
    const double freedom = s[0].freedom, excess = freedom > 0.0 ? s[0].chi2 / freedom : 0.0;
    unsigned reason = 0;

    out->excess = 1.0;
    out->offset_rad_s = turn / ((double)plan->piece * plan->period_s);
    /* The voltage alone: the current's carrier bends within a block where the actuator swings. */
    if (excess > 1.0 + 6.0 * sqrt(2.0 / freedom)) {
        out->excess = excess;
        reason |= excess > BIASED ? HS_UPDATE : 0u;
    }
    if (fabs(out->offset_rad_s) > CARRIER_OFF * plan->omega_rad_s) {
        reason |= HS_CARRIER_OFF;
    }
    return reason;
}

static void keep_all(const sense_plan *plan, const hs_sums *sums, columns *all, unsigned *reason)
{
    const size_t pieces = (plan->samples + plan->piece - 1) / plan->piece;
    size_t p;
    memset(all, 0, sizeof *all);
    for (p = 0; p < pieces; ++p) {
        keep(all, p, &sums[p]);
        *reason |= sums[p].square <= HS_LARGEST ? 0u : HS_NOT_FINITE;
    }
}

/* A carrier that is taken off the readings before they are summed, from the block's first sample. */
typedef struct {
    double a, b; /* a cos + b sin */
} carrier;

HS_CLONES static void take_off(const sense_plan *plan, const carrier *known, size_t first_piece,
                               float *x, size_t n)
{
    size_t p, k, from;
    for (p = first_piece, from = 0; from < n; ++p, from += plan->piece) {
        const size_t left = n - from, size = left < plan->piece ? left : plan->piece;
        const float a = (float)(known->a * plan->turn_cos[p] + known->b * plan->turn_sin[p]);
        const float b = (float)(known->b * plan->turn_cos[p] - known->a * plan->turn_sin[p]);
        for (k = 0; k < size; ++k) {
            x[from + k] -= a * plan->cosine[k] + b * plan->sine[k];
        }
    }
}

/* Sums of all pieces of both channels; reasons that the readings themselves give. known: what is
 * taken off both channels, or NULL. */
static unsigned sum_block(const sense_plan *plan, sense_type type, const void *v, const void *i,
                          size_t stride, const carrier *known, columns all[2])
{
    const size_t some = AT_ONCE / plan->piece, together = (some > 0 ? some : 1) * plan->piece;
    const int limited = plan->full_scale <= HS_LARGEST || plan->current_limit <= HS_LARGEST;
    const int as_they_are = type == SENSE_FLOAT && stride == 1 && known == NULL;
    hs_sums sums[2][SENSE_ALL];
    float room[2][PIECE_MOST];
    int32_t bits[2] = {0, 0};
    float most[2];
    unsigned reason = 0;
    size_t j, from;

    for (from = 0; from < plan->samples; from += together) {
        const size_t left = plan->samples - from, n = left < together ? left : together;
        const float *x[2] = {room[0], room[1]};
        if (as_they_are) {
            x[0] = later(type, v, from);
            x[1] = later(type, i, from);
        } else {
            load(type, v, i, stride, from, n, room[0], room[1]);
        }
        for (j = 0; j < 2; ++j) {
            bits[j] = limited ? largest(x[j], n, bits[j]) : 0;
            if (known != NULL) {
                take_off(plan, &known[j], from / plan->piece, room[j], n);
            }
            plan->sum(x[j], n, plan->cosine, plan->sine, plan->piece,
                      sums[j] + from / plan->piece);
        }
    }
    keep_all(plan, sums[0], &all[0], &reason);
    keep_all(plan, sums[1], &all[1], &reason);
    memcpy(most, bits, sizeof most);
    if (most[0] >= plan->full_scale || most[1] >= plan->full_scale) {
        reason |= HS_CLIPPED;
    }
    if (most[1] >= plan->current_limit) {
        reason |= HS_CURRENT_LIMIT;
    }
    return reason;
}

static void put_channel(const sense_plan *plan, const channel *ch, const sense_choice *choice,
                        double *phasor, double *noise, double *level, double *slope)
{
    fit f;
    solve(plan, ch, choice, &f);
    phasor[0] = ch->known_a + f.x[0];
    phasor[1] = -(ch->known_b + f.x[1]); /* x = re cos - im sin */
    *noise = noise_of(plan, ch, choice);
    *level = ch->first + f.x[2] + choice->after_share * f.x[4];
    *slope = f.x[3] / ((double)plan->samples * plan->period_s);
}

/* Squares of the carrier and of the noise are too far apart for single precision. */
static int drowned(const sense_plan *plan, const channel *ch)
{
    double square = 0.0, rest = 0.0;
    size_t p;
    for (p = 0; p < plan->pieces; ++p) {
        square += plan->choices->used[p] * ch->square[p];
        rest += plan->choices->used[p] * ch->rest[p];
    }
    return rest < DROWNED * square;
}

/* Sums of a block without its carrier, which is added again to what follows from them. */
static void sum_again(const sense_plan *plan, sense_type type, const void *v, const void *i,
                      size_t stride, columns all[2], channel ch[2])
{
    carrier known[2];
    size_t j, p;
    for (j = 0; j < 2; ++j) {
        fit f;
        solve(plan, &ch[j], plan->choices, &f);
        known[j].a = f.x[0];
        known[j].b = f.x[1];
    }
    sum_block(plan, type, v, i, stride, known, all);
    for (j = 0; j < 2; ++j) {
        fit_pieces(plan, &all[j], &ch[j]);
        turn_pieces(plan, &all[j], &ch[j]);
        ch[j].known_a = known[j].a;
        ch[j].known_b = known[j].b;
        for (p = 0; p < plan->pieces; ++p) {
            ch[j].a[p] += known[j].a * plan->turn_cos[p] + known[j].b * plan->turn_sin[p];
            ch[j].b[p] += known[j].b * plan->turn_cos[p] - known[j].a * plan->turn_sin[p];
        }
    }
}

void sense_block(const sense_plan *plan, sense_type type, const void *v, const void *i,
                 size_t stride, sense_result *out)
{
    const sense_choice *choice;
    columns all[2];
    channel ch[2];
    scatter s[2];
    double noise[2];
    unsigned reason;
    size_t j, taken;

    reason = sum_block(plan, type, v, i, stride, NULL, all);
    for (j = 0; j < 2; ++j) {
        fit_pieces(plan, &all[j], &ch[j]);
        turn_pieces(plan, &all[j], &ch[j]);
    }
    if (drowned(plan, &ch[0]) || drowned(plan, &ch[1])) {
        sum_again(plan, type, v, i, stride, all, ch);
    }
    taken = plan->choice_count > 1 && reason == 0 ? find_update(plan, ch) : 0;
    choice = &plan->choices[taken];
    put_channel(plan, &ch[0], choice, &out->v_re, &out->v_noise, &out->v_level, &out->v_slope);
    put_channel(plan, &ch[1], choice, &out->i_re, &out->i_noise, &out->i_level, &out->i_slope);
    noise[0] = out->v_noise;
    noise[1] = out->i_noise;
    reason |= judge(plan, s, scatter_of_both(plan, ch, choice, noise, s), out);
    out->choice = (double)taken;
    out->reason = (double)reason;
}

/* ---- recursive ---------------------------------------------------------------------------- */

/* M = F M F' for the change of coordinates from one piece to the next: the phasor turns by the
 * piece's phase, the ramp's zero moves on by one. Columns cos, sin, 1, ramp. */
static void advance_normal(double *m, double c, double s)
{
    const double f[4][4] = {{c, s, 0, 0}, {-s, c, 0, 0}, {0, 0, 1, 0}, {0, 0, -1, 1}};
    double t[4][4];
    size_t i, j, k;
    for (i = 0; i < 4; ++i) {
        for (j = 0; j < 4; ++j) {
            t[i][j] = 0.0;
            for (k = 0; k < 4; ++k) {
                t[i][j] += f[i][k] * m[4 * k + j];
            }
        }
    }
    for (i = 0; i < 4; ++i) {
        for (j = 0; j < 4; ++j) {
            m[4 * i + j] = 0.0;
            for (k = 0; k < 4; ++k) {
                m[4 * i + j] += t[i][k] * f[j][k];
            }
        }
    }
}

/* a = M^-1, symmetric and positive, by Gauss-Jordan; 0 where it has none. */
static int invert(const double *m, double *a)
{
    double w[4][8];
    size_t i, j, k;
    for (i = 0; i < 4; ++i) {
        for (j = 0; j < 4; ++j) {
            w[i][j] = m[4 * i + j];
            w[i][4 + j] = i == j ? 1.0 : 0.0;
        }
    }
    for (k = 0; k < 4; ++k) {
        const double pivot = w[k][k];
        if (!(pivot > 0.0)) {
            return 0;
        }
        for (j = 0; j < 8; ++j) {
            w[k][j] /= pivot;
        }
        for (i = 0; i < 4; ++i) {
            const double part = w[i][k];
            if (i != k) {
                for (j = 0; j < 8; ++j) {
                    w[i][j] -= part * w[k][j];
                }
            }
        }
    }
    for (i = 0; i < 4; ++i) {
        for (j = 0; j < 4; ++j) {
            a[4 * i + j] = w[i][4 + j];
        }
    }
    return 1;
}

static double quadratic(const double *row, const double *m)
{
    double sum = 0.0;
    size_t i, j;
    for (i = 0; i < 4; ++i) {
        for (j = 0; j < 4; ++j) {
            sum += row[i] * m[4 * i + j] * row[j];
        }
    }
    return sum;
}

void sense_recursive(const sense_plan *plan, const double local_normal[16], double forget,
                     sense_memory *memory, sense_type type, const void *v, const void *i,
                     size_t stride, sense_recursive_result *out)
{
    const double m = (double)plan->piece, c = plan->turn_cos[1], s = plan->turn_sin[1];
    double inverse[16], x[2][4], end[4], phase_re, phase_im;
    columns all[2];
    channel ch[2];
    unsigned reason = sum_block(plan, type, v, i, stride, NULL, all);
    size_t j, k, l;

    advance_normal(memory->normal, c, s);
    advance_normal(memory->square, c, s);
    for (k = 0; k < 16; ++k) {
        memory->normal[k] = forget * memory->normal[k] + local_normal[k];
        memory->square[k] = forget * forget * memory->square[k] + local_normal[k];
    }
    for (j = 0; j < 2; ++j) {
        double *b = memory->sums[j];
        const double first = all[j].first[0], old[4] = {b[0], b[1], b[2], b[3]};
        double shift, level;
        fit_pieces(plan, &all[j], &ch[j]);
        if (!memory->started) {
            memory->first[j] = first;
        }
        shift = first - memory->first[j];
        level = all[j].level[0];
        b[0] = forget * (c * old[0] + s * old[1]) + all[j].cosine[0] + shift * plan->table[0][0];
        b[1] = forget * (c * old[1] - s * old[0]) + all[j].sine[0] + shift * plan->table[0][1];
        b[2] = forget * old[2] + level + shift * m;
        b[3] = forget * (old[3] - old[2]) + (all[j].ramp[0] + shift * 0.5 * m * (m - 1.0)) / m;
        memory->rest[j] = forget * memory->rest[j] + ch[j].rest[0];
    }
    memory->freedom = forget * memory->freedom + (m - 4.0);
    memory->started = 1;
    if (!invert(memory->normal, inverse)) {
        reason |= HS_NOT_FINITE;
        memset(inverse, 0, sizeof inverse);
    }
    for (j = 0; j < 2; ++j) {
        for (k = 0; k < 4; ++k) {
            x[j][k] = 0.0;
            for (l = 0; l < 4; ++l) {
                x[j][k] += inverse[4 * k + l] * memory->sums[j][l];
            }
        }
    }
    /* Level at the piece's end: row of (1, ramp = 1 - 1/m). */
    for (k = 0; k < 4; ++k) {
        end[k] = inverse[8 + k] + (1.0 - 1.0 / m) * inverse[12 + k];
    }
    phase_re = cos(2.0 * 3.14159265358979323846 * memory->turn);
    phase_im = sin(2.0 * 3.14159265358979323846 * memory->turn);
    out->v_re = x[0][0] * phase_re - x[0][1] * phase_im;
    out->v_im = -x[0][1] * phase_re - x[0][0] * phase_im;
    out->i_re = x[1][0] * phase_re - x[1][1] * phase_im;
    out->i_im = -x[1][1] * phase_re - x[1][0] * phase_im;
    memory->turn += plan->omega_rad_s * plan->period_s * m / (2.0 * 3.14159265358979323846);
    memory->turn -= floor(memory->turn);
    out->v_noise = memory->rest[0] > 0.0 ? memory->rest[0] / memory->freedom : 0.0;
    out->i_noise = memory->rest[1] > 0.0 ? memory->rest[1] / memory->freedom : 0.0;
    out->v_level = memory->first[0] + x[0][2] + (1.0 - 1.0 / m) * x[0][3];
    out->i_level = memory->first[1] + x[1][2] + (1.0 - 1.0 / m) * x[1][3];
    out->v_slope = x[0][3] / (m * plan->period_s);
    out->i_slope = x[1][3] / (m * plan->period_s);
    out->quadrature =
        0.5 * (quadratic(inverse, memory->square) + quadratic(inverse + 4, memory->square));
    out->level = quadratic(end, memory->square);
    out->slope = quadratic(inverse + 12, memory->square) /
                 (m * plan->period_s * m * plan->period_s);
    out->reason = (double)reason;
}
