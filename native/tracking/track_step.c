/* See track_step.h. */
#include "tracking/track_step.h"

#include <math.h>   /* sqrt, fabs, NAN */
#include <string.h> /* memcpy, memset */

#include "tracking/track_neighbours.h"
#include "tracking/track_work.h"

enum { FEWEST = TRACK_FEWEST, SAMPLE = 50 };

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
        w->poses[i] = before->poses[i];
        w->poses[i].x += vx;
        w->poses[i].y += vy;
        track_note_moved(w, i);
    }
    for (int i = 0; k_all && i < p->count; ++i) {
        double *g = w->expected + 4 * i;
        track_full_gradient(p, w->moved, i, g);
        track_put_deformation(g, p->base + 4 * i, w->poses[i].f);
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

void track_mark_strays(const struct track_work *w)
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
    const double norm = (double)w->points->noise[i].norm;
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

int track_is_covered(const struct track_work *w, int i)
{
    const double gain = gain_of(w, i), most = (double)w->rules->most_gain;
    return w->excess[i] > (double)w->rules->most_residual * w->common_excess ||
           gain > most * w->common_gain || gain * most < w->common_gain;
}

void track_mark_covered(const struct track_work *w)
{
    for (int i = 0; i < w->points->count; ++i) {
        if (!w->reasons[i] && track_is_covered(w, i)) {
            w->reasons[i] = TRACK_COVERED;
        }
    }
}

static void remember(const struct track_work *w, const struct track_memory *before,
                     const struct track_memory *after)
{
    const int with = w->points->neighbours > 0;
    for (int i = 0; i < w->points->count; ++i) {
        const int moves = !w->reasons[i] || (with && !w->tried[i]);
        after->velocity[2 * i] = moves ? w->poses[i].x - before->poses[i].x : 0.0;
        after->velocity[2 * i + 1] = moves ? w->poses[i].y - before->poses[i].y : 0.0;
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
        const struct track_pose *pose = &w->poses[i];
        const double *o = w->points->offset + 2 * i;
        const int good = !w->reasons[i];
        found->x[i] = good ? pose->x + pose->f[0] * o[0] + pose->f[1] * o[1] : NAN;
        found->y[i] = good ? pose->y + pose->f[2] * o[0] + pose->f[3] * o[1] : NAN;
        found->std_x[i] = good ? w->stds[2 * i] : NAN;
        found->std_y[i] = good ? w->stds[2 * i + 1] : NAN;
        found->quality[i] = (double)w->results[i].quality;
        due += good && is_due(pose->f);
    }
    return due;
}

enum { FEW = 25 };

/* See struct track_summary; medians over a sample of the believed points. */
static struct track_summary summarise(const struct track_work *w, const struct track_memory *before)
{
    double surprise[2 * FEW], level[2 * FEW];
    const int count = w->points->count, step = count / FEW + 1;
    struct track_summary s = {0};
    int kept = 0;
    for (int i = 0; i < count; ++i) {
        s.believed_before += !before->reasons[i];
        s.ambiguous += (before->reasons[i] & TRACK_AMBIGUOUS) != 0;
        s.strayed += (w->reasons[i] & TRACK_STRAYED) != 0;
        if (w->reasons[i]) {
            s.newly_lost += !before->reasons[i] && !(w->reasons[i] & TRACK_LEFT);
            continue;
        }
        const struct track_pose *now = &w->poses[i], *then = &before->poses[i];
        const double x = fabs(now->x - then->x - before->velocity[2 * i]);
        const double y = fabs(now->y - then->y - before->velocity[2 * i + 1]);
        const float away = (float)(x > y ? x : y);
        const double *std = w->stds + 2 * i;
        const float wide = (float)(std[0] > std[1] ? std[0] : std[1]);
        ++s.believed;
        s.most_surprise_px = away > s.most_surprise_px ? away : s.most_surprise_px;
        s.largest_std_px = wide > s.largest_std_px ? wide : s.largest_std_px;
        if (i % step == 0) {
            const float reference = w->points->noise[i].level;
            surprise[kept] = (double)away;
            level[kept++] = (double)(w->results[i].level / (reference > 1.0f ? reference : 1.0f));
        }
    }
    if (kept) {
        const double middle = track_median(level, kept);
        s.surprise_px = (float)track_median(surprise, kept);
        for (int k = 0; k < kept; ++k) {
            level[k] = fabs(level[k] - middle);
        }
        track_median(level, kept); /* sorts */
        s.unevenness = (float)(level[kept * 9 / 10] / (middle > 1e-3 ? middle : 1e-3));
    }
    return s;
}

static float farthest(const struct track_work *w)
{
    float most = 0.0f;
    for (int i = 0; i < w->points->count; ++i) {
        most = w->results[i].reach > most ? w->results[i].reach : most;
    }
    return most;
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
            track_prefetch(frame, points->side, &w.poses[i + 1]);
        }
        track_refine_point(&w, i);
    }
    double gain, excess;
    const float reach = farthest(&w);
    int agreed = find_common(&w, &w.common_excess, &gain);
    w.common_gain = *before->gain > 0.0 && !agreed ? *before->gain : gain;
    if (points->neighbours) {
        track_mark_covered(&w);
        track_mark_strays(&w);
    }
    const int searched = track_any_lost(&w);
    if (searched) {
        track_rescue(&w, before);
        if (!track_lost_hold(&w, before)) {
            track_settle(&w, before);
        }
    }
    agreed = find_common(&w, &excess, &gain);
    *after->gain = gain_after(*before->gain, gain, agreed);
    remember(&w, before, after);
    struct track_summary summary = summarise(&w, before);
    summary.reach_px = searched ? track_larger_side(frame) : reach;
    summary.due = report(&w, found);
    summary.audit = track_audit_frame(points, found, w.expected); /* no longer needed */
    return summary;
}

void track_samples(const struct track_kernels *kernels, const struct track_points *points,
                   const struct track_frame *frame, const struct track_pose *poses, float *out,
                   void *scratch)
{
    for (int i = 0; i < points->count; ++i) {
        const struct track_template t = track_template_of(points, i);
        float *row = out + (size_t)i * (size_t)points->stride;
        if (!track_sample(kernels, frame, &t, &poses[i], row, scratch)) {
            for (int n = 0; n < points->stride; ++n) {
                row[n] = NAN;
            }
        }
    }
}
