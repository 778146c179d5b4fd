/* One point in a frame: found by track_refine, then judged; see track_step.h. */
#include <math.h> /* sqrt, fabs */

#include "tracking/track_work.h"

/* Contrast, in standard deviations of what noise alone shows of any template: the best of the
 * 25 x 25 places of a search reaches 3.2 of them. And the largest deviation of a place. */
static const double LEAST_CONTRAST = 5.0, MOST_STD_PX = 1.0;

struct track_template track_template_of(const struct track_points *p, int i)
{
    const size_t n = (size_t)i, stride = (size_t)p->stride, m = (size_t)p->unknowns;
    const struct track_template t = {p->shape + n * stride, p->gradient + 2 * n * stride,
                                     p->inverse + n * m * m, p->place,
                                     p->side,                p->stride,
                                     p->unknowns};
    return t;
}

void track_put_deformation(const double *gradient, const double *base, double *f)
{
    const double a = 1.0 + gradient[0], b = gradient[1], c = gradient[2], d = 1.0 + gradient[3];
    f[0] = a * base[0] + b * base[2];
    f[1] = a * base[1] + b * base[3];
    f[2] = c * base[0] + d * base[2];
    f[3] = c * base[1] + d * base[3];
}

void track_note_moved(const struct track_work *w, int i)
{
    w->moved[2 * i] = w->poses[i].x - w->points->centre[2 * i];
    w->moved[2 * i + 1] = w->poses[i].y - w->points->centre[2 * i + 1];
}

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
    const struct track_noise *noise = &w->points->noise[i];
    const float gain = r->amplitude / noise->norm;
    const float now = variance_at(rules, r->level) * white_share(w->points, w->poses[i].x) *
                      white_share(w->points, w->poses[i].y);
    const float rest = gain * gain * variance_at(rules, noise->level) * noise->averaged;
    return r->residual / noise->residual_share / (now + rest);
}

/* Standard deviations of point i's displacement: the noise of both ends through the solve, widened
 * where the match leaves more than the noise explains (the Birge ratio). A subset that covers
 * fewer pixels of the frame than of the reference samples their noise more densely. */
static void deviations(const struct track_work *w, int i, double *std)
{
    const struct track_rules *rules = w->rules;
    const struct track_result *r = &w->results[i];
    const struct track_noise *noise = &w->points->noise[i];
    const double amplitude = (double)(r->amplitude > 1e-6f ? r->amplitude : 1e-6f);
    const double even = (double)variance_at(rules, r->level) / (amplitude * amplitude);
    const double shaped = (double)rules->noise_slope / amplitude;
    double c[3], ratio = w->excess[i];
    if (rules->noise_known && ratio < 1.0) {
        ratio = 1.0;
    }
    const double *f = w->poses[i].f;
    const double denser = 1.0 / fabs(f[0] * f[3] - f[1] * f[2]);
    for (int k = 0; k < 3; ++k) {
        c[k] = denser * (even * (double)noise->even[k] + shaped * (double)noise->shaped[k]) +
               (double)noise->reference[k];
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

void track_refine_point(const struct track_work *w, int i)
{
    const struct track_template t = track_template_of(w->points, i);
    struct track_pose pose = w->poses[i];
    track_refine(w->kernels, w->frame, w->whole, &t, &w->rules->settings, &pose, &w->results[i],
                 w->refine);
    w->poses[i] = pose;
    w->excess[i] = w->results[i].amplitude > 0.0f ? (double)residual_ratio(w, i) : 1e9;
    w->reasons[i] = judge(w, i);
    track_note_moved(w, i);
}
