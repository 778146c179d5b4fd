/* Functions that a board provides; each folder in board/ implements them. */
#ifndef BOARD_H
#define BOARD_H

#include "app.h"
#include "sampler.h"

/* Converters, timers, link, watchdog. The output is at 0 and the enable pin inactive before main
 * starts. Returns HP_FAULT_: why the microcontroller was reset, none after power-up. */
uint8_t board_init(void);

/* Code of the internal 1.1 V reference relative to the supply, 10 bits; 0: not measured. */
uint16_t board_supply(void);

/* Sleep until a frame after `last` is complete, and latch its window and alarms into *in. Returns
 * its number. */
uint16_t board_wait(uint16_t last, app_inputs *in);

/* The enable pin at once, and the output code, clamped once more, at a fixed place of the frame:
 * the time from a reading to its output does not depend on the code's path. A pin that an interrupt
 * has dropped stays so until this is called with enable 0. */
void board_output(uint16_t code, uint8_t enable);

/* Note that an update was completed: the only place that resets the watchdog, and only if sampling
 * continued since the last one. */
void board_done(uint16_t update);

/* CPU cycles since a fixed instant, modulo 16,000. */
uint16_t board_cycles(void);

/* Read one byte of the link into *byte; returns 0 if there is none. */
uint8_t board_receive(uint8_t *byte);

/* Send n bytes; all of them, or none (returns 0). */
uint8_t board_send(const uint8_t *bytes, uint8_t n);

#endif
