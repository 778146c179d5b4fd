/* From reset to main, and the vectors. A fault clears the enable pin and waits for the watchdog.
 * The stack is below all variables: if it overflows, no variable is overwritten, but the core
 * faults without a stack and locks up, and the watchdog resets it. */
#include "cpu.h"

#define TABLE __attribute__((section(".vectors"), used))

extern uint32_t stack_end[];       /* of chip.ld, as all of these */
extern uint32_t data_start[];      /* variables with a value, in RAM */
extern const uint32_t data_kept[]; /* their values, in flash */
extern uint32_t bss_start[];
extern const uint8_t data_words[], bss_words[]; /* their addresses are how many */

int main(void);
void reset(void);
void fault(void);

uint32_t cpu_lock(void)
{
    uint32_t before;
    __asm__ volatile("mrs %0, primask\n\tcpsid i" : "=r"(before) : : "memory");
    return before;
}

void cpu_unlock(uint32_t before)
{
    __asm__ volatile("msr primask, %0" : : "r"(before) : "memory");
}

void cpu_sleep(void)
{
    __asm__ volatile("wfi" : : : "memory");
}

/* A fault, an unexpected interrupt, or the end of main: the watchdog resets, and the first action
 * after reset is output 0. */
void fault(void)
{
    cpu_lock();
    board_drop();
    for (;;) {
    }
}

void reset(void)
{
    uint32_t k;
    board_early();
    for (k = 0; k < (uint32_t)data_words; ++k) {
        data_start[k] = data_kept[k];
    }
    for (k = 0; k < (uint32_t)bss_words; ++k) {
        bss_start[k] = 0;
    }
    main();
    fault();
}

typedef void (*handler)(void);

/* The core's sixteen, then the device's 31; reserved ones fault too. */
typedef struct {
    uint32_t *stack;
    handler entry[46];
} vectors;

TABLE const vectors vector_table = {
    stack_end,
    {reset, fault, fault, fault, fault, fault, fault, fault, fault, fault, fault, fault, fault,
     fault, fault,
     /* 0 to 15 of the device */
     fault, fault, fault, fault, fault, fault, fault, fault, fault, fault, fault, fault, fault,
     fault, fault, fault,
     board_sample, /* 16: timer 3 */
     fault, fault, fault, fault, fault, fault, fault, fault, fault, fault, fault,
     board_link, /* 28: USART 2 */
     fault, fault},
};
