/* Takes: pieces as they come. Gives: recursive least squares with forgetting, one result a piece. */
#include "sensing/pieces.h"

#include <math.h>
#include <string.h>

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

/* Sums of one piece more, about the level that was taken off the first one. */
static void add_piece(const sense_plan *plan, const columns all[2], sense_memory *memory)
{
    const double m = (double)plan->piece;
    channel ch;
    size_t j;
    for (j = 0; j < 2; ++j) {
        const double first = all[j].first[0];
        double *b = memory->sums[j], shift;
        if (!memory->started) {
            memory->first[j] = first;
        }
        shift = first - memory->first[j];
        b[0] += all[j].cosine[0] + shift * plan->table[0][0];
        b[1] += all[j].sine[0] + shift * plan->table[0][1];
        b[2] += all[j].level[0] + shift * m;
        b[3] += (all[j].ramp[0] + shift * 0.5 * m * (m - 1.0)) / m;
        fit_pieces(plan, &all[j], &ch);
        memory->rest[j] += ch.rest[0];
    }
    memory->freedom += m - 4.0;
    memory->started = 1;
}

void sense_recursive(const sense_plan *plan, const double local_normal[16], double forget,
                     sense_memory *memory, sense_type type, const void *v, const void *i,
                     size_t stride, sense_recursive_result *out)
{
    const double m = (double)plan->piece, c = plan->turn_cos[1], s = plan->turn_sin[1];
    double inverse[16], x[2][4], end[4], phase_re, phase_im;
    columns all[2];
    unsigned reason = sum_block(plan, type, v, i, stride, 0, NULL, all);
    size_t j, k, l;

    const double counts = reason == 0 ? 1.0 : 0.0; /* a spoiled piece only lets time pass */

    advance_normal(memory->normal, c, s);
    advance_normal(memory->square, c, s);
    for (k = 0; k < 16; ++k) {
        memory->normal[k] = forget * memory->normal[k] + counts * local_normal[k];
        memory->square[k] = forget * forget * memory->square[k] + counts * local_normal[k];
    }
    for (j = 0; j < 2; ++j) {
        double *b = memory->sums[j];
        const double old[4] = {b[0], b[1], b[2], b[3]};
        b[0] = forget * (c * old[0] + s * old[1]);
        b[1] = forget * (c * old[1] - s * old[0]);
        b[2] = forget * old[2];
        b[3] = forget * (old[3] - old[2]);
        memory->rest[j] *= forget;
    }
    memory->freedom *= forget;
    if (reason == 0) {
        add_piece(plan, all, memory);
    }
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
