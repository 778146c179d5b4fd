/* See track.h. */
#include "track.h"

#include <math.h> /* floor, ceil, fabs, sqrtf, sqrt, isfinite */

enum { LANES = 8, MAX_UNKNOWNS = 6 };

/* Spline coefficients of the pixels around a subset. */
struct patch {
    float *values; /* values[(y - top) * pitch + (x - left)] */
    int left, top; /* frame position of the first coefficient */
    int columns, rows;
    int pitch;   /* floats from one row to the next */
    float pivot; /* grey level taken off before filtering */
};

/* Where the samples of one row of a subset lie, and their spline weights. */
struct row_plan {
    int at[TRACK_MAX_SIDE];
    float across[4][TRACK_MAX_SIDE], down[4][TRACK_MAX_SIDE];
};

static int patch_side(int side) { return (3 * side) / 2 + 2 * (TRACK_MARGIN + 3); }

size_t track_scratch_size(int side, int stride)
{
    const size_t edge = (size_t)((patch_side(side) + 7) / 8 * 8);
    return 2 * edge * edge + (size_t)stride;
}

static int clamp(int value, int last) { return value < 0 ? 0 : (value > last ? last : value); }

static float pixel(const struct track_frame *frame, int x, int y)
{
    const ptrdiff_t at = (ptrdiff_t)y * frame->pitch + x;
    return frame->bytes == 1 ? (float)((const unsigned char *)frame->pixels)[at]
                             : (float)((const unsigned short *)frame->pixels)[at];
}

/* `count` pixels of row `y` from `left` on, less the pivot, `step` floats apart; beyond the edges
 * the nearest pixel stands in. */
static void load_row(const struct track_frame *frame, int left, int y, int count, float pivot,
                     float *restrict out, ptrdiff_t step)
{
    const int row = clamp(y, frame->height - 1);
    const ptrdiff_t first = (ptrdiff_t)row * frame->pitch + left;
    if (left < 0 || left + count > frame->width) {
        for (int i = 0; i < count; ++i) {
            out[i * step] = pixel(frame, clamp(left + i, frame->width - 1), row) - pivot;
        }
    } else if (frame->bytes == 1) {
        const unsigned char *restrict in = (const unsigned char *)frame->pixels + first;
        for (int i = 0; i < count; ++i) {
            out[i * step] = (float)in[i] - pivot;
        }
    } else {
        const unsigned short *restrict in = (const unsigned short *)frame->pixels + first;
        for (int i = 0; i < count; ++i) {
            out[i * step] = (float)in[i] - pivot;
        }
    }
}

/* B-spline prefilter down the rows, all columns at once: pole z = sqrt(3) - 2. */
static void prefilter(float *values, int rows, int pitch)
{
    const float z = -0.267949192431f;
    for (int i = 0; i < pitch; ++i) {
        values[i] *= 6.0f / (1.0f - z);
    }
    for (int r = 1; r < rows; ++r) {
        const float *restrict before = values + (ptrdiff_t)(r - 1) * pitch;
        float *restrict now = values + (ptrdiff_t)r * pitch;
        for (int i = 0; i < pitch; ++i) {
            now[i] = 6.0f * now[i] + z * before[i];
        }
    }
    float *restrict last = values + (ptrdiff_t)(rows - 1) * pitch;
    for (int i = 0; i < pitch; ++i) {
        last[i] *= -z / (1.0f - z);
    }
    for (int r = rows - 2; r >= 0; --r) {
        const float *restrict after = values + (ptrdiff_t)(r + 1) * pitch;
        float *restrict now = values + (ptrdiff_t)r * pitch;
        for (int i = 0; i < pitch; ++i) {
            now[i] = z * (after[i] - now[i]);
        }
    }
}

/* Half width and half height of the deformed subset, px. */
static void extent(const struct track_pose *pose, int side, double *half_x, double *half_y)
{
    const double half = 0.5 * (side - 1);
    *half_x = half * (fabs(pose->f[0]) + fabs(pose->f[1]));
    *half_y = half * (fabs(pose->f[2]) + fabs(pose->f[3]));
}

/* TRACK_CONVERGED when the whole deformed subset can be sampled, else why not. */
static enum track_status check_pose(const struct track_frame *frame, int side,
                                    const struct track_pose *pose)
{
    double half_x, half_y;
    extent(pose, side, &half_x, &half_y);
    const double most = 0.75 * (side - 1);
    if (!isfinite(pose->x) || !isfinite(pose->y) || !(half_x <= most) || !(half_y <= most)) {
        return TRACK_DEFORMED;
    }
    if (pose->x - half_x < 0.0 || pose->x + half_x > frame->width - 1.0 ||
        pose->y - half_y < 0.0 || pose->y + half_y > frame->height - 1.0) {
        return TRACK_OUTSIDE;
    }
    return TRACK_CONVERGED;
}

static void load_patch(const struct track_frame *frame, int side, const struct track_pose *pose,
                       struct patch *patch, float *scratch)
{
    double half_x, half_y;
    extent(pose, side, &half_x, &half_y);
    const int edge = (patch_side(side) + 7) / 8 * 8;
    patch->left = (int)floor(pose->x - half_x) - 1 - TRACK_MARGIN;
    patch->top = (int)floor(pose->y - half_y) - 1 - TRACK_MARGIN;
    patch->columns = (int)ceil(pose->x + half_x) + 2 + TRACK_MARGIN - patch->left;
    patch->rows = (int)ceil(pose->y + half_y) + 2 + TRACK_MARGIN - patch->top;
    patch->pivot = pixel(frame, (int)pose->x, (int)pose->y);
    patch->pitch = (patch->columns + 3) / 4 * 4;
    const int turned_pitch = (patch->rows + 3) / 4 * 4;
    float *turned = scratch; /* filtered along x while x counts the rows */
    patch->values = scratch + (ptrdiff_t)edge * edge;
    for (int r = 0; r < turned_pitch; ++r) {
        load_row(frame, patch->left, patch->top + r, patch->columns, patch->pivot, turned + r,
                 turned_pitch);
    }
    prefilter(turned, patch->columns, turned_pitch);
    for (int r = 0; r < patch->rows; ++r) {
        float *restrict row = patch->values + (ptrdiff_t)r * patch->pitch;
        for (int c = 0; c < patch->pitch; ++c) {
            row[c] = c < patch->columns ? turned[(ptrdiff_t)c * turned_pitch + r] : 0.0f;
        }
    }
    prefilter(patch->values, patch->rows, patch->pitch);
}

/* Does the patch still hold all that the pose needs, less than a pixel into the margin? */
static int patch_covers(const struct patch *patch, int side, const struct track_pose *pose)
{
    double half_x, half_y;
    extent(pose, side, &half_x, &half_y);
    const int spare = TRACK_MARGIN - 1;
    return pose->x - half_x - 1.0 >= patch->left + spare &&
           pose->x + half_x + 2.0 < patch->left + patch->columns - spare &&
           pose->y - half_y - 1.0 >= patch->top + spare &&
           pose->y + half_y + 2.0 < patch->top + patch->rows - spare;
}

static void spline_weights(float t, float *restrict w)
{
    const float s = 1.0f - t;
    w[0] = s * s * s * (1.0f / 6.0f);
    w[1] = (2.0f / 3.0f) - t * t * (1.0f - 0.5f * t);
    w[2] = (2.0f / 3.0f) - s * s * (1.0f - 0.5f * s);
    w[3] = t * t * t * (1.0f / 6.0f);
}

/* The undeformed subset: all samples share one fraction of a pixel, so the spline separates. */
static void sample_shifted(const struct patch *patch, int side, float x, float y,
                           float *restrict out)
{
    const int left = (int)x, top = (int)y; /* positive: truncation is floor */
    float across[4], down[4], line[TRACK_MAX_SIDE + 3];
    spline_weights(x - (float)left, across);
    spline_weights(y - (float)top, down);
    for (int j = 0; j < side; ++j) {
        const float *r0 = patch->values + (ptrdiff_t)(top - 1 + j) * patch->pitch + left - 1;
        const float *r1 = r0 + patch->pitch, *r2 = r1 + patch->pitch, *r3 = r2 + patch->pitch;
        for (int i = 0; i < side + 3; ++i) {
            line[i] = (down[0] * r0[i] + down[1] * r1[i]) + (down[2] * r2[i] + down[3] * r3[i]);
        }
        for (int i = 0; i < side; ++i) {
            out[j * side + i] = (across[0] * line[i] + across[1] * line[i + 1]) +
                                (across[2] * line[i + 2] + across[3] * line[i + 3]);
        }
    }
}

/* Samples (x + i * dx, y + i * dy) of the patch: first coefficient and weights of each. */
static void plan_row(const struct patch *patch, int side, float x, float y, float dx, float dy,
                     struct row_plan *restrict plan)
{
    for (int i = 0; i < side; ++i) {
        const float sx = x + dx * (float)i, sy = y + dy * (float)i;
        const int column = (int)sx, row = (int)sy;
        const float t = sx - (float)column, s = 1.0f - t;
        const float q = sy - (float)row, p = 1.0f - q;
        plan->at[i] = (row - 1) * patch->pitch + column - 1;
        plan->across[0][i] = s * s * s * (1.0f / 6.0f);
        plan->across[1][i] = (2.0f / 3.0f) - t * t * (1.0f - 0.5f * t);
        plan->across[2][i] = (2.0f / 3.0f) - s * s * (1.0f - 0.5f * s);
        plan->across[3][i] = t * t * t * (1.0f / 6.0f);
        plan->down[0][i] = p * p * p * (1.0f / 6.0f);
        plan->down[1][i] = (2.0f / 3.0f) - q * q * (1.0f - 0.5f * q);
        plan->down[2][i] = (2.0f / 3.0f) - p * p * (1.0f - 0.5f * p);
        plan->down[3][i] = q * q * q * (1.0f / 6.0f);
    }
}

static float sample(const float *restrict c, ptrdiff_t pitch, const struct row_plan *plan, int i)
{
    float sum[4];
    for (int k = 0; k < 4; ++k) {
        sum[k] = (plan->down[0][i] * c[k] + plan->down[1][i] * c[pitch + k]) +
                 (plan->down[2][i] * c[2 * pitch + k] + plan->down[3][i] * c[3 * pitch + k]);
    }
    return (sum[0] * plan->across[0][i] + sum[1] * plan->across[1][i]) +
           (sum[2] * plan->across[2][i] + sum[3] * plan->across[3][i]);
}

/* The frame under the deformed subset, less the pivot, row by row; zeros in the padding. */
static void sample_subset(const struct patch *patch, const struct track_template *t,
                          const struct track_pose *pose, float *restrict out)
{
    const float half = (float)(t->side / 2);
    const float x0 = (float)(pose->x - patch->left), y0 = (float)(pose->y - patch->top);
    const float fxx = (float)pose->f[0], fxy = (float)pose->f[1];
    const float fyx = (float)pose->f[2], fyy = (float)pose->f[3];
    struct row_plan plan;
    for (int n = t->side * t->side; n < t->stride; ++n) {
        out[n] = 0.0f;
    }
    if (fxx == 1.0f && fyy == 1.0f && fxy == 0.0f && fyx == 0.0f) {
        sample_shifted(patch, t->side, x0 - half, y0 - half, out);
        return;
    }
    for (int j = 0; j < t->side; ++j) {
        const float eta = (float)j - half;
        plan_row(patch, t->side, x0 + fxy * eta - fxx * half, y0 + fyy * eta - fyx * half, fxx,
                 fyx, &plan);
        for (int i = 0; i < t->side; ++i) {
            out[j * t->side + i] = sample(patch->values + plan.at[i], patch->pitch, &plan, i);
        }
    }
}

static float dot(const float *restrict a, const float *restrict b, int count)
{
    float lane[LANES] = {0.0f};
    for (int i = 0; i < count; i += LANES) {
        for (int k = 0; k < LANES; ++k) {
            lane[k] += a[i + k] * b[i + k];
        }
    }
    return ((lane[0] + lane[4]) + (lane[1] + lane[5])) +
           ((lane[2] + lane[6]) + (lane[3] + lane[7]));
}

static float total(const float *restrict a, int count)
{
    float lane[LANES] = {0.0f};
    for (int i = 0; i < count; i += LANES) {
        for (int k = 0; k < LANES; ++k) {
            lane[k] += a[i + k];
        }
    }
    return ((lane[0] + lane[4]) + (lane[1] + lane[5])) +
           ((lane[2] + lane[6]) + (lane[3] + lane[7]));
}

/* Correlation, gain, level and weighted residual of the samples w. */
static void compare(const struct track_template *t, const float *restrict w, float pivot,
                    struct track_result *result)
{
    const float mean = total(w, t->stride) / (float)(t->side * t->side);
    const float spread = dot(w, w, t->stride) - mean * mean * (float)(t->side * t->side);
    const float amplitude = dot(t->shape, w, t->stride);
    float lane[LANES] = {0.0f};
    for (int i = 0; i < t->stride; i += LANES) {
        for (int k = 0; k < LANES; ++k) {
            const float r = w[i + k] - mean - amplitude * t->shape[i + k];
            lane[k] += t->weight[i + k] * r * r;
        }
    }
    result->residual = total(lane, LANES);
    result->amplitude = amplitude;
    result->level = mean + pivot;
    result->quality = spread > 0.0f ? amplitude / sqrtf(spread) : 0.0f;
}

/* Composes the pose with the inverse of the step; returns the step's size in px (rms over the
 * subset), or -1 when it is too large to be one. */
static float apply_step(const struct track_template *t, const float *step, struct track_pose *pose)
{
    const float half = 0.5f * (float)(t->side - 1);
    float u = step[0], v = step[1], bend = 0.0f;
    if (t->unknowns == 6) {
        v = step[3];
        bend = step[1] * step[1] + step[2] * step[2] + step[4] * step[4] + step[5] * step[5];
        const double a = 1.0 + step[1], b = step[2], c = step[4], d = 1.0 + step[5];
        const double determinant = a * d - b * c;
        if (!(determinant > 0.1)) {
            return -1.0f;
        }
        const double f0 = pose->f[0], f1 = pose->f[1], f2 = pose->f[2], f3 = pose->f[3];
        pose->f[0] = (f0 * d - f1 * c) / determinant;
        pose->f[1] = (f1 * a - f0 * b) / determinant;
        pose->f[2] = (f2 * d - f3 * c) / determinant;
        pose->f[3] = (f3 * a - f2 * b) / determinant;
    }
    const float size = sqrtf(u * u + v * v + bend * half * half / 3.0f);
    if (!(size <= half)) {
        return -1.0f;
    }
    pose->x -= pose->f[0] * u + pose->f[1] * v;
    pose->y -= pose->f[2] * u + pose->f[3] * v;
    return size;
}

/* One Gauss-Newton step from the samples w; the step's size in px, or -1 when it diverged. */
static float gauss_newton(const struct track_template *t, const float *w, float amplitude,
                          struct track_pose *pose)
{
    float rhs[MAX_UNKNOWNS] = {0.0f}, step[MAX_UNKNOWNS] = {0.0f};
    if (!(amplitude > 0.0f)) {
        return -1.0f;
    }
    for (int m = 0; m < t->unknowns; ++m) {
        rhs[m] = dot(t->gradient + (ptrdiff_t)m * t->stride, w, t->stride) / amplitude;
    }
    for (int m = 0; m < t->unknowns; ++m) {
        step[m] = 0.0f;
        for (int k = 0; k < t->unknowns; ++k) {
            step[m] += t->inverse[m * t->unknowns + k] * rhs[k];
        }
    }
    return apply_step(t, step, pose);
}

void track_refine(const struct track_frame *frame, const struct track_template *t,
                  const struct track_settings *settings, struct track_pose *pose,
                  struct track_result *result, float *scratch)
{
    const int edge = (patch_side(t->side) + 7) / 8 * 8;
    float *w = scratch + 2 * (ptrdiff_t)edge * edge;
    struct patch patch = {0};
    enum track_status status = TRACK_SLOW;
    int iteration = 0;
    *result = (struct track_result){0};
    while (status == TRACK_SLOW && iteration < settings->max_iterations) {
        const enum track_status usable = check_pose(frame, t->side, pose);
        if (usable != TRACK_CONVERGED) {
            status = usable;
            break;
        }
        if (iteration == 0 || !patch_covers(&patch, t->side, pose)) {
            load_patch(frame, t->side, pose, &patch, scratch);
        }
        sample_subset(&patch, t, pose, w);
        compare(t, w, patch.pivot, result);
        const float size = gauss_newton(t, w, result->amplitude, pose);
        if (size < 0.0f) {
            status = TRACK_DIVERGED;
        } else if (size < settings->tolerance_px) {
            status = TRACK_CONVERGED;
        }
        ++iteration;
    }
    result->iterations = (float)iteration;
    result->status = (float)status;
}

float track_search(const struct track_frame *frame, const struct track_template *t, int radius,
                   struct track_pose *pose, float *scratch)
{
    const int half = t->side / 2;
    const int x0 = (int)floor(pose->x + 0.5), y0 = (int)floor(pose->y + 0.5);
    float best = -2.0f;
    float *w = scratch;
    int best_x = x0, best_y = y0;
    for (int n = t->side * t->side; n < t->stride; ++n) {
        w[n] = 0.0f;
    }
    for (int y = y0 - radius; y <= y0 + radius; ++y) {
        for (int x = x0 - radius; x <= x0 + radius; ++x) {
            if (x < half || y < half || x + half >= frame->width || y + half >= frame->height) {
                continue;
            }
            const float pivot = pixel(frame, x, y);
            for (int j = 0; j < t->side; ++j) {
                load_row(frame, x - half, y - half + j, t->side, pivot, w + j * t->side, 1);
            }
            struct track_result here;
            compare(t, w, pivot, &here);
            if (here.quality > best) {
                best = here.quality;
                best_x = x;
                best_y = y;
            }
        }
    }
    pose->x = best_x;
    pose->y = best_y;
    return best;
}
