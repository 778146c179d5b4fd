/* The parts of the kernels that the compiler turns into any instruction set: included once by each
 * of track_portable.c, track_avx2.c and track_avx512.c, which are built with their own flags and
 * bring WIDTH, the filter's taps for 32 entries at once (tap_scaled, tap_widening, tap_bytes), and
 * filter_row for rows of up to ROW_COLUMNS coefficients, 0 for none.
 * Sums run in 16 lanes and fold in one order, so every set gives the same bits. */
#include <string.h> /* memcpy */

/* WIDTH floats fill a register of this set. */
typedef float lanes __attribute__((vector_size(WIDTH * 4)));
typedef float lanes_at __attribute__((vector_size(WIDTH * 4), aligned(4), may_alias));

typedef float lanes_8 __attribute__((vector_size(32)));
typedef float lanes_4 __attribute__((vector_size(16)));

enum { ONE_14TH = 2341, ONE_194TH = 169, BLOCK = 32 };

/* Along the rows, 14 + s2 and 194 + s4 (over 14 and 194) of what 4 - s has made; they lose 2 and 4
 * on each side. One pass over all rows before the next begins: no load waits for a store. */
static void filter_along(int16_t *a, int16_t *b, int columns, int rows, ptrdiff_t pitch,
                         ptrdiff_t packed)
{
    for (int r = 0; r < rows; ++r) {
        for (int k = 0; k < columns + 8; k += BLOCK) {
            const int16_t *p = b + r * pitch + k;
            tap_scaled(p, p + 2, p + 4, ONE_14TH, a + r * pitch + k);
        }
    }
    for (int r = 0; r < rows; ++r) {
        for (int k = 0; k < columns; k += BLOCK) {
            const int16_t *p = a + r * pitch + k;
            tap_scaled(p, p + 4, p + 8, ONE_194TH, b + r * packed + k);
        }
    }
}

/* Down the columns; the widening factor 4 - s comes last, so that 16 bits hold every sum. */
static void filter_down(int16_t *a, int16_t *b, int rows, ptrdiff_t n, int16_t *out,
                        ptrdiff_t out_pitch)
{
    for (ptrdiff_t k = 0; k < n * (rows + 10); k += BLOCK) {
        tap_scaled(a + k, a + k + 2 * n, a + k + 4 * n, ONE_14TH, b + k);
    }
    for (ptrdiff_t k = 0; k < n * (rows + 2); k += BLOCK) {
        tap_scaled(b + k, b + k + 4 * n, b + k + 8 * n, ONE_194TH, a + k);
    }
    for (int r = 0; r < rows; ++r) {
        for (ptrdiff_t k = 0; k < n; k += BLOCK) {
            const int16_t *p = a + r * n + k;
            tap_widening(p, p + n, p + 2 * n, out + r * out_pitch + k);
        }
    }
}

static int packed_pitch(int columns) { return (columns + BLOCK - 1) / BLOCK * BLOCK; }

static void filter(int16_t *pixels, int16_t *work, int columns, int rows, int pitch, int16_t *out,
                   int out_pitch)
{
    const int all = rows + 2 * TRACK_REACH, packed = packed_pitch(columns);
    for (int r = 0; r < all; ++r) {
        for (int k = 0; k < columns + 12; k += BLOCK) {
            const int16_t *p = pixels + (ptrdiff_t)r * pitch + k;
            tap_widening(p, p + 1, p + 2, work + (ptrdiff_t)r * pitch + k);
        }
    }
    filter_along(pixels, work, columns, all, pitch, packed);
    filter_down(work, pixels, rows, packed, out, out_pitch);
}

static void filter_bytes(const unsigned char *bytes, ptrdiff_t line, int16_t *spare, int16_t *work,
                         int columns, int rows, int pitch, int16_t *out, int out_pitch)
{
    const int all = rows + 2 * TRACK_REACH, packed = packed_pitch(columns);
    if (columns <= ROW_COLUMNS) {
        for (int r = 0; r < all; ++r) {
            filter_row(bytes + r * line, work + (ptrdiff_t)r * packed);
        }
    } else {
        for (int r = 0; r < all; ++r) {
            for (int k = 0; k < columns + 12; k += BLOCK) {
                tap_bytes(bytes + r * line + k, work + (ptrdiff_t)r * pitch + k);
            }
        }
        filter_along(spare, work, columns, all, pitch, packed);
    }
    filter_down(work, spare, rows, packed, out, out_pitch);
}

static void widen(const void *pixels, int count, int bytes, int bits, int16_t *restrict out)
{
    if (bytes == 1) {
        const unsigned char *restrict in = pixels;
        for (int k = 0; k < count; k += BLOCK) {
            for (int i = 0; i < BLOCK; ++i) {
                out[k + i] = (int16_t)(4 * in[k + i] - 512);
            }
        }
        return;
    }
    const unsigned short *restrict in = pixels;
    const int top = (1 << bits) - 1, up = bits < 10 ? 10 - bits : 0;
    const int down = bits > 10 ? bits - 10 : 0, half = down ? 1 << (down - 1) : 0;
    for (int k = 0; k < count; k += BLOCK) {
        for (int i = 0; i < BLOCK; ++i) {
            const int p = in[k + i] < top ? in[k + i] : top;
            out[k + i] = (int16_t)((((p + half) >> down) << up) - 512);
        }
    }
}

/* The sum of 16 lanes: halves on halves. */
static float fold(const float *v)
{
    lanes_8 low, high;
    lanes_4 half[2];
    memcpy(&low, v, sizeof low);
    memcpy(&high, v + 8, sizeof high);
    low += high;
    memcpy(half, &low, sizeof half);
    half[0] += half[1];
    return (half[0][0] + half[0][2]) + (half[0][1] + half[0][3]);
}

#define AT(p, n) (*(const lanes_at *)((p) + (n)))
#define PUT(p, n, v) memcpy((p) + (n), &(v), sizeof(v))

static void sums(const struct track_template *t, const float *w, int moments,
                 struct track_sums *out)
{
    const float *gx = t->gradient, *gy = gx + t->stride, *f = t->shape;
    const int pixels = t->side * t->side;
    float all[9][TRACK_LANES] = {{0.0f}};
    for (int part = 0; part < TRACK_LANES; part += WIDTH) {
        lanes total = {0.0f}, along = {0.0f};
        for (int n = part; n < t->stride; n += TRACK_LANES) {
            total += AT(w, n);
            along += AT(w, n) * AT(f, n);
        }
        PUT(all[0], part, total);
        PUT(all[1], part, along);
    }
    const float mean = fold(all[0]) / (float)pixels, amplitude = fold(all[1]);
    for (int part = 0; part < TRACK_LANES; part += WIDTH) {
        lanes square = {0.0f}, weighted = {0.0f}, energy = {0.0f}, dx = {0.0f}, dy = {0.0f};
        for (int n = part; n < t->stride; n += TRACK_LANES) {
            const lanes x = AT(gx, n), y = AT(gy, n);
            const lanes r = AT(w, n) - mean - amplitude * AT(f, n);
            const lanes weight = x * x + y * y, rr = r * r;
            square += rr;
            weighted += weight * rr;
            energy += weight;
            dx += x * r;
            dy += y * r;
        }
        PUT(all[0], part, square);
        PUT(all[1], part, weighted);
        PUT(all[2], part, energy);
        PUT(all[3], part, dx);
        PUT(all[4], part, dy);
    }
    for (int part = 0; moments && part < TRACK_LANES; part += WIDTH) {
        lanes x_xi = {0.0f}, x_eta = {0.0f}, y_xi = {0.0f}, y_eta = {0.0f};
        for (int n = part; n < t->stride; n += TRACK_LANES) {
            const lanes r = AT(w, n) - mean - amplitude * AT(f, n);
            const lanes x = AT(gx, n) * r, y = AT(gy, n) * r;
            const lanes xi = AT(t->place, n), eta = AT(t->place, n + t->stride);
            x_xi += x * xi;
            x_eta += x * eta;
            y_xi += y * xi;
            y_eta += y * eta;
        }
        PUT(all[5], part, x_xi);
        PUT(all[6], part, x_eta);
        PUT(all[7], part, y_xi);
        PUT(all[8], part, y_eta);
    }
    out->mean = mean;
    out->amplitude = amplitude;
    /* the padding holds r = -mean */
    out->square = fold(all[0]) - (float)(t->stride - pixels) * mean * mean;
    out->weighted = fold(all[1]) / fold(all[2]);
    out->descent[0] = fold(all[3]);
    out->descent[3] = fold(all[4]);
    for (int m = 0; moments && m < 2; ++m) {
        out->descent[1 + m] = fold(all[5 + m]);
        out->descent[4 + m] = fold(all[7 + m]);
    }
}
