/* The summary of a tracking step, see track_step.h. */
#include <math.h> /* fabs */

#include "tracking/track_neighbours.h"
#include "tracking/track_work.h"

enum { FEW = 25 };

/* See struct track_summary; medians over a sample of the believed points. */
struct track_summary track_summarise(const struct track_work *w, const struct track_memory *before)
{
    double surprise[2 * FEW], level[2 * FEW];
    const int count = w->points->count, step = count / FEW + 1;
    struct track_summary s = {0};
    int kept = 0;
    for (int i = 0; i < count; ++i) {
        s.believed_before += !before->reasons[i];
        s.ambiguous += (before->reasons[i] & TRACK_AMBIGUOUS) != 0;
        s.strayed += (w->reasons[i] & TRACK_STRAYED) != 0;
        if (w->reasons[i]) {
            s.newly_lost += !before->reasons[i] && !(w->reasons[i] & TRACK_LEFT);
            continue;
        }
        const struct track_pose *now = &w->poses[i], *then = &before->poses[i];
        const double x = fabs(now->x - then->x - before->velocity[2 * i]);
        const double y = fabs(now->y - then->y - before->velocity[2 * i + 1]);
        const float away = (float)(x > y ? x : y);
        const double *std = w->stds + 2 * i;
        const float wide = (float)(std[0] > std[1] ? std[0] : std[1]);
        ++s.believed;
        s.most_surprise_px = away > s.most_surprise_px ? away : s.most_surprise_px;
        s.largest_std_px = wide > s.largest_std_px ? wide : s.largest_std_px;
        if (i % step == 0) {
            const float reference = w->points->noise[i].level;
            surprise[kept] = (double)away;
            level[kept++] = (double)(w->results[i].level / (reference > 1.0f ? reference : 1.0f));
        }
    }
    if (kept) {
        const double middle = track_median(level, kept);
        s.surprise_px = (float)track_median(surprise, kept);
        for (int k = 0; k < kept; ++k) {
            level[k] = fabs(level[k] - middle);
        }
        track_median(level, kept); /* sorts */
        s.unevenness = (float)(level[kept * 9 / 10] / (middle > 1e-3 ? middle : 1e-3));
    }
    return s;
}
