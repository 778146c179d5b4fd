/* What the controller asks of a board; one folder in board/ fulfils it. */
#ifndef BOARD_H
#define BOARD_H

#include "app.h"
#include "sampler.h"

/* Converters, timers, link, watchdog. The output is at 0 and the enable pin inactive before main
 * already. Returns HP_FAULT_: why the chip was reset, none after power-up. */
uint8_t board_init(void);

/* Code of the chip's own 1.1 V reference against its analogue supply, 10 bits; 0: not measured. */
uint16_t board_supply(void);

/* Sleep until a frame after `last` is complete, and latch its window and alarms into *in. Returns
 * its number. */
uint16_t board_wait(uint16_t last, app_inputs *in);

/* The enable pin at once, and the output code, clamped once more, at a fixed place of the frame:
 * the time from a reading to its output does not depend on the code's path. A pin that an interrupt
 * has dropped stays so until this is called with enable 0. */
void board_output(uint16_t code, uint8_t enable);

/* An update was completed: the only place that keeps the watchdog quiet, and only where the
 * sampling went on since the last one. */
void board_done(uint16_t update);

/* CPU cycles since a fixed instant, modulo 16,000. */
uint16_t board_cycles(void);

/* One byte of the link into *byte; 0 where there is none. */
uint8_t board_receive(uint8_t *byte);

/* n bytes to the link, all or (returns 0) none. */
uint8_t board_send(const uint8_t *bytes, uint8_t n);

#endif
