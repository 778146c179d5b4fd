/* The drive of a block, cut into parts: each a run of segments under a small linear model of its own. */
#ifndef HASELAB_PARTS_H
#define HASELAB_PARTS_H

#include <stddef.h>
#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

#define PARTS_SEGMENTS 32 /* of a block, at most */
#define PARTS_SIZE 8    /* columns of a table */
#define PARTS_KINDS 2   /* of models, at most */

/* Nested models of a run of 1, 2 ... segments: each uses the first columns. */
typedef struct {
    const double *columns; /* 2 rows of PARTS_SIZE a segment: runs of 1 segment, then of 2 ... */
    size_t least;          /* columns of the smallest model */
    size_t most;           /* of the largest */
} parts_table;

typedef struct {
    size_t segments;
    size_t kinds;
    parts_table tables[PARTS_KINDS];
    size_t gap;       /* smallest number of segments that a step inside the block affects */
    size_t spare;     /* residual degrees of freedom of a run, at least */
    double price;     /* of a parameter, on both channels */
    double cut_price; /* of a step */
    double left_out;  /* price of a segment that is not used */
} parts_plan;

typedef struct {
    int32_t first, count, size, kind;
} parts_part;

typedef struct {
    double score;  /* chi-square and prices */
    double misfit; /* chi-square of the segments that are used */
    int32_t parts;
} parts_result;

/* y: level and slope of each segment in standard deviations, voltage then current. Gives the cut of
 * least score; parts: room for `segments` of them, the last one first. */
void parts_cut(const parts_plan *plan, const double *y, parts_part *parts, parts_result *out);

#ifdef __cplusplus
}
#endif

#endif
