/* Reads 256 MB from memory with one thread or two, best of five, and prints GB/s of each. */
#include <pthread.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

#define BYTES ((size_t)256 << 20)
#define LANES 64

typedef struct {
    const uint64_t *from;
    size_t count;
    uint64_t sum;
} part;

static double now_s(void)
{
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return (double)t.tv_sec + 1e-9 * (double)t.tv_nsec;
}

__attribute__((target_clones("avx512f", "avx2", "default"))) static uint64_t
add(const uint64_t *x, size_t count)
{
    uint64_t lane[LANES] = {0}, sum = 0;
    size_t k, j;
    for (k = 0; k + LANES <= count; k += LANES) {
        for (j = 0; j < LANES; ++j) {
            lane[j] += x[k + j];
        }
    }
    for (j = 0; j < LANES; ++j) {
        sum += lane[j];
    }
    return sum;
}

static void *work(void *what)
{
    part *p = what;
    p->sum = add(p->from, p->count);
    return NULL;
}

int main(void)
{
    uint64_t *x = malloc(BYTES), check = 0;
    const size_t count = BYTES / sizeof *x;
    int threads, round, k;
    if (x == NULL) {
        return 1;
    }
    memset(x, 1, BYTES);
    for (threads = 1; threads <= 2; ++threads) {
        double best = 0.0;
        for (round = 0; round < 5; ++round) {
            pthread_t other[2];
            part parts[2];
            const double start = now_s();
            double rate;
            for (k = 0; k < threads; ++k) {
                parts[k].from = x + count / (size_t)threads * (size_t)k;
                parts[k].count = count / (size_t)threads;
                pthread_create(&other[k], NULL, work, &parts[k]);
            }
            for (k = 0; k < threads; ++k) {
                pthread_join(other[k], NULL);
                check += parts[k].sum;
            }
            rate = (double)BYTES / (now_s() - start) / 1e9;
            best = rate > best ? rate : best;
        }
        printf("%.2f\n", best);
    }
    free(x);
    return check == 0;
}
