/* Takes: level and slope of a block's segments. Gives: the best cut into parts, each with a model. */
#include "sensing/parts.h"

#include <math.h>
#include <string.h>

/* Left to the build, which knows whether this compiler and machine have several instruction sets. */
#ifndef HS_CLONES
#define HS_CLONES
#endif

typedef struct {
    double cost;
    int32_t size, kind;
} run;

/* Squares that the columns of one table take of runs of `count` segments, from each first segment on.
 * Levels and slopes lie apart in y, so that neighbouring runs go through one vector instruction. */
HS_CLONES static void take(const double *columns, size_t most, size_t count, size_t segments,
                           const double y[4][PARTS_SEGMENTS], double taken[][PARTS_SEGMENTS])
{
    const size_t runs = segments - count + 1;
    size_t first, j, k, c;
    for (k = 0; k < most; ++k) {
        double *restrict to = taken[k];
        for (c = 0; c < 4; c += 2) {
            double sum[PARTS_SEGMENTS] = {0};
            for (j = 0; j < count; ++j) {
                const double a = columns[PARTS_SIZE * 2 * j + k];
                const double b = columns[PARTS_SIZE * (2 * j + 1) + k];
                const double *level = y[c] + j, *slope = y[c + 1] + j;
                for (first = 0; first < runs; ++first) {
                    sum[first] += a * level[first] + b * slope[first];
                }
            }
            for (first = 0; first < runs; ++first) {
                to[first] = sum[first] * sum[first] + (c == 0 ? 0.0 : to[first]);
            }
        }
    }
}

/* Best model of every run: runs[first][count - 1]. */
static void judge_runs(const parts_plan *plan, const double *y, run runs[][PARTS_SEGMENTS])
{
    const size_t segments = plan->segments;
    double energy[PARTS_SEGMENTS + 1], taken[PARTS_SIZE][PARTS_SEGMENTS], apart[4][PARTS_SEGMENTS];
    size_t p, count, first, kind, k;
    energy[0] = 0.0;
    for (p = 0; p < segments; ++p) {
        const double *v = y + 2 * p, *i = v + 2 * segments;
        apart[0][p] = v[0];
        apart[1][p] = v[1];
        apart[2][p] = i[0];
        apart[3][p] = i[1];
        energy[p + 1] = energy[p] + v[0] * v[0] + v[1] * v[1] + i[0] * i[0] + i[1] * i[1];
        for (count = 0; count < segments; ++count) {
            runs[p][count].cost = HUGE_VAL;
        }
    }
    for (kind = 0; kind < plan->kinds; ++kind) {
        const parts_table *table = &plan->tables[kind];
        const double *columns = table->columns;
        for (count = 1; count <= segments; columns += 2 * PARTS_SIZE * count, ++count) {
            const size_t room = 2 * count > plan->spare ? 2 * count - plan->spare : 0;
            const size_t most = table->most < room ? table->most : room;
            if (most < table->least) {
                continue;
            }
            take(columns, most, count, segments, (const double(*)[PARTS_SEGMENTS])apart, taken);
            for (first = 0; first + count <= segments; ++first) {
                run *best = &runs[first][count - 1];
                double cost = energy[first + count] - energy[first];
                for (k = 0; k < most; ++k) {
                    cost += plan->price - taken[k][first];
                    if (k + 1 >= table->least && cost < best->cost) {
                        best->cost = cost;
                        best->size = (int32_t)k + 1;
                        best->kind = (int32_t)kind;
                    }
                }
            }
        }
    }
}

void parts_cut(const parts_plan *plan, const double *y, parts_part *parts, parts_result *out)
{
    const size_t segments = plan->segments;
    run runs[PARTS_SEGMENTS][PARTS_SEGMENTS];
    /* Least cost of all segments before a place: where a part ends there, or a gap. */
    double part_ends[PARTS_SEGMENTS + 1], gap_ends[PARTS_SEGMENTS + 1];
    size_t begins[PARTS_SEGMENTS + 1], gaps[PARTS_SEGMENTS + 1]; /* segments of the part, of the gap */
    size_t end, first, found = 0;
    int in_part;

    judge_runs(plan, y, runs);
    part_ends[0] = 0.0;
    gap_ends[0] = HUGE_VAL;
    gaps[0] = begins[0] = 0;
    for (end = 1; end <= segments; ++end) {
        /* At both ends of a block a gap may be shorter: its other half lies outside. */
        const size_t short_gap = end == segments ? 1 : plan->gap;
        const size_t least = end >= short_gap ? short_gap : end;
        const double opened = part_ends[end - least] + plan->cut_price +
                              (double)least * plan->left_out;
        gap_ends[end] = gap_ends[end - 1] + plan->left_out;
        gaps[end] = gaps[end - 1] + 1;
        if (opened < gap_ends[end]) {
            gap_ends[end] = opened;
            gaps[end] = least;
        }
        part_ends[end] = HUGE_VAL;
        begins[end] = 0;
        for (first = 0; first < end; ++first) {
            const double before = first == 0 ? 0.0 : gap_ends[first];
            const double cost = before + runs[first][end - first - 1].cost;
            if (cost < part_ends[end]) {
                part_ends[end] = cost;
                begins[end] = first;
            }
        }
    }
    in_part = part_ends[segments] <= gap_ends[segments];
    out->score = in_part ? part_ends[segments] : gap_ends[segments];
    out->misfit = 0.0;
    for (end = segments; end > 0;) {
        if (in_part) {
            const run *taken = &runs[begins[end]][end - begins[end] - 1];
            const parts_part one = {(int32_t)begins[end], (int32_t)(end - begins[end]), taken->size,
                              taken->kind};
            out->misfit += taken->cost - plan->price * taken->size;
            parts[found++] = one;
            end = begins[end];
        } else {
            end -= gaps[end];
        }
        in_part = !in_part;
    }
    out->parts = (int32_t)found;
}
