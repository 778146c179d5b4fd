/* Checks for the host tests of core/: each failure is one line; check_end() is the exit code. */
#ifndef CHECK_H
#define CHECK_H

#include <stdint.h>
#include <stdio.h>

static int check_failures;

/* `form` and what follows: printf arguments that tell what was got. */
#define CHECK(condition, ...)                                                                      \
    do {                                                                                           \
        if (!(condition)) {                                                                        \
            ++check_failures;                                                                      \
            fprintf(stderr, "%s:%d: %s: ", __FILE__, __LINE__, #condition);                        \
            fprintf(stderr, __VA_ARGS__);                                                          \
            fputc('\n', stderr);                                                                   \
        }                                                                                          \
    } while (0)

static inline int check_end(void) { return check_failures == 0 ? 0 : 1; }

/* Half a unit in the last place of 1: the largest relative error of one float operation. */
#define ROUNDOFF 5.9604644775390625e-8

/* Numerical Recipes' "quick and dirty" generator: the same bits everywhere. */
static inline uint32_t check_draw(uint32_t *state)
{
    *state = *state * 1664525u + 1013904223u;
    return *state;
}

/* Uniform in [low, high). */
static inline float check_uniform(uint32_t *state, float low, float high)
{
    return low + (high - low) * (float)(check_draw(state) >> 8) * 5.9604645e-8f;
}

#endif
