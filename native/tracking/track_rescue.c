/* What becomes of the points that are not believed: tried again, or carried by their neighbours; see
 * track_step.h. */
#include <math.h>   /* fabs */
#include <string.h> /* memcpy, memset */

#include "tracking/track_neighbours.h"
#include "tracking/track_work.h"

enum { FEWEST = TRACK_FEWEST, MOST_ROUNDS = 24 };

/* Where the usable neighbours put point i, and how they deform it; 0 when they cannot tell. */
static int place_by_neighbours(const struct track_work *w, const unsigned char *unusable, int i,
                               struct track_pose *pose)
{
    double g[4], guess[2];
    if (!track_partial_gradient(w->points, w->moved, unusable, i, g) ||
        track_median_guess(w->points, w->moved, unusable, g, i, guess) < FEWEST) {
        return 0;
    }
    pose->x = w->points->centre[2 * i] + guess[0];
    pose->y = w->points->centre[2 * i + 1] + guess[1];
    track_put_deformation(g, w->points->base + 4 * i, pose->f);
    return 1;
}

/* A second try from the neighbours' word; the number of points found. */
static int retry_by_neighbours(const struct track_work *w)
{
    int found = 0;
    for (int i = 0; i < w->points->count; ++i) {
        struct track_pose pose;
        if (!w->reasons[i] || w->tried[i] >= 3 || !place_by_neighbours(w, w->reasons, i, &pose)) {
            continue;
        }
        const unsigned char was = w->reasons[i];
        w->poses[i] = pose;
        track_refine_point(w, i);
        const double jump = (double)w->rules->jump_px;
        if (!w->reasons[i] &&
            (fabs(w->poses[i].x - pose.x) > jump || fabs(w->poses[i].y - pose.y) > jump)) {
            w->reasons[i] = TRACK_STRAYED;
        }
        if (!w->reasons[i] && track_is_covered(w, i)) {
            w->reasons[i] = TRACK_COVERED;
        }
        if (w->reasons[i]) {
            w->reasons[i] = (unsigned char)(w->reasons[i] | (was & TRACK_STRAYED));
            ++w->tried[i];
        } else {
            ++found;
        }
    }
    return found;
}

/* Whole-pixel search for those that no neighbours can place. */
static void retry_by_search(const struct track_work *w, const struct track_memory *before)
{
    for (int i = 0; i < w->points->count; ++i) {
        struct track_pose guess;
        if (!w->reasons[i] ||
            (w->points->neighbours && place_by_neighbours(w, w->reasons, i, &guess))) {
            continue;
        }
        const struct track_template t = track_template_of(w->points, i);
        struct track_pose pose = before->poses[i];
        pose.x += before->velocity[2 * i];
        pose.y += before->velocity[2 * i + 1];
        if (w->points->neighbours) {
            memcpy(pose.f, w->poses[i].f, sizeof pose.f);
        }
        if (track_search(w->frame, &t, w->rules->search_px, &pose, w->search) > 0.0f) {
            w->poses[i] = pose;
            track_refine_point(w, i);
        }
    }
}

int track_any_lost(const struct track_work *w)
{
    int lost = 0;
    for (int i = 0; i < w->points->count; ++i) {
        lost |= w->reasons[i];
    }
    return lost != 0;
}

/* A point found far from where it was expected, with hardly a neighbour to bear it out, may well be
 * another that looks the same. */
static void mark_lone(const struct track_work *w, const struct track_memory *before)
{
    const struct track_points *p = w->points;
    const double jump = (double)w->rules->jump_px;
    for (int i = 0; i < p->count; ++i) {
        const struct track_pose *from = &before->poses[i];
        const double *speed = before->velocity + 2 * i;
        const int *near = p->near + (ptrdiff_t)i * p->neighbours;
        int bears = 0;
        for (int k = 0; k < p->neighbours; ++k) {
            bears += !w->reasons[near[k]];
        }
        w->tried[i] = !w->reasons[i] && 2 * bears < p->neighbours &&
                      (fabs(w->poses[i].x - from->x - speed[0]) > jump ||
                       fabs(w->poses[i].y - from->y - speed[1]) > jump);
    }
    for (int i = 0; i < p->count; ++i) {
        w->reasons[i] = (unsigned char)(w->reasons[i] | (w->tried[i] ? TRACK_STRAYED : 0));
    }
}

void track_rescue(const struct track_work *w, const struct track_memory *before)
{
    const int count = w->points->count;
    memset(w->tried, 0, (size_t)count);
    for (int round = 0; w->points->neighbours && round < MOST_ROUNDS; ++round) {
        if (!retry_by_neighbours(w)) {
            break;
        }
    }
    if (!w->rules->search_px || !track_any_lost(w)) {
        return;
    }
    retry_by_search(w, before);
    if (!w->points->neighbours) {
        return;
    }
    track_mark_covered(w);
    track_mark_strays(w);
    memset(w->tried, 0, (size_t)count);
    for (int round = 0; round < MOST_ROUNDS && retry_by_neighbours(w); ++round) {
    }
    mark_lone(w, before);
}

int track_lost_hold(const struct track_work *w, const struct track_memory *before)
{
    const int count = w->points->count;
    int good = 0;
    for (int i = 0; i < count; ++i) {
        good += !w->reasons[i];
    }
    if (!w->points->neighbours || good * 3 >= count) {
        return 0;
    }
    for (int i = 0; i < count; ++i) {
        w->reasons[i] = w->reasons[i] ? w->reasons[i] : TRACK_STRAYED;
        w->poses[i] = before->poses[i];
    }
    memset(w->tried, 1, (size_t)count);
    return 1;
}

void track_settle(const struct track_work *w, const struct track_memory *before)
{
    const int count = w->points->count;
    unsigned char *unplaced = w->tried;
    memcpy(unplaced, w->reasons, (size_t)count);
    for (int i = 0; i < count; ++i) {
        if (w->reasons[i]) {
            w->poses[i] = before->poses[i];
            track_note_moved(w, i);
        }
    }
    int placed = w->points->neighbours > 0;
    for (int round = 0; placed && round < MOST_ROUNDS; ++round) {
        placed = 0;
        for (int i = 0; i < count; ++i) {
            struct track_pose pose;
            if (unplaced[i] && place_by_neighbours(w, unplaced, i, &pose)) {
                w->poses[i] = pose;
                track_note_moved(w, i);
                unplaced[i] = 0;
                ++placed;
            }
        }
    }
}
