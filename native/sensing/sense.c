/* Takes: readings of both monitors and a plan. Gives: phasors, noise, levels, disturbances. */
#include "sensing/sense.h"

#include <math.h>
#include <string.h>

#include "sensing/segments.h"
#include "sensing/residual.h"

/* ---- least squares over the segments of a choice -------------------------------------------- */

typedef struct {
    double x[SENSE_BASIS];
    double noise;          /* variance of a reading, from the segments on their own */
    double explained;      /* sum of squares that the fit takes */
} fit;

HS_CLONES static void solve(const sense_plan *plan, const sense_channel *ch,
                            const sense_choice *choice, fit *out)
{
    double b[SENSE_BASIS] = {0};
    size_t p, i, j;
    for (p = 0; p < plan->padded; ++p) {
        b[SENSE_COS] += choice->used[p] * ch->cosine[p];
        b[SENSE_SIN] += choice->used[p] * ch->sine[p];
        b[SENSE_LEVEL] += choice->used[p] * ch->level[p];
        b[SENSE_RAMP] += choice->used[p] * ch->ramp[p];
        b[SENSE_STEP] += choice->after[p] * ch->level[p];
    }
    out->explained = 0.0;
    for (i = 0; i < SENSE_BASIS; ++i) {
        out->x[i] = 0.0;
        for (j = 0; j < SENSE_BASIS; ++j) {
            out->x[i] += choice->inverse[i][j] * b[j];
        }
        out->explained += out->x[i] * b[i];
    }
}

static double noise_of(const sense_plan *plan, const sense_channel *ch, const sense_choice *choice)
{
    double rest = 0.0;
    size_t p;
    for (p = 0; p < plan->segments; ++p) {
        rest += choice->used[p] * ch->rest[p];
    }
    rest /= choice->full * ((double)plan->segment - 4.0);
    return rest > 0.0 ? rest : 0.0;
}

/* Squared residual over the segments of a choice. */
static double left_over(const sense_plan *plan, const sense_channel *ch, const sense_choice *choice,
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

/* Scatter of the segments' phasors about a straight line through them; of the voltage alone, for the
 * current's carrier bends within a block where the actuator swings. */
typedef struct {
    double chi2;        /* in variances of the noise */
    double freedom;     /* of chi2 */
    double turn;        /* rad a segment that the phasor runs ahead of the nominal carrier */
    double turn_weight; /* 1 / its variance; 0 where there is none */
} scatter;

/* turn: rad a segment, taken out before. */
HS_CLONES static void scatter_of(const sense_plan *plan, const sense_channel *ch,
                                 const sense_choice *choice, double noise, double turn,
                                 scatter *out)
{
    const double(*w)[2] = plan->local_whitening, size = choice->full;
    double re[SENSE_ALL], im[SENSE_ALL], at[SENSE_ALL], counts[SENSE_ALL];
    double middle = 0.0, spread = 0.0, re0 = 0.0, im0 = 0.0, re1 = 0.0, im1 = 0.0, chi2 = 0.0;
    double square;
    size_t p;

    memset(out, 0, sizeof *out);
    if (size < 4.0 || !(noise > 0.0)) {
        return;
    }
    for (p = 0; p < plan->padded; ++p) { /* a cos + b sin = Re (a - jb) e^jwt, turned back */
        counts[p] = p < plan->segments ? choice->used[p] : 0.0;
        re[p] = ch->a[p] * plan->turn_cos[p] - ch->b[p] * plan->turn_sin[p];
        im[p] = -ch->b[p] * plan->turn_cos[p] - ch->a[p] * plan->turn_sin[p];
        middle += counts[p] * (double)p;
    }
    middle /= size;
    if (turn != 0.0) {
        for (p = 0; p < plan->segments; ++p) {
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
        chi2 += counts[p] * (w[0][0] * a * a + 2.0 * w[0][1] * a * b + w[1][1] * b * b);
    }
    square = re0 * re0 + im0 * im0;
    noise += ROUNDED * square + ROUNDED_LEVEL * ch->first * ch->first;
    out->chi2 = chi2 / noise;
    out->freedom = 2.0 * size - 4.0;
    if (square > 0.0) {
        out->turn = turn + (im1 * re0 - re1 * im0) / square;
        out->turn_weight = square * spread * 0.5 * (w[0][0] + w[1][1]) / noise;
    }
}

/* Turned with the carrier where it is clearly off its nominal frequency: that turns both monitors
 * alike and leaves their ratio. Returns the turn in rad a segment. */
static double follow_carrier(const sense_plan *plan, const sense_channel *ch,
                             const sense_choice *choice, double noise, scatter *s)
{
    double turn = 0.0;
    size_t round;
    for (round = 0; round < 3; ++round) {
        double change;
        scatter_of(plan, ch, choice, noise, turn, s);
        change = s->turn - turn;
        if (change * change * s->turn_weight <= CLEAR) {
            return s->turn * s->turn * s->turn_weight > CLEAR ? s->turn : 0.0;
        }
        turn = s->turn;
    }
    return turn;
}

/* Levels of the segments about the fit's straight line, in variances of the noise. */
static double level_misfit(const sense_plan *plan, const sense_channel *ch,
                           const sense_choice *choice, const fit *f, double noise)
{
    const double m = (double)plan->segment, n = (double)plan->samples;
    double sum = 0.0;
    size_t p;
    if (!(noise > 0.0)) {
        return 0.0;
    }
    for (p = 0; p < plan->segments; ++p) {
        const double at = (m * (double)p + 0.5 * (m - 1.0) - 0.5 * (n - 1.0)) / n;
        const double off = ch->height[p] - f->x[SENSE_LEVEL] - f->x[SENSE_RAMP] * at -
                           choice->after[p] * f->x[SENSE_STEP];
        sum += choice->used[p] * off * off;
    }
    return sum / (noise * plan->local_inverse[SENSE_LEVEL][SENSE_LEVEL]);
}

/* Noise that one disturbed place cannot raise: the smaller of both halves of the block. */
static double calm_noise(const sense_plan *plan, const sense_channel *ch)
{
    const size_t half = plan->segments / 2;
    const double freedom = (double)half * ((double)plan->segment - 4.0);
    double early = 0.0, late = 0.0;
    size_t p;
    for (p = 0; p < half; ++p) {
        early += ch->rest[p];
        late += ch->rest[plan->segments - 1 - p];
    }
    early = early < late ? early : late;
    return early > 0.0 ? early / freedom : 0.0;
}

/* The choice under which both channels together leave least, if an update hit the block at all. */
static size_t find_update(const sense_plan *plan, const sense_channel ch[2])
{
    const sense_choice *planned = plan->choices;
    const double expected = (double)plan->segments;
    double noise[2], best = -30.0; /* an update must explain more than chance */
    scatter s;
    size_t at = 0, k, j;
    int hit;

    for (j = 0; j < 2; ++j) {
        noise[j] = calm_noise(plan, &ch[j]);
        if (!(noise[j] > 0.0)) {
            return 0;
        }
    }
    follow_carrier(plan, &ch[0], planned, noise[0], &s);
    hit = s.chi2 > s.freedom + 8.0 * sqrt(2.0 * s.freedom);
    for (j = 0; j < 2; ++j) {
        fit f;
        solve(plan, &ch[j], planned, &f);
        hit |= level_misfit(plan, &ch[j], planned, &f, noise[j]) >
               expected + 8.0 * sqrt(2.0 * expected);
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
#define CARRIER_OFF 0.002 /* of the carrier; what leaks then errs by as much of C */

static unsigned judge(const sense_plan *plan, const scatter *s, double turn, sense_result *out)
{
    const double freedom = s->freedom, excess = freedom > 0.0 ? s->chi2 / freedom : 0.0;
    unsigned reason = 0;

    out->excess = 1.0;
    out->offset_rad_s = turn / ((double)plan->segment * plan->period_s);
    if (excess > 1.0 + 6.0 * sqrt(2.0 / freedom)) {
        out->excess = excess;
        reason |= excess > BIASED ? HS_UPDATE : 0u;
    }
    if (fabs(out->offset_rad_s) > CARRIER_OFF * plan->omega_rad_s) {
        reason |= HS_CARRIER_OFF;
    }
    return reason;
}

/* The plain model of one channel, as the result has it. */
typedef struct {
    fit f;
    double re, im, noise, level, slope;
} channel_fit;

static channel_fit fit_channel(const sense_plan *plan, const sense_channel *ch,
                               const sense_choice *choice)
{
    channel_fit out;
    solve(plan, ch, choice, &out.f);
    out.re = ch->known_a + out.f.x[SENSE_COS];
    out.im = -(ch->known_b + out.f.x[SENSE_SIN]); /* x = re cos - im sin */
    out.noise = noise_of(plan, ch, choice);
    out.level = ch->first + out.f.x[SENSE_LEVEL] + choice->after_share * out.f.x[SENSE_STEP];
    out.slope = out.f.x[SENSE_RAMP] / ((double)plan->samples * plan->period_s);
    return out;
}

/* ---- is what is left noise? --------------------------------------------------------------- */

#define RARE 20.0    /* of chi-square with 2 degrees of freedom: exp(-10) of all blocks */
#define OFTEN 4.5    /* standard deviations of a correlation */
#define LONE 5.6     /* standard deviations of one reading of some thousands */
#define TABLE 2e-13  /* rounding in single precision, over the squares of what is taken off */

/* Beyond what chi-square with so many degrees of freedom reaches in one of 10,000 blocks. */
static int beyond(double chi2, double freedom)
{
    return freedom > 0.0 && chi2 > freedom + 4.5 * sqrt(2.0 * freedom) + 6.0;
}

static unsigned suspect(const sense_plan *plan, sense_type type, const void *v, const void *i,
                        size_t stride, const sense_channel ch[2], const sense_choice *choice,
                        const channel_fit fits[2], double turn, sense_result *out)
{
    const double root = sqrt(choice->samples);
    double third[2], variance[2];
    sense_model model[2];
    sense_residual r;
    scatter s;
    unsigned found = 0;
    size_t j, clear = 0;

    for (j = 0; j < 2; ++j) {
        const double *x = fits[j].f.x;
        model[j].a = ch[j].known_a + x[SENSE_COS];
        model[j].b = ch[j].known_b + x[SENSE_SIN];
        model[j].level = ch[j].first + x[SENSE_LEVEL];
        model[j].slope = x[SENSE_RAMP];
        model[j].step = x[SENSE_STEP];
        model[j].turn = turn;
    }
    sense_sum_residual(plan, type, v, i, stride, choice, model, &r);
    out->v3_re = r.third_re[0];
    out->v3_im = r.third_im[0];
    out->i3_re = r.third_re[1];
    out->i3_im = r.third_im[1];
    for (j = 0; j < 2; ++j) {
        const double taken = model[j].a * model[j].a + model[j].b * model[j].b +
                             model[j].level * model[j].level + model[j].slope * model[j].slope +
                             model[j].step * model[j].step;
        variance[j] = r.samples > 0.0 ? r.square[j] / r.samples : 0.0;
        if (!(variance[j] > TABLE * taken)) {
            continue;
        }
        ++clear;
        third[j] = r.third_re[j] * r.third_re[j] + r.third_im[j] * r.third_im[j];
        found |= fabs(r.next[j]) > OFTEN / root * r.square[j] ? SENSE_COLOUR : 0u;
        found |= third[j] * r.samples > 2.0 * RARE * variance[j] ? SENSE_THIRD : 0u;
        found |= r.most[j] * r.most[j] > LONE * LONE * variance[j] ? SENSE_PEAK : 0u;
        found |= beyond(level_misfit(plan, &ch[j], choice, &fits[j].f, fits[j].noise),
                        choice->full - 2.0)
                     ? SENSE_DRIVE
                     : 0u;
        scatter_of(plan, &ch[j], choice, fits[j].noise, turn, &s);
        found |= beyond(s.chi2, s.freedom) ? SENSE_SCATTER : 0u;
    }
    if (clear == 2) {
        const double limit = OFTEN / root;
        found |= r.cross * r.cross > limit * limit * r.square[0] * r.square[1] ? SENSE_CROSS : 0u;
    }
    return found;
}

/* Squares of the carrier and of the noise are too far apart for single precision. */
static int drowned(const sense_plan *plan, const sense_channel *ch)
{
    double square = 0.0, rest = 0.0;
    size_t p;
    for (p = 0; p < plan->segments; ++p) {
        square += plan->choices->used[p] * ch->square[p];
        rest += plan->choices->used[p] * ch->rest[p];
    }
    return rest < DROWNED * square;
}

/* Sums of a block without its carrier, which is added again to what follows from them. */
static void sum_again(const sense_plan *plan, sense_type type, const void *v, const void *i,
                      size_t stride, float *room, sense_columns all[2], sense_channel ch[2])
{
    sense_carrier known[2];
    size_t j, p;
    for (j = 0; j < 2; ++j) {
        fit f;
        solve(plan, &ch[j], plan->choices, &f);
        known[j].a = f.x[SENSE_COS];
        known[j].b = f.x[SENSE_SIN];
    }
    sense_sum_block(plan, type, v, i, stride, 0, known, room, all);
    for (j = 0; j < 2; ++j) {
        sense_fit_segments(plan, &all[j], &ch[j]);
        sense_turn_segments(plan, &all[j], &ch[j]);
        ch[j].known_a = known[j].a;
        ch[j].known_b = known[j].b;
        for (p = 0; p < plan->segments; ++p) {
            ch[j].a[p] += known[j].a * plan->turn_cos[p] + known[j].b * plan->turn_sin[p];
            ch[j].b[p] += known[j].b * plan->turn_cos[p] - known[j].a * plan->turn_sin[p];
        }
    }
}

size_t sense_room(const sense_plan *plan) { return 2 * plan->segment; }

void sense_block(const sense_plan *plan, sense_type type, const void *v, const void *i,
                 size_t stride, size_t ahead, int tested, float *room, sense_result *out)
{
    const sense_choice *choice;
    sense_columns all[2];
    sense_channel ch[2];
    channel_fit fits[2];
    scatter s;
    double turn;
    unsigned reason;
    size_t j, taken;

    memset(out, 0, sizeof *out);
    reason = sense_sum_block(plan, type, v, i, stride, ahead, NULL, room, all);
    for (j = 0; j < 2; ++j) {
        sense_fit_segments(plan, &all[j], &ch[j]);
        sense_turn_segments(plan, &all[j], &ch[j]);
    }
    if (drowned(plan, &ch[0]) || drowned(plan, &ch[1])) {
        sum_again(plan, type, v, i, stride, room, all, ch);
    }
    taken = plan->choice_count > 1 && reason == 0 ? find_update(plan, ch) : 0;
    choice = &plan->choices[taken];
    for (j = 0; j < 2; ++j) {
        fits[j] = fit_channel(plan, &ch[j], choice);
    }
    out->v_re = fits[0].re;
    out->v_im = fits[0].im;
    out->v_noise = fits[0].noise;
    out->v_level = fits[0].level;
    out->v_slope = fits[0].slope;
    out->i_re = fits[1].re;
    out->i_im = fits[1].im;
    out->i_noise = fits[1].noise;
    out->i_level = fits[1].level;
    out->i_slope = fits[1].slope;
    turn = follow_carrier(plan, &ch[0], choice, out->v_noise, &s);
    reason |= judge(plan, &s, turn, out);
    if (tested) {
        out->suspicion = suspect(plan, type, v, i, stride, ch, choice, fits, turn, out);
    }
    out->choice = (uint32_t)taken;
    out->reason = reason;
}
