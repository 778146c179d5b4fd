/* Three instructions of the core that need assembly, in start.c. */
#ifndef CPU_H
#define CPU_H

#include <stdint.h>

/* Disable interrupts. Returns the argument of cpu_unlock. */
uint32_t cpu_lock(void);

/* Restore the state before cpu_lock. */
void cpu_unlock(uint32_t before);

/* Sleep until an interrupt is pending, also while they are disabled, so that none is missed. */
void cpu_sleep(void);

/* In board.c, called by start.c: first of all, and by the interrupts. */
void board_early(void);
void board_sample(void);
void board_link(void);

/* In board.c: clear the enable pin, from any context. */
void board_drop(void);

#endif
