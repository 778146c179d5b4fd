#include "twin/camera.h"

#include <math.h>   /* exp, sqrt, sqrtf, floor, ceil */
#include <string.h> /* memset */

#ifndef HS_CLONES
#define HS_CLONES
#endif

#define EDGE_REACH 16.0 /* in edge widths */
#define BLOB_REACH 5.0  /* in sigmas */
#define FALLOFF_SIZE 72 /* 2 * EDGE_REACH * CAMERA_EDGE_MAX_PX, and the two roundings */
#define PROFILE_SIZE 64 /* 2 * BLOB_REACH * CAMERA_SIGMA_MAX_PX, and the centre */
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
static void fill_windows(const camera_scene *s, const double *lengths_px, size_t samples, float *sheet,
                         float *clamps)
{
    const double edge = s->edge_px;
    const double upper_in = s->top_px + s->clamp_inside_px;
    const double upper_out = s->top_px - s->clamp_outside_px;
    const float weight = 1.0f / (float)samples;
    for (int y = 0; y < s->height; y++) {
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

/* Adds weight times the coverage of a span between two logistic edges to one row. */
static void add_span(float *cover, int width, double left_px, double right_px, double edge_px,
                     const float *falloff, float weight)
{
    const double reach = EDGE_REACH * edge_px;
    const int from = (int)floor(left_px - reach), to = (int)ceil(right_px + reach);
    const int full = (int)ceil(left_px + reach), end = (int)floor(right_px - reach);
    const float rise = (float)exp((left_px - from) / edge_px);
    const float fall = (float)exp((to - right_px) / edge_px);
    const int full_stop = full < width ? full : width;
    for (int x = from > 0 ? from : 0; x < full_stop; x++) {
        cover[x] += weight / (1.0f + rise * falloff[x - from]);
    }
    const int end_stop = end < width ? end : width - 1;
    for (int x = full > 0 ? full : 0; x <= end_stop; x++) {
        cover[x] += weight;
    }
    const int to_stop = to < width ? to : width - 1;
    for (int x = end + 1 > 0 ? end + 1 : 0; x <= to_stop; x++) {
        cover[x] += weight / (1.0f + fall * falloff[to - x]);
    }
}

HS_CLONES static void fill_surfaces(const camera_scene *s, const double *lengths_px, size_t samples,
                                    const float *sheet, const float *clamps, float *cover,
                                    float *level)
{
    float falloff[FALLOFF_SIZE];
    for (int i = 0; i < FALLOFF_SIZE; i++) {
        falloff[i] = (float)exp(-i / s->edge_px);
    }
    const float weight = (s->sheet_grey - s->background_grey) / (float)samples;
    const size_t row_bytes = (size_t)s->width * sizeof(float);
    for (int y = 0; y < s->height; y++) {
        memset(cover, 0, row_bytes);
        for (size_t k = 0; k < samples; k++) {
            const float window = sheet[k * (size_t)s->height + (size_t)y];
            if (window <= 0.0f) {
                continue;
            }
            const double along = (y - s->top_px) / lengths_px[k];
            const double neck = contraction(s, lengths_px[k]) * 4.0 * along * (1.0 - along);
            const double half = s->half_width_px * (1.0 - neck);
            add_span(cover, s->width, s->mid_px - half, s->mid_px + half, s->edge_px, falloff,
                     weight * window);
        }
        const float clamp = (s->clamp_grey - s->background_grey) * clamps[y];
        const float light = s->illumination_y[y];
        float *row = level + (size_t)y * (size_t)s->width;
        for (int x = 0; x < s->width; x++) {
            row[x] = (light + s->illumination_x[x]) *
                     (s->background_grey + clamp * s->clamp_x[x] + cover[x]);
        }
    }
}

/* exp(-(i - centre)^2 / (2 sigma^2)) for the 2 reach + 1 integers i around the nearest one, which is
 * returned. g(i + 1) / g(i) is a geometric series, so two exponentials are enough. */
static int fill_profile(double centre_px, double sigma_px, int reach, float *profile)
{
    const double nearest = floor(centre_px + 0.5);
    const double offset = centre_px - nearest, inverse = 1.0 / (sigma_px * sigma_px);
    const double shrink = exp(-inverse), peak = exp(-0.5 * offset * offset * inverse);
    const double tilt = exp(offset * inverse), half_step = sqrt(shrink);
    double up = peak, down = peak, up_ratio = half_step * tilt, down_ratio = half_step / tilt;
    profile[reach] = (float)peak;
    for (int i = 1; i <= reach; i++) {
        up *= up_ratio;
        down *= down_ratio;
        up_ratio *= shrink;
        down_ratio *= shrink;
        profile[reach + i] = (float)up;
        profile[reach - i] = (float)down;
    }
    return (int)nearest;
}

/* Subtracts one blob at one position; window, or NULL, is its visibility along y. */
HS_CLONES static void subtract_blob(const camera_scene *s, const camera_blob *blob, double x_px,
                                    double y_px, float depth, const float *window, float *level)
{
    const int reach = (int)ceil(BLOB_REACH * blob->sigma_px);
    if (!(x_px > -reach && x_px < s->width - 1 + reach && y_px > -reach &&
          y_px < s->height - 1 + reach)) {
        return;
    }
    float profile_x[PROFILE_SIZE], profile_y[PROFILE_SIZE];
    const int left = fill_profile(x_px, blob->sigma_px, reach, profile_x) - reach;
    const int upper = fill_profile(y_px, blob->sigma_px, reach, profile_y) - reach;
    const int x_from = left > 0 ? left : 0, y_from = upper > 0 ? upper : 0;
    const int x_stop = left + 2 * reach < s->width ? left + 2 * reach + 1 : s->width;
    const int y_stop = upper + 2 * reach < s->height ? upper + 2 * reach + 1 : s->height;
    for (int y = y_from; y < y_stop; y++) {
        const float amount = depth * profile_y[y - upper] * (window ? window[y] : 1.0f);
        float *row = level + (size_t)y * (size_t)s->width;
        for (int x = x_from; x < x_stop; x++) {
            row[x] -= amount * profile_x[x - left];
        }
    }
}

void camera_expect(const camera_scene *s, const double *lengths_px, size_t samples, float *scratch,
                   float *level)
{
    float *sheet = scratch, *clamps = sheet + samples * (size_t)s->height;
    float *cover = clamps + s->height;
    fill_windows(s, lengths_px, samples, sheet, clamps);
    fill_surfaces(s, lengths_px, samples, sheet, clamps, cover, level);
    for (size_t i = 0; i < s->blob_count; i++) {
        const camera_blob *blob = s->blobs + i;
        const float depth = (float)(blob->depth_grey / (double)samples);
        const int on_sheet = blob->along > 0.0 && blob->along < 1.0;
        for (size_t k = 0; k < samples; k++) {
            const double neck =
                contraction(s, lengths_px[k]) * 4.0 * blob->along * (1.0 - blob->along);
            const double x = s->mid_px + s->half_width_px * (blob->across - neck * blob->across_necked);
            const double y = s->top_px + blob->along * lengths_px[k];
            subtract_blob(s, blob, x, y, depth, on_sheet ? sheet + k * (size_t)s->height : NULL, level);
        }
    }
}

/* The finaliser of a 64-bit counter generator: each input bit reaches each output bit. */
static uint64_t scramble(uint64_t z)
{
    z = (z ^ (z >> 30)) * 0xbf58476d1ce4e5b9u;
    z = (z ^ (z >> 27)) * 0x94d049bb133111ebu;
    return z ^ (z >> 31);
}

HS_CLONES
void camera_expose(const float *level, size_t count, const camera_noise *noise, uint64_t frame,
                   uint8_t *out)
{
    const uint64_t golden = 0x9e3779b97f4a7c15u;
    const float *table = noise->table;
    const float read_variance = noise->read_noise_grey * noise->read_noise_grey;
    uint64_t counter = scramble(scramble(noise->seed + golden) + golden * (frame + 1u));
    float normal[NOISE_BLOCK];
    for (size_t start = 0; start < count; start += NOISE_BLOCK) {
        const size_t n = count - start < NOISE_BLOCK ? count - start : NOISE_BLOCK;
        for (size_t i = 0; i < NOISE_BLOCK; i += 2) {
            counter += golden;
            const uint64_t bits = scramble(counter);
            normal[i] = table[bits & 4095u] + table[(bits >> 12) & 4095u];
            normal[i + 1] = table[(bits >> 24) & 4095u] + table[(bits >> 36) & 4095u];
        }
        for (size_t i = 0; i < n; i++) {
            const float mean = level[start + i] > 0.0f ? level[start + i] : 0.0f;
            const float sd = sqrtf(noise->shot_gain_grey * mean + read_variance);
            float grey = mean + sd * normal[i] + 0.5f;
            grey = grey > 0.0f ? grey : 0.0f;
            grey = grey < 255.0f ? grey : 255.0f;
            out[start + i] = (uint8_t)(int)grey;
        }
    }
}
