/* See track_step.h. */
#include "tracking/track_step.h"

#include <math.h>   /* sqrt, fabs, NAN */
#include <string.h> /* memcpy, memset */

#include "tracking/track_neighbours.h"
#include "tracking/track_work.h"

enum { FEWEST = TRACK_FEWEST, MOST_ROUNDS = 24, SAMPLE = 50 };

/* Contrast, in standard deviations of what noise alone shows of any template: the best of the
 * 25 x 25 places of a search reaches 3.2 of them. And the largest deviation of a place. */
static const double LEAST_CONTRAST = 5.0, MOST_STD_PX = 1.0;

static size_t aligned(size_t bytes) { return (bytes + 63) / 64 * 64; }

static int filters_whole(const struct track_points *points, const struct track_frame *frame)
{
    const double edge = 1.1 * points->side + 18.0; /* px filtered around one subset */
    return points->count * edge * edge > 1.5 * frame->width * frame->height;
}

size_t track_step_size(const struct track_points *points, const struct track_frame *frame,
                       int search_px)
{
    const size_t count = (size_t)points->count;
    size_t bytes = 64 + aligned(count * 4 * sizeof(double)) + aligned(count * 2 * sizeof(double)) +
                   aligned(count * sizeof(double)) + aligned(count * 2 * sizeof(double)) +
                   aligned(count * sizeof(struct track_result)) + aligned(count) +
                   aligned(track_scratch_size(points->side)) +
                   aligned(track_search_size(points->side, search_px));
    if (filters_whole(points, frame)) {
        bytes += aligned(track_coefficients_size(frame->width, frame->height));
    }
    return bytes;
}

static struct track_template template_of(const struct track_points *p, int i)
{
    const size_t n = (size_t)i, stride = (size_t)p->stride, m = (size_t)p->unknowns;
    const struct track_template t = {p->shape + n * stride, p->gradient + 2 * n * stride,
                                     p->inverse + n * m * m, p->place,
                                     p->side,                p->stride,
                                     p->unknowns};
    return t;
}

static struct track_pose get_pose(const double *p)
{
    const struct track_pose pose = {p[0], p[1], {p[2], p[3], p[4], p[5]}};
    return pose;
}

/* f = (1 + gradient) * base: how the template is deformed when the sheet is by `gradient`. */
static void put_deformation(const double *gradient, const double *base, double *f)
{
    const double a = 1.0 + gradient[0], b = gradient[1], c = gradient[2], d = 1.0 + gradient[3];
    f[0] = a * base[0] + b * base[2];
    f[1] = a * base[1] + b * base[3];
    f[2] = c * base[0] + d * base[2];
    f[3] = c * base[1] + d * base[3];
}

static void note_moved(const struct track_work *w, int i)
{
    w->moved[2 * i] = w->poses[6 * i] - w->points->centre[2 * i];
    w->moved[2 * i + 1] = w->poses[6 * i + 1] - w->points->centre[2 * i + 1];
}

/* ---- one point ---------------------------------------------------------------------------- */

static float variance_at(const struct track_rules *rules, float grey)
{
    const float least = 1.0f / 12.0f, v = rules->noise_floor + rules->noise_slope * grey;
    return v > least ? v : least;
}

/* Share of a frame's white noise left after sampling between pixels. */
static float white_share(const struct track_points *p, double position)
{
    const double at = (position - (int)position) * TRACK_WHITE_STEPS; /* inside the frame: >= 0 */
    const int k = (int)at;
    const float t = (float)(at - k);
    return p->white[k] + t * (p->white[k + 1] - p->white[k]);
}

/* Weighted mean square of the residual over what the noise explains. */
static float residual_ratio(const struct track_work *w, int i)
{
    const struct track_rules *rules = w->rules;
    const struct track_result *r = &w->results[i];
    const float *noise = w->points->noise + TRACK_NOISE_ROW * (ptrdiff_t)i;
    const float norm = noise[9], level = noise[10], share = noise[11];
    const float gain = r->amplitude / norm;
    const float now = variance_at(rules, r->level) * white_share(w->points, w->poses[6 * i]) *
                      white_share(w->points, w->poses[6 * i + 1]);
    const float rest = gain * gain * variance_at(rules, level) * noise[12];
    return r->residual / share / (now + rest);
}

/* Standard deviations of point i's displacement: the noise of both ends through the solve, widened
 * where the match leaves more than the noise explains (the Birge ratio). A subset that covers
 * fewer pixels of the frame than of the reference samples their noise more densely. */
static void deviations(const struct track_work *w, int i, double *std)
{
    const struct track_rules *rules = w->rules;
    const struct track_result *r = &w->results[i];
    const float *noise = w->points->noise + TRACK_NOISE_ROW * (ptrdiff_t)i;
    const double amplitude = (double)(r->amplitude > 1e-6f ? r->amplitude : 1e-6f);
    const double even = (double)variance_at(rules, r->level) / (amplitude * amplitude);
    const double shaped = (double)rules->noise_slope / amplitude;
    double c[3], ratio = w->excess[i];
    if (rules->noise_known && ratio < 1.0) {
        ratio = 1.0;
    }
    const double *f = w->poses + 6 * i + 2;
    const double denser = 1.0 / fabs(f[0] * f[3] - f[1] * f[2]);
    for (int k = 0; k < 3; ++k) {
        c[k] = denser * (even * (double)noise[k] + shaped * (double)noise[3 + k]) +
               (double)noise[6 + k];
    }
    std[0] = sqrt(ratio * (f[0] * f[0] * c[0] + 2.0 * f[0] * f[1] * c[1] + f[1] * f[1] * c[2]));
    std[1] = sqrt(ratio * (f[2] * f[2] * c[0] + 2.0 * f[2] * f[3] * c[1] + f[3] * f[3] * c[2]));
}

/* Is there more to see than noise shows of any template, and does it tell the place? */
static int tells_place(const struct track_work *w, int i)
{
    const struct track_result *r = &w->results[i];
    const double contrast = (double)r->amplitude, *std = w->stds + 2 * i;
    const double noise = (double)variance_at(w->rules, r->level);
    return contrast * contrast > LEAST_CONTRAST * LEAST_CONTRAST * noise &&
           std[0] <= MOST_STD_PX && std[1] <= MOST_STD_PX; /* not when they are NaN */
}

static unsigned char judge(const struct track_work *w, int i)
{
    const struct track_result *r = &w->results[i];
    switch ((int)r->status) {
    case TRACK_OUTSIDE: return TRACK_LEFT;
    case TRACK_DEFORMED: return TRACK_BENT;
    case TRACK_CONVERGED: break;
    default: return TRACK_UNSETTLED;
    }
    if (r->quality < w->rules->minimum_quality) {
        return TRACK_UNLIKE;
    }
    deviations(w, i, w->stds + 2 * i);
    return tells_place(w, i) ? 0 : TRACK_UNLIKE;
}

static void refine_point(const struct track_work *w, int i)
{
    const struct track_template t = template_of(w->points, i);
    double *at = w->poses + 6 * (ptrdiff_t)i;
    struct track_pose pose = get_pose(at);
    track_refine(w->kernels, w->frame, w->whole, &t, &w->rules->settings, &pose, &w->results[i],
                 w->refine);
    at[0] = pose.x;
    at[1] = pose.y;
    memcpy(at + 2, pose.f, sizeof pose.f);
    w->excess[i] = w->results[i].amplitude > 0.0f ? (double)residual_ratio(w, i) : 1e9;
    w->reasons[i] = judge(w, i);
    note_moved(w, i);
}

/* ---- the step ----------------------------------------------------------------------------- */

static void predict(const struct track_work *w, const struct track_memory *before)
{
    const struct track_points *p = w->points;
    const int k_all = p->neighbours;
    for (int i = 0; i < p->count; ++i) {
        double vx = before->velocity[2 * i], vy = before->velocity[2 * i + 1];
        if (k_all && track_all_usable(p, before->reasons, i)) {
            const double *s = p->smooth + (ptrdiff_t)i * (k_all + 1);
            const int *near = p->near + (ptrdiff_t)i * k_all;
            vx *= s[0];
            vy *= s[0];
            for (int k = 0; k < k_all; ++k) {
                vx += s[k + 1] * before->velocity[2 * near[k]];
                vy += s[k + 1] * before->velocity[2 * near[k] + 1];
            }
        }
        memcpy(w->poses + 6 * i, before->poses + 6 * i, 6 * sizeof(double));
        w->poses[6 * i] += vx;
        w->poses[6 * i + 1] += vy;
        note_moved(w, i);
    }
    for (int i = 0; k_all && i < p->count; ++i) {
        double *g = w->expected + 4 * i;
        track_full_gradient(p, w->moved, i, g);
        put_deformation(g, p->base + 4 * i, w->poses + 6 * i + 2);
    }
}

/* Is point i farther than the jump from where its believed neighbours put it? They extrapolate
 * with the gradient predicted for this frame and with that of the positions found in it: a point
 * that just came back from a long wait has spoilt the one, a point that jumped spoils the other. */
static int strays(const struct track_work *w, int i)
{
    const struct track_points *p = w->points;
    const double jump = (double)w->rules->jump_px, *m = w->moved + 2 * i;
    double g[4], guess[2] = {0.0};
    if (!track_all_usable(p, w->reasons, i)) {
        if (!track_partial_gradient(p, w->moved, w->reasons, i, g)) {
            memcpy(g, w->expected + 4 * i, sizeof g);
        }
    } else {
        /* an affine fit is cheaper; only where it doubts, the median decides. Its own share in
         * the fit taken out, the point is 1 / (1 - share) times as far from it. */
        const double *s = p->smooth + (ptrdiff_t)i * (p->neighbours + 1);
        const int *near = p->near + (ptrdiff_t)i * p->neighbours;
        double x = 0.0, y = 0.0;
        for (int k = 0; k < p->neighbours; ++k) {
            x += s[k + 1] * (w->moved[2 * near[k]] - m[0]);
            y += s[k + 1] * (w->moved[2 * near[k] + 1] - m[1]);
        }
        const double doubt = 0.5 * jump * (1.0 - s[0]);
        if (fabs(x) < doubt && fabs(y) < doubt) {
            return 0;
        }
        track_full_gradient(p, w->moved, i, g);
    }
    for (int pass = 0; pass < 2; ++pass) {
        const double *with = pass ? g : w->expected + 4 * i;
        if (track_median_guess(p, w->moved, w->reasons, with, i, guess) < FEWEST) {
            return 0;
        }
        if (fabs(m[0] - guess[0]) <= jump && fabs(m[1] - guess[1]) <= jump) {
            return 0;
        }
    }
    return 1;
}

/* Marks the points that strayed. All are judged by the same neighbours before any is marked. */
static void mark_strays(const struct track_work *w)
{
    const int count = w->points->count;
    for (int i = 0; i < count; ++i) {
        w->tried[i] = !w->reasons[i] && strays(w, i);
    }
    for (int i = 0; i < count; ++i) {
        w->reasons[i] = (unsigned char)(w->reasons[i] | (w->tried[i] ? TRACK_STRAYED : 0));
    }
}

static double gain_of(const struct track_work *w, int i)
{
    const double norm = (double)w->points->noise[TRACK_NOISE_ROW * (ptrdiff_t)i + 9];
    return (double)w->results[i].amplitude / norm;
}

/* Medians of excess and gain over the points that a solve has placed in this frame, from a sample
 * of them; 0 when there are none. Returns whether three quarters of the sample agree on the gain
 * to a quarter. */
static int find_common(const struct track_work *w, double *common_excess, double *common_gain)
{
    double excess[2 * SAMPLE], gain[2 * SAMPLE];
    const int step = w->points->count / SAMPLE + 1;
    int kept = 0, asked = 0, agree = 0;
    for (int i = 0; i < w->points->count; i += step) {
        ++asked;
        if (!(w->reasons[i] & ~TRACK_COVERED)) {
            excess[kept] = w->excess[i];
            gain[kept++] = gain_of(w, i);
        }
    }
    *common_excess = kept ? track_median(excess, kept) : 0.0;
    *common_gain = kept ? track_median(gain, kept) : 0.0;
    for (int k = 0; k < kept; ++k) {
        agree += fabs(gain[k] - *common_gain) < 0.25 * *common_gain;
    }
    return 4 * agree >= 3 * asked;
}

/* The gain to carry on, from the one before and the one found. */
static double gain_after(double before, double found, int agreed)
{
    if (before > 0.0 && found > 0.0 && !agreed) {
        return found > 2.0 * before ? 2.0 * before : (found < 0.5 * before ? 0.5 * before : found);
    }
    return found > 0.0 ? found : before;
}

static int is_covered(const struct track_work *w, int i)
{
    const double gain = gain_of(w, i), most = (double)w->rules->most_gain;
    return w->excess[i] > (double)w->rules->most_residual * w->common_excess ||
           gain > most * w->common_gain || gain * most < w->common_gain;
}

static void mark_covered(const struct track_work *w)
{
    for (int i = 0; i < w->points->count; ++i) {
        if (!w->reasons[i] && is_covered(w, i)) {
            w->reasons[i] = TRACK_COVERED;
        }
    }
}

/* Where the usable neighbours put point i, and how they deform it; 0 when they cannot tell. */
static int place_by_neighbours(const struct track_work *w, const unsigned char *unusable, int i,
                               double *pose)
{
    double g[4], guess[2];
    if (!track_partial_gradient(w->points, w->moved, unusable, i, g) ||
        track_median_guess(w->points, w->moved, unusable, g, i, guess) < FEWEST) {
        return 0;
    }
    pose[0] = w->points->centre[2 * i] + guess[0];
    pose[1] = w->points->centre[2 * i + 1] + guess[1];
    put_deformation(g, w->points->base + 4 * i, pose + 2);
    return 1;
}

/* A second try from the neighbours' word; the number of points found. */
static int retry_by_neighbours(const struct track_work *w)
{
    int found = 0;
    for (int i = 0; i < w->points->count; ++i) {
        double pose[6];
        if (!w->reasons[i] || w->tried[i] >= 3 || !place_by_neighbours(w, w->reasons, i, pose)) {
            continue;
        }
        const unsigned char was = w->reasons[i];
        memcpy(w->poses + 6 * i, pose, sizeof pose);
        refine_point(w, i);
        const double jump = (double)w->rules->jump_px;
        if (!w->reasons[i] && (fabs(w->poses[6 * i] - pose[0]) > jump ||
                               fabs(w->poses[6 * i + 1] - pose[1]) > jump)) {
            w->reasons[i] = TRACK_STRAYED;
        }
        if (!w->reasons[i] && is_covered(w, i)) {
            w->reasons[i] = TRACK_COVERED;
        }
        if (w->reasons[i]) {
            w->reasons[i] = (unsigned char)(w->reasons[i] | (was & TRACK_STRAYED));
            ++w->tried[i];
        } else {
            ++found;
        }
    }
    return found;
}

/* Whole-pixel search for those that no neighbours can place. */
static void retry_by_search(const struct track_work *w, const struct track_memory *before)
{
    for (int i = 0; i < w->points->count; ++i) {
        double guess[6];
        if (!w->reasons[i] ||
            (w->points->neighbours && place_by_neighbours(w, w->reasons, i, guess))) {
            continue;
        }
        const struct track_template t = template_of(w->points, i);
        struct track_pose pose = get_pose(before->poses + 6 * (ptrdiff_t)i);
        pose.x += before->velocity[2 * i];
        pose.y += before->velocity[2 * i + 1];
        if (w->points->neighbours) {
            memcpy(pose.f, w->poses + 6 * (ptrdiff_t)i + 2, sizeof pose.f);
        }
        if (track_search(w->frame, &t, w->rules->search_px, &pose, w->search) > 0.0f) {
            w->poses[6 * i] = pose.x;
            w->poses[6 * i + 1] = pose.y;
            memcpy(w->poses + 6 * i + 2, pose.f, sizeof pose.f);
            refine_point(w, i);
        }
    }
}

static int any_lost(const struct track_work *w)
{
    int lost = 0;
    for (int i = 0; i < w->points->count; ++i) {
        lost |= w->reasons[i];
    }
    return lost != 0;
}

/* A point found far from where it was expected, with hardly a neighbour to bear it out, may well be
 * another that looks the same. */
static void mark_lone(const struct track_work *w, const struct track_memory *before)
{
    const struct track_points *p = w->points;
    const double jump = (double)w->rules->jump_px;
    for (int i = 0; i < p->count; ++i) {
        const double *from = before->poses + 6 * i, *speed = before->velocity + 2 * i;
        const int *near = p->near + (ptrdiff_t)i * p->neighbours;
        int bears = 0;
        for (int k = 0; k < p->neighbours; ++k) {
            bears += !w->reasons[near[k]];
        }
        w->tried[i] = !w->reasons[i] && 2 * bears < p->neighbours &&
                      (fabs(w->poses[6 * i] - from[0] - speed[0]) > jump ||
                       fabs(w->poses[6 * i + 1] - from[1] - speed[1]) > jump);
    }
    for (int i = 0; i < p->count; ++i) {
        w->reasons[i] = (unsigned char)(w->reasons[i] | (w->tried[i] ? TRACK_STRAYED : 0));
    }
}

static void rescue(const struct track_work *w, const struct track_memory *before)
{
    const int count = w->points->count;
    memset(w->tried, 0, (size_t)count);
    for (int round = 0; w->points->neighbours && round < MOST_ROUNDS; ++round) {
        if (!retry_by_neighbours(w)) {
            break;
        }
    }
    if (!w->rules->search_px || !any_lost(w)) {
        return;
    }
    retry_by_search(w, before);
    if (!w->points->neighbours) {
        return;
    }
    mark_covered(w);
    mark_strays(w);
    memset(w->tried, 0, (size_t)count);
    for (int round = 0; round < MOST_ROUNDS && retry_by_neighbours(w); ++round) {
    }
    mark_lone(w, before);
}

/* When few points are believed, those are believed no more: the whole scene has jumped, and they
 * sit on each other's neighbours. All wait where they were. */
static int lost_hold(const struct track_work *w, const struct track_memory *before)
{
    const int count = w->points->count;
    int good = 0;
    for (int i = 0; i < count; ++i) {
        good += !w->reasons[i];
    }
    if (!w->points->neighbours || good * 3 >= count) {
        return 0;
    }
    for (int i = 0; i < count; ++i) {
        w->reasons[i] = w->reasons[i] ? w->reasons[i] : TRACK_STRAYED;
        memcpy(w->poses + 6 * i, before->poses + 6 * i, 6 * sizeof(double));
    }
    memset(w->tried, 1, (size_t)count);
    return 1;
}

/* Lost points ride with their neighbours, from the found ones inwards; or wait. */
static void settle(const struct track_work *w, const struct track_memory *before)
{
    const int count = w->points->count;
    unsigned char *unplaced = w->tried;
    memcpy(unplaced, w->reasons, (size_t)count);
    for (int i = 0; i < count; ++i) {
        if (w->reasons[i]) {
            memcpy(w->poses + 6 * i, before->poses + 6 * i, 6 * sizeof(double));
            note_moved(w, i);
        }
    }
    int placed = w->points->neighbours > 0;
    for (int round = 0; placed && round < MOST_ROUNDS; ++round) {
        placed = 0;
        for (int i = 0; i < count; ++i) {
            double pose[6];
            if (unplaced[i] && place_by_neighbours(w, unplaced, i, pose)) {
                memcpy(w->poses + 6 * i, pose, sizeof pose);
                note_moved(w, i);
                unplaced[i] = 0;
                ++placed;
            }
        }
    }
}

static void remember(const struct track_work *w, const struct track_memory *before,
                     const struct track_memory *after)
{
    const int with = w->points->neighbours > 0;
    for (int i = 0; i < w->points->count; ++i) {
        const int moves = !w->reasons[i] || (with && !w->tried[i]);
        for (int k = 0; k < 2; ++k) {
            after->velocity[2 * i + k] =
                moves ? w->poses[6 * i + k] - before->poses[6 * i + k] : 0.0;
        }
    }
}

/* Is the template stretched along a row or a column by more than 1.4, or to less than two thirds,
 * or turned and stretched so that it will soon be refused? */
static int is_due(const double *f)
{
    const double across = f[0] * f[0] + f[1] * f[1], down = f[2] * f[2] + f[3] * f[3];
    const double wide = fabs(f[0]) + fabs(f[1]), high = fabs(f[2]) + fabs(f[3]);
    return across > 1.96 || down > 1.96 || across < 0.444 || down < 0.444 || wide > 1.65 ||
           high > 1.65;
}

static int report(const struct track_work *w, const struct track_found *found)
{
    int due = 0;
    for (int i = 0; i < w->points->count; ++i) {
        double at[4] = {NAN, NAN, NAN, NAN};
        found->quality[i] = (double)w->results[i].quality;
        if (!w->reasons[i]) {
            const double *pose = w->poses + 6 * i, *o = w->points->offset + 2 * i;
            at[0] = pose[0] + pose[2] * o[0] + pose[3] * o[1];
            at[1] = pose[1] + pose[4] * o[0] + pose[5] * o[1];
            memcpy(at + 2, w->stds + 2 * i, 2 * sizeof(double));
            due += is_due(pose + 2);
        }
        for (int k = 0; k < 4; ++k) {
            found->points[k * w->points->count + i] = at[k];
        }
    }
    return due;
}

static void *take(char **at, size_t bytes)
{
    void *here = *at;
    *at += aligned(bytes);
    return here;
}

struct track_summary track_step(const struct track_kernels *kernels,
                                const struct track_points *points, const struct track_rules *rules,
                                const struct track_frame *frame, const struct track_memory *before,
                                const struct track_memory *after, const struct track_found *found,
                                void *scratch)
{
    const size_t count = (size_t)points->count;
    char *at = (char *)(((uintptr_t)scratch + 63) / 64 * 64);
    struct track_patch whole;
    struct track_work w = {.kernels = kernels,
                           .points = points,
                           .rules = rules,
                           .frame = frame,
                           .poses = after->poses,
                           .reasons = after->reasons};
    w.expected = take(&at, count * 4 * sizeof(double));
    w.moved = take(&at, count * 2 * sizeof(double));
    w.excess = take(&at, count * sizeof(double));
    w.stds = take(&at, count * 2 * sizeof(double));
    w.results = take(&at, count * sizeof(struct track_result));
    w.tried = take(&at, count);
    w.refine = take(&at, track_scratch_size(points->side));
    w.search = take(&at, track_search_size(points->side, rules->search_px));
    if (filters_whole(points, frame)) {
        track_filter_frame(kernels, frame,
                           take(&at, track_coefficients_size(frame->width, frame->height)), &whole);
        w.whole = &whole;
    }
    predict(&w, before);
    for (int i = 0; i < points->count; ++i) {
        if (!w.whole && i + 1 < points->count) {
            const struct track_pose next = get_pose(w.poses + 6 * (ptrdiff_t)(i + 1));
            track_prefetch(frame, points->side, &next);
        }
        refine_point(&w, i);
    }
    double gain, excess;
    int agreed = find_common(&w, &w.common_excess, &gain);
    w.common_gain = *before->gain > 0.0 && !agreed ? *before->gain : gain;
    if (points->neighbours) {
        mark_covered(&w);
        mark_strays(&w);
    }
    if (any_lost(&w)) {
        rescue(&w, before);
        if (!lost_hold(&w, before)) {
            settle(&w, before);
        }
    }
    agreed = find_common(&w, &excess, &gain);
    *after->gain = gain_after(*before->gain, gain, agreed);
    remember(&w, before, after);
    struct track_summary summary = track_summarise(&w, before);
    summary.due = report(&w, found);
    summary.audit = track_audit_frame(points, found->points, w.expected); /* no longer needed */
    return summary;
}

void track_samples(const struct track_kernels *kernels, const struct track_points *points,
                   const struct track_frame *frame, const double *poses, float *out,
                   void *scratch)
{
    for (int i = 0; i < points->count; ++i) {
        const struct track_template t = template_of(points, i);
        const struct track_pose pose = get_pose(poses + 6 * (ptrdiff_t)i);
        float *row = out + (size_t)i * (size_t)points->stride;
        if (!track_sample(kernels, frame, &t, &pose, row, scratch)) {
            for (int n = 0; n < points->stride; ++n) {
                row[n] = NAN;
            }
        }
    }
}
