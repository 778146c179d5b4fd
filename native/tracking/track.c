/* See track.h. */
#include "tracking/track.h"

#include <math.h>   /* ceil, fabs, sqrtf, isfinite */
#include <string.h> /* strcmp, memset */

#include "tracking/kernels/track_kernels.h"

enum {
    BLOCK = 32,
    BORDER = 4,         /* px around the frame that its coefficients reach */
    TILE_COLUMNS = 114, /* of a frame that are filtered at a time: 128 px of the frame, ... */
    TILE_ROWS = 64      /* ... and both buffers stay in the fastest cache */
};

/* Coefficient steps to a grey step of the 10-bit pixels: (37632 / (6 * 14 * 194))^2. */
#define FILTER_GAIN 5.3327800f

static int rounded_up(int count) { return (count + BLOCK - 1) / BLOCK * BLOCK; }
/* floor without the library's call; the value fits an int */
static int floored(double value)
{
    const int whole = (int)value;
    return whole - (value < whole);
}

static int clamp(int value, int last) { return value < 0 ? 0 : (value > last ? last : value); }

/* ---- the choice of kernels ---------------------------------------------------------------- */

const struct track_kernels *track_select(const char *name)
{
#ifdef HASELAB_TRACK_X86
    __builtin_cpu_init();
    if ((!*name || !strcmp(name, "avx512")) && __builtin_cpu_supports("avx512f") &&
        __builtin_cpu_supports("avx512bw") && __builtin_cpu_supports("avx512dq") &&
        __builtin_cpu_supports("avx512vl")) {
        return &track_avx512;
    }
    if ((!*name || !strcmp(name, "avx2")) && __builtin_cpu_supports("avx2")) {
        return &track_avx2;
    }
#endif
    return (!*name || !strcmp(name, "portable")) ? &track_portable : NULL;
}

const char *track_kernels_name(const struct track_kernels *kernels) { return kernels->name; }

/* ---- memory ------------------------------------------------------------------------------- */

/* Coefficients that the most deformed subset needs along one axis. */
static int widest(int side) { return (9 * side) / 5 + 7; }

/* int16 entries of one buffer of pixels on the way through the filter. */
static size_t buffer_size(int columns, int rows)
{
    return (size_t)rounded_up(columns + 2 * TRACK_REACH) * (size_t)(rows + 2 * TRACK_REACH) +
           2 * BLOCK;
}

static size_t stride_of(int side) { return (size_t)((side * side + 15) / 16 * 16); }

size_t track_scratch_size(int side)
{
    const int most = widest(side);
    const size_t entries = 2 * buffer_size(most, most) +
                           (size_t)(rounded_up(most) + BLOCK) * (size_t)(most + 1);
    return entries * sizeof(int16_t) + (stride_of(side) + 2 * TRACK_LANES) * sizeof(float);
}

static int frame_pitch(int width) { return rounded_up(width + 2 * BORDER) + BLOCK; }

size_t track_coefficients_size(int width, int height)
{
    const int pitch = frame_pitch(width);
    return sizeof(int16_t) *
           (2 * buffer_size(TILE_COLUMNS, TILE_ROWS) +
            (size_t)pitch * (size_t)(height + 2 * BORDER + 1) + 2 * BLOCK);
}

/* ---- coefficients ------------------------------------------------------------------------- */

static int pixel(const struct track_frame *frame, int x, int y)
{
    const ptrdiff_t at = (ptrdiff_t)clamp(y, frame->height - 1) * frame->pitch +
                         clamp(x, frame->width - 1);
    return frame->bytes == 1 ? ((const unsigned char *)frame->pixels)[at]
                             : ((const unsigned short *)frame->pixels)[at];
}

/* `count` pixels from (left, y) on; beyond the edges the nearest pixel stands in. */
static void load_row(const struct track_kernels *kernels, const struct track_frame *frame,
                     int left, int y, int count, int16_t *out)
{
    const int wide = rounded_up(count);
    const ptrdiff_t first = (ptrdiff_t)clamp(y, frame->height - 1) * frame->pitch + left;
    const ptrdiff_t all = (ptrdiff_t)(frame->height - 1) * frame->pitch + frame->width;
    if (left >= 0 && left + count <= frame->width && first + wide <= all) {
        kernels->widen((const char *)frame->pixels + first * frame->bytes, wide, frame->bytes,
                       frame->bits, out);
        return;
    }
    for (int k = 0; k < wide; k += BLOCK) {
        unsigned short line[BLOCK];
        if (left + k >= 0 && left + k + BLOCK <= frame->width) {
            kernels->widen((const char *)frame->pixels + (first + k) * frame->bytes, BLOCK,
                           frame->bytes, frame->bits, out + k);
            continue;
        }
        for (int i = 0; i < BLOCK; ++i) {
            line[i] = (unsigned short)pixel(frame, left + k + i, y);
        }
        kernels->widen(line, BLOCK, 2, frame->bits, out + k);
    }
}

/* Coefficients of columns x rows px from (left, top) on. */
static void filter_part(const struct track_kernels *kernels, const struct track_frame *frame,
                        int left, int top, int columns, int rows, int16_t *buffers, int16_t *out,
                        int out_pitch)
{
    const int pitch = rounded_up(columns + 2 * TRACK_REACH);
    const int x = left - TRACK_REACH, y = top - TRACK_REACH, all = rows + 2 * TRACK_REACH;
    int16_t *work = buffers + buffer_size(columns, rows);
    const ptrdiff_t last = (ptrdiff_t)(y + all - 1) * frame->pitch + x + pitch + 2;
    if (frame->bytes == 1 && x >= 0 && y >= 0 && y + all <= frame->height &&
        left + columns + TRACK_REACH <= frame->width &&
        last <= (ptrdiff_t)(frame->height - 1) * frame->pitch + frame->width) {
        kernels->filter_bytes((const unsigned char *)frame->pixels + y * frame->pitch + x,
                              frame->pitch, buffers, work, columns, rows, pitch, out, out_pitch);
        return;
    }
    for (int r = 0; r < all; ++r) {
        load_row(kernels, frame, x, y + r, columns + 2 * TRACK_REACH,
                 buffers + (ptrdiff_t)r * pitch);
    }
    kernels->filter(buffers, work, columns, rows, pitch, out, out_pitch);
}

static int smaller(int a, int b) { return a < b ? a : b; }

void track_filter_frame(const struct track_kernels *kernels, const struct track_frame *frame,
                        int16_t *coefficients, struct track_patch *patch)
{
    const int columns = frame->width + 2 * BORDER, rows = frame->height + 2 * BORDER;
    const int pitch = frame_pitch(frame->width);
    int16_t *out = coefficients + 2 * buffer_size(TILE_COLUMNS, TILE_ROWS);
    for (int top = 0; top < rows; top += TILE_ROWS) {
        for (int left = 0; left < columns; left += TILE_COLUMNS) {
            filter_part(kernels, frame, left - BORDER, top - BORDER,
                        smaller(TILE_COLUMNS, columns - left), smaller(TILE_ROWS, rows - top),
                        coefficients, out + (ptrdiff_t)top * pitch + left, pitch);
        }
    }
    *patch = (struct track_patch){out, -BORDER, -BORDER, columns, rows, pitch};
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
    const double most = 0.9 * (side - 1);
    if (!isfinite(pose->x) || !isfinite(pose->y) || !(half_x <= most) || !(half_y <= most)) {
        return TRACK_DEFORMED;
    }
    if (pose->x - half_x < 0.0 || pose->x + half_x > frame->width - 1.0 ||
        pose->y - half_y < 0.0 || pose->y + half_y > frame->height - 1.0) {
        return TRACK_OUTSIDE;
    }
    return TRACK_CONVERGED;
}

static void load_patch(const struct track_kernels *kernels, const struct track_frame *frame,
                       int side, const struct track_pose *pose, struct track_patch *patch,
                       int16_t *scratch)
{
    double half_x, half_y;
    extent(pose, side, &half_x, &half_y);
    patch->left = floored(pose->x - half_x) - 1;
    patch->top = floored(pose->y - half_y) - 1;
    patch->columns = floored(pose->x + half_x) + 3 - patch->left;
    patch->rows = floored(pose->y + half_y) + 3 - patch->top;
    patch->pitch = rounded_up(patch->columns);
    int16_t *out = scratch + 2 * buffer_size(widest(side), widest(side));
    filter_part(kernels, frame, patch->left, patch->top, patch->columns, patch->rows, scratch, out,
                patch->pitch);
    patch->values = out;
}

/* Distance along x or y to the farthest pixel that the patch was filtered from, px. */
static float reach_of(const struct track_patch *patch, double x, double y)
{
    const double left = x - (patch->left - TRACK_REACH), above = y - (patch->top - TRACK_REACH);
    const double right = patch->left + patch->columns - 1 + TRACK_REACH - x;
    const double below = patch->top + patch->rows - 1 + TRACK_REACH - y;
    return (float)fmax(fmax(left, right), fmax(above, below));
}

/* Does the patch hold all that the pose needs? */
static int patch_covers(const struct track_patch *patch, int side, const struct track_pose *pose)
{
    double half_x, half_y;
    extent(pose, side, &half_x, &half_y);
    return pose->x - half_x - 1.0 >= patch->left && pose->y - half_y - 1.0 >= patch->top &&
           pose->x + half_x + 3.0 < patch->left + patch->columns + 1 &&
           pose->y + half_y + 3.0 < patch->top + patch->rows + 1;
}

void track_prefetch(const struct track_frame *frame, int side, const struct track_pose *pose)
{
    double half_x, half_y;
    extent(pose, side, &half_x, &half_y);
    const double reach = TRACK_REACH + 2;
    if (!(pose->x - half_x > reach) || !(pose->y - half_y > reach) ||
        !(pose->x + half_x + reach < frame->width) || !(pose->y + half_y + reach < frame->height)) {
        return;
    }
    const int left = (int)(pose->x - half_x - reach), right = (int)(pose->x + half_x + reach);
    const int bottom = (int)(pose->y + half_y + reach);
    for (int y = (int)(pose->y - half_y - reach); y <= bottom; ++y) {
        const char *row = (const char *)frame->pixels + y * frame->pitch * frame->bytes;
        for (int x = left * frame->bytes; x < right * frame->bytes; x += 64) {
            __builtin_prefetch(row + x, 0, 2);
        }
        __builtin_prefetch(row + right * frame->bytes, 0, 2);
    }
}

/* ---- the solve ---------------------------------------------------------------------------- */

static int32_t fixed_point(double value)
{
    return floored(value * (double)(1 << TRACK_FRACTION_BITS) + 0.5);
}

/* Where the samples of the pose lie in the patch. The origin is put beside the subset, so that
 * positions fit 32 bits in a frame of any size. */
static struct track_grid lay_grid(const struct track_patch *patch, const struct track_template *t,
                                  const struct track_frame *frame, const struct track_pose *pose)
{
    double half_x, half_y;
    extent(pose, t->side, &half_x, &half_y);
    const double half = 0.5 * (t->side - 1);
    const int left = floored(pose->x - half_x) - 2, top = floored(pose->y - half_y) - 2;
    const struct track_grid grid = {
        .values = patch->values + (ptrdiff_t)(top - patch->top) * patch->pitch + left - patch->left,
        .pitch = patch->pitch,
        .x = fixed_point(pose->x - left - half * (pose->f[0] + pose->f[1])),
        .y = fixed_point(pose->y - top - half * (pose->f[2] + pose->f[3])),
        .along_x = fixed_point(pose->f[0]),
        .along_y = fixed_point(pose->f[2]),
        .down_x = fixed_point(pose->f[1]),
        .down_y = fixed_point(pose->f[3]),
        .side = t->side,
        .stride = t->stride,
        .scale = (float)(1 << (frame->bits - 8)) / (4.0f * FILTER_GAIN * 32768.0f)};
    return grid;
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
        const double a = 1.0 + (double)step[1], b = (double)step[2];
        const double c = (double)step[4], d = 1.0 + (double)step[5];
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
    pose->x -= pose->f[0] * (double)u + pose->f[1] * (double)v;
    pose->y -= pose->f[2] * (double)u + pose->f[3] * (double)v;
    return size;
}

/* One Gauss-Newton step; its size in px, or -1 when it diverged. */
static float gauss_newton(const struct track_template *t, const struct track_sums *sums,
                          struct track_pose *pose)
{
    float rhs[6] = {sums->descent[0], sums->descent[3]}, step[6] = {0.0f};
    if (!(sums->amplitude > 0.0f)) {
        return -1.0f;
    }
    for (int m = 0; t->unknowns == 6 && m < 6; ++m) {
        rhs[m] = sums->descent[m];
    }
    for (int m = 0; m < t->unknowns; ++m) {
        for (int k = 0; k < t->unknowns; ++k) {
            step[m] += t->inverse[m * t->unknowns + k] * rhs[k];
        }
        step[m] /= sums->amplitude;
    }
    return apply_step(t, step, pose);
}

static void report(const struct track_frame *frame, const struct track_template *t,
                   const struct track_sums *sums, struct track_result *result)
{
    const float power = sums->amplitude * sums->amplitude + sums->square;
    const float step = (float)(1 << (frame->bits - 8)) / 4.0f; /* of the 10-bit pixels, grey */
    const float rounding = (float)(t->side * t->side) * step * step / 12.0f;
    /* what deviates by less than its pixels are rounded shows nothing */
    result->quality = power > rounding ? sums->amplitude / sqrtf(power) : 0.0f;
    result->amplitude = sums->amplitude;
    result->level = sums->mean + (float)(1 << (frame->bits - 1));
    result->residual = sums->weighted;
}

void track_refine(const struct track_kernels *kernels, const struct track_frame *frame,
                  const struct track_patch *whole, const struct track_template *t,
                  const struct track_settings *settings, struct track_pose *pose,
                  struct track_result *result, void *scratch)
{
    const size_t samples = stride_of(t->side) + 2 * TRACK_LANES;
    float *w = scratch;
    int16_t *buffers = (int16_t *)(w + samples);
    struct track_patch local = {0};
    struct track_sums sums;
    enum track_status status = TRACK_SLOW;
    const double start_x = pose->x, start_y = pose->y;
    float reach = whole ? track_larger_side(frame) : 0.0f;
    int iteration = 0;
    *result = (struct track_result){0};
    while (status == TRACK_SLOW && iteration < settings->max_iterations) {
        const enum track_status usable = check_pose(frame, t->side, pose);
        if (usable != TRACK_CONVERGED) {
            status = usable;
            break;
        }
        if (!whole && (iteration == 0 || !patch_covers(&local, t->side, pose))) {
            load_patch(kernels, frame, t->side, pose, &local, buffers);
            const float farthest = reach_of(&local, start_x, start_y);
            reach = farthest > reach ? farthest : reach;
        }
        const struct track_grid grid = lay_grid(whole ? whole : &local, t, frame, pose);
        kernels->sample(&grid, w);
        kernels->sums(t, w, t->unknowns == 6, &sums);
        const float size = gauss_newton(t, &sums, pose);
        if (size < 0.0f) {
            status = TRACK_DIVERGED;
        } else if (size < settings->tolerance_px) {
            status = TRACK_CONVERGED;
        }
        ++iteration;
    }
    if (iteration) {
        report(frame, t, &sums, result);
    }
    result->iterations = (float)iteration;
    result->status = (float)status;
    result->reach = reach;
}

int track_sample(const struct track_kernels *kernels, const struct track_frame *frame,
                 const struct track_template *t, const struct track_pose *pose, float *out,
                 void *scratch)
{
    float *w = scratch; /* the kernels write beyond the stride */
    struct track_patch local = {0};
    if (check_pose(frame, t->side, pose) != TRACK_CONVERGED) {
        return 0;
    }
    load_patch(kernels, frame, t->side, pose, &local,
               (int16_t *)(w + stride_of(t->side) + 2 * TRACK_LANES));
    const struct track_grid grid = lay_grid(&local, t, frame, pose);
    kernels->sample(&grid, w);
    memcpy(out, w, (size_t)t->stride * sizeof *out);
    return 1;
}

/* ---- whole-pixel search ------------------------------------------------------------------- */

size_t track_search_size(int side, int radius)
{
    const size_t edge = (size_t)(2 * radius + widest(side)), across = (size_t)(2 * radius + 1);
    return sizeof(float) * (edge * edge + 3 * across);
}

/* The best place in one row of shifts; `window` starts at the row's first sample. */
static float search_row(const struct track_template *t, const struct track_pose *pose,
                        const float *window, int edge, int middle, int across, float *sums,
                        int *best)
{
    float *dot = sums, *total = sums + across, *square = sums + 2 * across;
    const float pixels = (float)(t->side * t->side);
    memset(sums, 0, 3 * (size_t)across * sizeof *sums);
    for (int n = 0; n < t->side * t->side; ++n) {
        const double xi = (double)t->place[n], eta = (double)t->place[n + t->stride];
        const int dx = floored(pose->f[0] * xi + pose->f[1] * eta + 0.5);
        const int dy = floored(pose->f[2] * xi + pose->f[3] * eta + 0.5);
        const float *restrict p = window + (ptrdiff_t)(middle + dy) * edge + middle + dx;
        const float f = t->shape[n];
        for (int i = 0; i < across; ++i) {
            dot[i] += f * p[i];
            total[i] += p[i];
            square[i] += p[i] * p[i];
        }
    }
    float top = -2.0f;
    for (int i = 0; i < across; ++i) {
        const float spread = square[i] - total[i] * total[i] / pixels;
        const float quality = spread > 0.0f ? dot[i] / sqrtf(spread) : 0.0f;
        if (quality > top) {
            top = quality;
            *best = i;
        }
    }
    return top;
}

float track_search(const struct track_frame *frame, const struct track_template *t, int radius,
                   struct track_pose *pose, void *scratch)
{
    const double most = 0.9 * (t->side - 1);
    double half_x, half_y;
    extent(pose, t->side, &half_x, &half_y);
    if (!(fabs(pose->x) < 1e6) || !(fabs(pose->y) < 1e6) || !(half_x <= most) ||
        !(half_y <= most)) {
        return -2.0f;
    }
    const int x0 = floored(pose->x + 0.5), y0 = floored(pose->y + 0.5);
    const int reach_x = (int)ceil(half_x), reach_y = (int)ceil(half_y);
    const int left = x0 - radius > reach_x ? x0 - radius : reach_x;
    const int right =
        x0 + radius < frame->width - 1 - reach_x ? x0 + radius : frame->width - 1 - reach_x;
    const int top = y0 - radius > reach_y ? y0 - radius : reach_y;
    const int bottom =
        y0 + radius < frame->height - 1 - reach_y ? y0 + radius : frame->height - 1 - reach_y;
    if (right < left || bottom < top) {
        return -2.0f;
    }
    const int margin = (widest(t->side) - 1) / 2, across = right - left + 1;
    const int edge = across + 2 * margin, rows = bottom - top + 1 + 2 * margin;
    float *window = scratch, *sums = window + (ptrdiff_t)edge * rows;
    const int pivot = pixel(frame, x0, y0);
    for (int r = 0; r < rows; ++r) {
        for (int c = 0; c < edge; ++c) {
            window[(ptrdiff_t)r * edge + c] =
                (float)(pixel(frame, left - margin + c, top - margin + r) - pivot);
        }
    }
    float best = -2.0f;
    for (int y = top; y <= bottom; ++y) {
        int at = 0;
        const float quality = search_row(t, pose, window + (ptrdiff_t)(y - top) * edge, edge,
                                         margin, across, sums, &at);
        if (quality > best) {
            best = quality;
            pose->x = left + at;
            pose->y = y;
        }
    }
    return best;
}
