#include "twin/camera.h"

#include <math.h>   /* exp, sqrt, sqrtf, floor, ceil */
#include <string.h> /* memset */

#ifndef HS_CLONES
#define HS_CLONES
#endif

#define EDGE_REACH 16.0 /* in edge widths */
#define BLOB_REACH 5.0  /* in sigmas */
#define FALLOFF_SIZE 72 /* 2 * EDGE_REACH * CAMERA_EDGE_MAX_PX, and the two roundings */
#define LANES 16        /* pixels at a time */
#define PROFILE_SIZE 80 /* 2 * BLOB_REACH * CAMERA_SIGMA_MAX_PX, the centre, and LANES */
#define NOISE_BLOCK 256

static float logistic(double distance_px, double edge_px)
{
    const double t = distance_px / edge_px;
    if (t > EDGE_REACH) {
        return 1.0f;
    }
    if (t < -EDGE_REACH) {
        return 0.0f;
    }
    return (float)(1.0 / (1.0 + exp(-t)));
}

static double contraction(const camera_scene *scene, double length_px)
{
    const double excess = length_px / scene->free_length_px - 1.0;
    return excess > 0.0 ? scene->neck * excess : 0.0;
}

size_t camera_scratch_size(const camera_scene *scene, size_t samples)
{
    return (samples + 1) * (size_t)scene->height + (size_t)scene->width;
}

/* Profiles along y: sheet[k][y] between the clamps, clamps[y] averaged over the samples. */
static void fill_windows(const camera_scene *s, const double *lengths_px, size_t samples,
                         camera_span rows, float *sheet, float *clamps)
{
    const double edge = s->edge_px;
    const double upper_in = s->top_px + s->clamp_inside_px;
    const double upper_out = s->top_px - s->clamp_outside_px;
    const float weight = 1.0f / (float)samples;
    for (int y = rows.first; y < rows.stop; y++) {
        const float above = logistic(upper_in - y, edge);
        float lower_sum = 0.0f;
        for (size_t k = 0; k < samples; k++) {
            const double line = s->top_px + lengths_px[k];
            const float below = logistic(y - (line - s->clamp_inside_px), edge);
            sheet[k * (size_t)s->height + (size_t)y] = (1.0f - above) * (1.0f - below);
            lower_sum += below * logistic(line + s->clamp_outside_px - y, edge);
        }
        clamps[y] = above * logistic(y - upper_out, edge) + weight * lower_sum;
    }
}

/* One sample's part of a row of the sheet, a span between two logistic edges. */
typedef struct {
    int from, full, end, to; /* rises over [from, full), is 1 over [full, end], falls over (end, to] */
    float rise, fall, weight;
} span;

static span span_of(double left_px, double right_px, double edge_px, float weight)
{
    const double reach = EDGE_REACH * edge_px;
    span s;
    s.from = (int)floor(left_px - reach);
    s.to = (int)ceil(right_px + reach);
    s.full = (int)ceil(left_px + reach);
    s.end = (int)floor(right_px - reach);
    s.rise = (float)exp((left_px - s.from) / edge_px);
    s.fall = (float)exp((s.to - right_px) / edge_px);
    s.weight = weight;
    return s;
}

/* Adds spans to a row that is 0, each in its turn. Where all are full, their sum is the same. */
static inline void add_spans(float *cover, camera_span columns, const span *spans, size_t count,
                             const float *falloff)
{
    const int left = columns.first, stop = columns.stop;
    int first = left, last = stop - 1;
    float all = 0.0f;
    for (size_t k = 0; k < count; k++) {
        first = spans[k].full > first ? spans[k].full : first;
        last = spans[k].end < last ? spans[k].end : last;
        all += spans[k].weight;
    }
    if (first > last) {
        first = stop, last = stop - 1;
    }
    for (size_t k = 0; k < count; k++) {
        const span s = spans[k];
        const int full_stop = s.full < stop ? s.full : stop;
        for (int x = s.from > left ? s.from : left; x < full_stop; x++) {
            cover[x] += s.weight / (1.0f + s.rise * falloff[x - s.from]);
        }
        const int end_stop = s.end < first ? s.end : first - 1;
        for (int x = s.full > left ? s.full : left; x <= end_stop; x++) {
            cover[x] += s.weight;
        }
        for (int x = last + 1; x <= s.end && x < stop; x++) {
            cover[x] += s.weight;
        }
        const int to_stop = s.to < stop ? s.to : stop - 1;
        for (int x = s.end + 1 > left ? s.end + 1 : left; x <= to_stop; x++) {
            cover[x] += s.weight / (1.0f + s.fall * falloff[s.to - x]);
        }
    }
    for (int x = first; x <= last; x++) {
        cover[x] = all;
    }
}

HS_CLONES static void fill_surfaces(const camera_scene *s, const double *lengths_px, size_t samples,
                                    const camera_part *part, const float *sheet,
                                    const float *clamps, float *cover, float *level)
{
    float falloff[FALLOFF_SIZE];
    span spans[CAMERA_SAMPLES_MAX];
    for (int i = 0; i < FALLOFF_SIZE; i++) {
        falloff[i] = (float)exp(-i / s->edge_px);
    }
    const float weight = (s->sheet_grey - s->background_grey) / (float)samples;
    for (int y = part->rows.first; y < part->rows.stop; y++) {
        size_t spanned = 0;
        for (size_t k = 0; k < samples; k++) {
            const float window = sheet[k * (size_t)s->height + (size_t)y];
            if (window <= 0.0f) {
                continue;
            }
            const double along = (y - s->top_px) / lengths_px[k];
            const double neck = contraction(s, lengths_px[k]) * 4.0 * along * (1.0 - along);
            const double half = s->half_width_px * (1.0 - neck);
            spans[spanned++] =
                span_of(s->mid_px - half, s->mid_px + half, s->edge_px, weight * window);
        }
        const float clamp = (s->clamp_grey - s->background_grey) * clamps[y];
        const float light = s->illumination_y[y];
        float *row = level + (size_t)y * (size_t)s->width;
        for (size_t i = 0; i < part->count; i++) {
            const camera_span columns = part->columns[i];
            memset(cover + columns.first, 0, (size_t)(columns.stop - columns.first) * sizeof *cover);
            add_spans(cover, columns, spans, spanned, falloff);
            for (int x = columns.first; x < columns.stop; x++) {
                row[x] = (light + s->illumination_x[x]) *
                         (s->background_grey + clamp * s->clamp_x[x] + cover[x]);
            }
        }
    }
}

/* What all images of a blob have in common. */
typedef struct {
    double inverse, shrink, half_step; /* 1 / sigma^2, exp(-inverse), sqrt(shrink) */
    int reach;
} shape;

static shape shape_of(const camera_blob *blob)
{
    shape s;
    s.inverse = 1.0 / (blob->sigma_px * blob->sigma_px);
    s.shrink = exp(-s.inverse);
    s.half_step = sqrt(s.shrink);
    s.reach = (int)ceil(BLOB_REACH * blob->sigma_px);
    return s;
}

/* exp(-(i - centre)^2 / (2 sigma^2)) for the 2 reach + 1 integers i around the nearest one, the
 * centre lying `offset` beyond it. g(i + 1) / g(i) is a geometric series, so two exponentials are
 * enough. */
static void fill_profile(double offset, const shape *s, float *profile)
{
    const int reach = s->reach;
    const double peak = exp(-0.5 * offset * offset * s->inverse), tilt = exp(offset * s->inverse);
    double up = peak, down = peak, up_ratio = s->half_step * tilt, down_ratio = s->half_step / tilt;
    profile[reach] = (float)peak;
    for (int i = 1; i <= reach; i++) {
        up *= up_ratio;
        down *= down_ratio;
        up_ratio *= s->shrink;
        down_ratio *= s->shrink;
        profile[reach + i] = (float)up;
        profile[reach - i] = (float)down;
    }
}

/* The images of a blob that lie around one pixel. */
typedef struct {
    size_t count;
    int left, upper, size; /* of the square they cover */
    float x[CAMERA_SAMPLES_MAX][PROFILE_SIZE];
    float y[CAMERA_SAMPLES_MAX][PROFILE_SIZE]; /* times depth and visibility */
} images;

/* Subtracts the images from the level, each in its turn. */
HS_CLONES static void subtract_images(const camera_scene *s, camera_span rows, const images *b,
                                      float *level)
{
    const int y_from = b->upper > rows.first ? b->upper : rows.first;
    const int y_stop = b->upper + b->size < rows.stop ? b->upper + b->size : rows.stop;
    for (int y = y_from; y < y_stop; y++) {
        float *row = level + (size_t)y * (size_t)s->width;
        for (int x = 0; x < b->size; x += LANES) { /* beyond its size a profile is 0 */
            const int from = b->left + x;
            if (from >= 0 && from + LANES <= s->width) {
                float grey[LANES];
                memcpy(grey, row + from, sizeof grey);
                for (size_t k = 0; k < b->count; k++) {
                    const float amount = b->y[k][y - b->upper];
                    for (int i = 0; i < LANES; i++) {
                        grey[i] -= amount * b->x[k][x + i];
                    }
                }
                memcpy(row + from, grey, sizeof grey);
                continue;
            }
            for (int i = from < 0 ? -from : 0; i < LANES && from + i < s->width; i++) {
                for (size_t k = 0; k < b->count; k++) {
                    row[from + i] -= b->y[k][y - b->upper] * b->x[k][x + i];
                }
            }
        }
    }
}

/* Whether some of these columns belong to a part. */
static int has_columns(const camera_part *part, double first, double last)
{
    for (size_t i = 0; i < part->count; i++) {
        if (last >= part->columns[i].first && first < part->columns[i].stop) {
            return 1;
        }
    }
    return 0;
}

/* Whether a blob may reach these rows at some sample; most blobs are far from a small part. */
static int may_show(const camera_scene *s, const camera_blob *blob, const double *lengths_px,
                    size_t samples, camera_span rows)
{
    const double reach = BLOB_REACH * blob->sigma_px + 2.0; /* and two roundings */
    int seen = 0;
    for (size_t k = 0; k < samples; k++) {
        const double y = s->top_px + blob->along * lengths_px[k];
        seen |= y + reach > rows.first && y - reach < rows.stop;
    }
    return seen;
}

/* Subtracts a blob at all samples of the exposure. */
static void subtract_blob(const camera_scene *s, const camera_blob *blob, const double *lengths_px,
                          size_t samples, const camera_part *part, const float *sheet, float *level)
{
    const camera_span rows = part->rows;
    const float depth = (float)(blob->depth_grey / (double)samples);
    const int on_sheet = blob->along > 0.0 && blob->along < 1.0;
    const shape form = shape_of(blob);
    const int reach = form.reach;
    images batch;
    batch.count = 0;
    batch.size = 2 * reach + 1;
    for (size_t k = 0; k < samples; k++) {
        const double neck = contraction(s, lengths_px[k]) * 4.0 * blob->along * (1.0 - blob->along);
        const double x = s->mid_px + s->half_width_px * (blob->across - neck * blob->across_necked);
        const double y = s->top_px + blob->along * lengths_px[k];
        const double column = floor(x + 0.5), line = floor(y + 0.5);
        if (!(x > -reach && x < s->width - 1 + reach && y > -reach && y < s->height - 1 + reach)) {
            continue;
        }
        if (line + reach < rows.first || line - reach >= rows.stop ||
            !has_columns(part, column - reach, column + reach)) {
            continue;
        }
        if (batch.count && (batch.left != (int)column - reach || batch.upper != (int)line - reach)) {
            subtract_images(s, rows, &batch, level);
            batch.count = 0;
        }
        batch.left = (int)column - reach;
        batch.upper = (int)line - reach;
        float *px = batch.x[batch.count], *py = batch.y[batch.count];
        memset(px + batch.size, 0, LANES * sizeof *px);
        fill_profile(x - column, &form, px);
        fill_profile(y - line, &form, py);
        for (int i = 0; i < batch.size; i++) {
            const int at = batch.upper + i;
            const int visible = at >= rows.first && at < rows.stop;
            const float window = on_sheet && visible ? sheet[k * (size_t)s->height + (size_t)at] : 1.0f;
            py[i] = depth * py[i] * window;
        }
        batch.count++;
    }
    if (batch.count) {
        subtract_images(s, rows, &batch, level);
    }
}

void camera_expect(const camera_scene *s, const double *lengths_px, size_t samples,
                   const camera_part *part, float *scratch, float *level)
{
    float *sheet = scratch, *clamps = sheet + samples * (size_t)s->height;
    float *cover = clamps + s->height;
    fill_windows(s, lengths_px, samples, part->rows, sheet, clamps);
    fill_surfaces(s, lengths_px, samples, part, sheet, clamps, cover, level);
    for (size_t i = 0; i < s->blob_count; i++) {
        if (may_show(s, s->blobs + i, lengths_px, samples, part->rows)) {
            subtract_blob(s, s->blobs + i, lengths_px, samples, part, sheet, level);
        }
    }
}

#define GOLDEN 0x9e3779b97f4a7c15u

/* The finaliser of a 64-bit counter generator: each input bit reaches each output bit. */
static uint64_t scramble(uint64_t z)
{
    z = (z ^ (z >> 30)) * 0xbf58476d1ce4e5b9u;
    z = (z ^ (z >> 27)) * 0x94d049bb133111ebu;
    return z ^ (z >> 31);
}

/* Exposes the pixels from `first` to `stop` - 1; `counter`: of the noise of the frame's first pixel. */
HS_CLONES
static void expose_pixels(const float *level, size_t first, size_t stop, const camera_noise *noise,
                          uint64_t counter, uint8_t *out)
{
    const float *table = noise->table;
    const float read_variance = noise->read_noise_grey * noise->read_noise_grey;
    counter += GOLDEN * (first / 2u); /* one for two pixels */
    float normal[NOISE_BLOCK];
    for (size_t start = first - first % 2; start < stop; start += NOISE_BLOCK) {
        const size_t n = stop - start < NOISE_BLOCK ? stop - start : NOISE_BLOCK;
        for (size_t i = 0; i < n; i += 2) {
            counter += GOLDEN;
            const uint64_t bits = scramble(counter);
            normal[i] = table[bits & 4095u] + table[(bits >> 12) & 4095u];
            normal[i + 1] = table[(bits >> 24) & 4095u] + table[(bits >> 36) & 4095u];
        }
        for (size_t i = start < first ? 1 : 0; i < n; i++) {
            const float mean = level[start + i] > 0.0f ? level[start + i] : 0.0f;
            const float sd = sqrtf(noise->shot_gain_grey * mean + read_variance);
            float grey = mean + sd * normal[i] + 0.5f;
            grey = grey > 0.0f ? grey : 0.0f;
            grey = grey < 255.0f ? grey : 255.0f;
            out[start + i] = (uint8_t)(int)grey;
        }
    }
}

void camera_expose(const camera_scene *scene, const float *level, const camera_part *part,
                   const camera_noise *noise, uint64_t frame, uint8_t *out)
{
    const uint64_t counter = scramble(scramble(noise->seed + GOLDEN) + GOLDEN * (frame + 1u));
    for (int y = part->rows.first; y < part->rows.stop; y++) {
        const size_t row = (size_t)y * (size_t)scene->width;
        for (size_t i = 0; i < part->count; i++) {
            const camera_span columns = part->columns[i];
            expose_pixels(level, row + (size_t)columns.first, row + (size_t)columns.stop, noise,
                          counter, out);
        }
    }
}
