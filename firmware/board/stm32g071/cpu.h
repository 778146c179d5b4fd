/* What no register does: three instructions of the core, in start.c. */
#ifndef CPU_H
#define CPU_H

#include <stdint.h>

/* Interrupts off. Returns what cpu_unlock takes. */
uint32_t cpu_lock(void);

/* As it was before cpu_lock. */
void cpu_unlock(uint32_t before);

/* Until an interrupt waits, also while they are off: none slips between a look and the sleep. */
void cpu_sleep(void);

/* board.c, called by start.c: ahead of everything, and by the interrupts. */
void board_early(void);
void board_sample(void);
void board_link(void);

/* board.c: the enable pin down, from wherever it is called. */
void board_drop(void);

#endif
