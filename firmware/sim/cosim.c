/* SPDX-License-Identifier: BSD-3-Clause (the program, linked with libsimavr, is under the GPL; see
 * LICENSE.md)
 *
 * Co-simulation of the microcontroller, instruction by instruction, with the twin's physics.
 *     cosim FIRMWARE.elf PHYSICS.bin      commands on stdin, replies on stdout
 *     cosim --sizes                       bytes of the twin's parameters and state
 *
 * A slot of 2,000 cycles, 125 us, is 20 steps of the twin. When timer 1 starts a conversion, the
 * twin is stepped up to that instant, and the converter samples its present value.
 *
 * Commands, one per line; the reply to each is lines and then "ok ...":
 *     run CYCLES            out CYCLE CODE ENABLE | uart HEX | track CYCLE LENGTH_M HIGH_V
 *     send HEX              bytes to the microcontroller, at 500,000 baud
 *     track SLOTS           a track line every SLOTS slots; 0: none
 *     fault NAME            hang | hang_blind | carrier | wire_v | wire_i | level | stuck |
 *                           breakdown | stall | brown_out | none
 *     flip ADDRESS BIT      in the data memory: registers, I/O, RAM
 *     peek ADDRESS COUNT    hex
 *     connect FARAD OHM     a reference in place of the actuator; 0 0: the actuator
 *     load NEWTON
 *     rail VOLT ...         drive of the next slots by a separate supply instead of the output
 *                           converter; the last value is kept; the enable pin still switches it off
 *     quit
 */
#include <math.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include <simavr/avr_adc.h>
#include <simavr/avr_timer.h>
#include <simavr/avr_uart.h>
#include <simavr/sim_avr.h>
#include <simavr/sim_cycle_timers.h>
#include <simavr/sim_elf.h>
#include <simavr/sim_io.h>

#include "twin/twin.h"

#define SLOT_CYCLES 2000
#define STEP_CYCLES 100
#define CONVERSION_CYCLES 1728
#define BYTE_CYCLES 352 /* the simulator uses 11 bits per byte */
#define PORTB_ADDRESS 0x25
#define DDRB_ADDRESS 0x24
#define MCUSR_ADDRESS 0x54
#define ADMUX_ADDRESS 0x7c
#define SP_ADDRESS 0x5d
#define CS 0x01
#define CLOCK 0x02
#define DATA 0x04
#define ENABLE 0x10
#define DAC_V 2.048
#define CARRIER_V 0.05    /* peak, at the high-voltage module's input */
#define CARRIER_HZ 5000.0
#define V_STAGE 50.0      /* analogue stages: band-pass about the middle of 5 V */
#define I_STAGE 0.8
#define HIGH_PASS_HZ 5000.0
#define LOW_PASS_HZ 8000.0
#define MOST_QUEUED 4096
#define MOST_RAIL 512

typedef struct {
    double input, passed, output;
} stage;

typedef struct {
    avr_t *avr;
    avr_irq_t *adc, *trigger, *uart;
    twin_parameters parameters;
    twin_state plant;
    double load_n;
    /* high-voltage module */
    uint16_t code, spi_word;
    uint8_t spi_bits, pins, enable;
    double before_v, after_v; /* drive at the slot's start and now */
    avr_cycle_count_t slot_start, changed;
    int toggles;              /* of the carrier in this slot */
    int no_carrier, no_v, no_i, no_level, stall, stuck;
    stage v, i;
    uint32_t held_mv;
    /* separate supply: the drive slot by slot */
    double rail_v[MOST_RAIL];
    unsigned rail_count, rail_at; /* no count: the output converter drives the module */
    /* book-keeping */
    avr_cycle_count_t asleep, next_byte;
    uint8_t queue[MOST_QUEUED];
    unsigned queued, sent;
    uint8_t uart_bytes[MOST_QUEUED]; /* from the chip, until the end of the command */
    unsigned received;
    unsigned resets, crashes, conversions, short_slots;
    uint16_t lowest_sp;
    unsigned track_every, slots;
} bench;

static bench *the_bench; /* the simulator's sleep callback has no user argument */

static void on_sleep(avr_t *avr, avr_cycle_count_t cycles)
{
    (void)avr;
    the_bench->asleep += cycles + 1;
}

static void ignore_log(avr_t *avr, const int level, const char *format, va_list arguments)
{
    (void)avr, (void)level, (void)format, (void)arguments;
}

/* ---- the plant ---- */

static double drive_of(const bench *b)
{
    return b->enable ? b->code * DAC_V / 4096.0 : 0.0;
}

/* High pass and low pass, each of one pole. */
static void filter(stage *s, double input)
{
    const double dt = STEP_CYCLES / 16e6;
    const double keep = 1.0 / (1.0 + 6.283185307179586 * HIGH_PASS_HZ * dt);
    const double follow = 1.0 - exp(-6.283185307179586 * LOW_PASS_HZ * dt);
    s->passed = keep * (s->passed + input - s->input);
    s->input = input;
    s->output += follow * (s->passed - s->output);
}

static uint32_t to_millivolt(double volt)
{
    const double mv = 1000.0 * volt + 2500.0;
    return mv < 0.0 ? 0 : mv > 5000.0 ? 5000 : (uint32_t)lrint(mv);
}

/* The supply's drive of the next slot. */
static double next_rail(bench *b)
{
    const double v = b->rail_v[b->rail_at];
    if (b->rail_at + 1 < b->rail_count) {
        ++b->rail_at;
    }
    return b->enable ? v : 0.0;
}

/* One slot of the twin, with the output at its start and at its end. */
static void step_plant(bench *b)
{
    int16_t codes[2 * TWIN_SUB];
    double length_m;
    avr_cycle_count_t at = b->changed > b->slot_start ? b->changed - b->slot_start : 0;
    int k;

    if (b->rail_count) {
        b->after_v = next_rail(b);
        at = 0;
    }
    at = at < SLOT_CYCLES ? at : SLOT_CYCLES;
    b->parameters.carrier_v =
        b->enable && b->toggles > 0 && !b->no_carrier ? CARRIER_V : 0.0;
    b->toggles = 0;
    twin_acquire(&b->parameters, &b->plant, b->before_v, b->after_v, (int32_t)(at / STEP_CYCLES),
                 b->load_n, TWIN_SUB, codes, &length_m);
    b->before_v = b->after_v;
    for (k = 0; k < TWIN_SUB; ++k) {
        filter(&b->v, b->no_v ? 0.0 : codes[2 * k] * b->parameters.lsb_v);
        filter(&b->i, b->no_i ? 0.0 : codes[2 * k + 1] * b->parameters.lsb_v);
    }
    ++b->slots;
    if (b->track_every && b->slots % b->track_every == 0) {
        printf("track %llu %.9g %.9g\n", (unsigned long long)b->avr->cycle, b->plant.motion.length_m,
               b->plant.amp_v);
    }
}

/* Sampled value of a channel. */
static uint32_t hold(const bench *b, int channel)
{
    const double level = b->no_level ? 0.0 : 1000.0 * b->v.input;
    switch (channel) {
    case 0:
        return to_millivolt(V_STAGE * b->v.output);
    case 1:
        return to_millivolt(I_STAGE * b->i.output);
    default:
        return level < 0.0 ? 0 : level > 5000.0 ? 5000 : (uint32_t)lrint(level);
    }
}

/* The simulator reads the pin when the result is fetched, with the channel selected by then; real
 * hardware latches both at the start. So from the start on all pins are held. */
static avr_cycle_count_t on_converted(avr_t *avr, avr_cycle_count_t when, void *context)
{
    bench *b = context;
    (void)avr, (void)when;
    avr_raise_irq(b->adc + 0, b->held_mv);
    avr_raise_irq(b->adc + 1, b->held_mv);
    avr_raise_irq(b->adc + 2, b->held_mv);
    return 0;
}

/* Timer 1, compare B: bring the plant to this instant, then let the converter take its sample. */
static void on_compare(avr_irq_t *irq, uint32_t value, void *context)
{
    bench *b = context;
    (void)irq, (void)value;
    if (b->avr->cycle - b->slot_start < SLOT_CYCLES - STEP_CYCLES) {
        ++b->short_slots;
    }
    step_plant(b);
    b->slot_start = b->avr->cycle;
    if (b->stall) {
        return; /* the converter does not start */
    }
    b->held_mv = hold(b, b->avr->data[ADMUX_ADDRESS] & 7);
    avr_cycle_timer_register(b->avr, CONVERSION_CYCLES, on_converted, b);
    ++b->conversions;
    avr_raise_irq(b->trigger, 1);
}

static void on_carrier(avr_irq_t *irq, uint32_t value, void *context)
{
    (void)irq, (void)value;
    ++((bench *)context)->toggles;
}

/* ---- pins of the microcontroller ---- */

static void output_changed(bench *b)
{
    if (!b->rail_count && (!b->stuck || !b->enable)) { /* a stuck module ignores its input */
        b->after_v = drive_of(b);
    }
    b->changed = b->avr->cycle;
    printf("out %llu %u %u\n", (unsigned long long)b->avr->cycle, b->code, b->enable);
}

/* Bytes of the link, as one line. */
static void print_uart(bench *b)
{
    unsigned k;
    if (b->received) {
        fputs("uart ", stdout);
        for (k = 0; k < b->received; ++k) {
            putchar("0123456789abcdef"[b->uart_bytes[k] >> 4]);
            putchar("0123456789abcdef"[b->uart_bytes[k] & 15]);
        }
        putchar('\n');
        b->received = 0;
    }
}

static void on_uart(avr_irq_t *irq, uint32_t value, void *context)
{
    bench *b = context;
    (void)irq;
    if (b->received == MOST_QUEUED) {
        print_uart(b);
    }
    b->uart_bytes[b->received++] = (uint8_t)value;
}

/* The output converter: shifts data in at rising clocks, takes it over when deselected. */
static void look_at_converter(bench *b, uint8_t pins)
{
    const uint8_t rises = pins & (uint8_t)~b->pins, falls = b->pins & (uint8_t)~pins;
    if (falls & CS) {
        b->spi_bits = 0;
    }
    if (!(pins & CS) && (rises & CLOCK)) {
        b->spi_word = (uint16_t)((b->spi_word << 1) | ((pins & DATA) != 0));
        ++b->spi_bits;
    }
    if ((rises & CS) && b->spi_bits == 16) {
        const uint16_t code = b->spi_word & 0x1000u ? b->spi_word & 0xfffu : 0;
        if (code != b->code) {
            b->code = code;
            output_changed(b);
        }
    }
}

static uint16_t stack_of(const avr_t *a)
{
    return (uint16_t)(a->data[SP_ADDRESS] | a->data[SP_ADDRESS + 1] << 8);
}

static void look_at_pins(bench *b)
{
    const uint8_t *data = b->avr->data;
    const uint8_t pins = data[PORTB_ADDRESS] & data[DDRB_ADDRESS];
    const uint8_t enable = (pins & ENABLE) != 0; /* pulled down if it is not an output */
    const uint16_t sp = stack_of(b->avr);
    if (pins != b->pins) {
        look_at_converter(b, pins);
        if (enable != b->enable) {
            b->enable = enable;
            output_changed(b);
        }
        b->pins = pins;
    }
    if (sp < b->lowest_sp && sp > 0x200) {
        b->lowest_sp = sp;
    }
}

/* ---- faults ---- */

static void spin_here(bench *b)
{
    avr_t *a = b->avr;
    a->flash[a->pc] = 0xff; /* rjmp .-2 */
    a->flash[a->pc + 1] = 0xcf;
}

static int set_fault(bench *b, const char *name)
{
    if (!strcmp(name, "hang") || !strcmp(name, "hang_blind")) {
        avr_t *a = b->avr;
        while (!a->sreg[S_I] || a->state != cpu_Running) { /* in the main program */
            avr_run(a);
            look_at_pins(b);
        }
        if (!strcmp(name, "hang_blind")) {
            a->sreg[S_I] = 0;
        }
        spin_here(b);
    } else if (!strcmp(name, "carrier")) {
        b->no_carrier = 1;
    } else if (!strcmp(name, "wire_v")) {
        b->no_v = 1;
    } else if (!strcmp(name, "wire_i")) {
        b->no_i = 1;
    } else if (!strcmp(name, "breakdown")) {
        b->plant.broken = 1;
    } else if (!strcmp(name, "level")) {
        b->no_level = 1;
    } else if (!strcmp(name, "stuck")) {
        b->stuck = 1;
    } else if (!strcmp(name, "stall")) {
        b->stall = 1;
    } else if (!strcmp(name, "brown_out")) {
        avr_reset(b->avr);
        b->avr->data[MCUSR_ADDRESS] = 0x04;
    } else if (!strcmp(name, "none")) {
        b->no_carrier = b->no_v = b->no_i = b->no_level = b->stall = b->stuck = 0;
        b->plant.broken = 0;
    } else {
        return 0;
    }
    return 1;
}

/* ---- time ---- */

static void feed_uart(bench *b)
{
    if (b->sent < b->queued && b->avr->cycle >= b->next_byte) {
        avr_raise_irq(b->uart, b->queue[b->sent++]);
        b->next_byte = b->avr->cycle + BYTE_CYCLES;
    }
    if (b->sent == b->queued) {
        b->sent = b->queued = 0;
    }
}

static void run(bench *b, avr_cycle_count_t cycles)
{
    avr_t *a = b->avr;
    const avr_cycle_count_t end = a->cycle + cycles;
    while (a->cycle < end) {
        const avr_flashaddr_t before = a->pc;
        const int state = avr_run(a);
        if (state == cpu_Crashed || state == cpu_Done || stack_of(a) > a->ramend ||
            a->pc >= a->flashend) {
            /* Real hardware would keep executing; stopping is the harder case, since only the
             * watchdog ends it. */
            ++b->crashes;
            a->pc = before < a->flashend ? before : a->flashend - 1;
            a->data[SP_ADDRESS] = (uint8_t)(a->ramend & 0xff);
            a->data[SP_ADDRESS + 1] = (uint8_t)(a->ramend >> 8);
            spin_here(b);
            a->state = cpu_Running;
        }
        if (a->pc == a->reset_pc && before != a->reset_pc) {
            ++b->resets;
        }
        look_at_pins(b);
        feed_uart(b);
        while (a->cycle - b->slot_start > 2 * SLOT_CYCLES) { /* no sampling: time passes anyhow */
            step_plant(b);
            b->slot_start += SLOT_CYCLES;
        }
    }
}

/* ---- commands ---- */

static int from_hex(bench *b, const char *text)
{
    unsigned byte;
    for (; sscanf(text, "%2x", &byte) == 1; text += 2) {
        if (b->queued == MOST_QUEUED) {
            return 0;
        }
        b->queue[b->queued++] = (uint8_t)byte;
    }
    return 1;
}

static int take_rail(bench *b, char *text)
{
    char *end = text;
    b->rail_at = b->rail_count = 0;
    for (; b->rail_count < MOST_RAIL; ++b->rail_count) {
        b->rail_v[b->rail_count] = strtod(text, &end);
        if (end == text) {
            break;
        }
        text = end;
    }
    return b->rail_count > 0 && *end == 0;
}

static int obey(bench *b, char *line)
{
    char *rest = strchr(line, ' ');
    unsigned long long first = 0;
    unsigned address = 0, count = 0;
    double farad = 0.0, ohm = 0.0;
    rest = rest ? rest + 1 : line + strlen(line);
    if (!strncmp(line, "run ", 4) && sscanf(rest, "%llu", &first) == 1) {
        run(b, first);
    } else if (!strncmp(line, "send ", 5)) {
        return from_hex(b, rest);
    } else if (!strncmp(line, "track ", 6)) {
        return sscanf(rest, "%u", &b->track_every) == 1;
    } else if (!strncmp(line, "fault ", 6)) {
        return set_fault(b, rest);
    } else if (!strncmp(line, "flip ", 5) && sscanf(rest, "%u %u", &address, &count) == 2) {
        b->avr->data[address % (b->avr->ramend + 1u)] ^= (uint8_t)(1u << (count & 7u));
    } else if (!strncmp(line, "peek ", 5) && sscanf(rest, "%u %u", &address, &count) == 2) {
        printf("peek ");
        for (; count-- && address <= b->avr->ramend; ++address) {
            printf("%02x", b->avr->data[address]);
        }
        printf("\n");
    } else if (!strncmp(line, "connect ", 8) && sscanf(rest, "%lf %lf", &farad, &ohm) == 2) {
        twin_connect(&b->plant, farad, ohm);
    } else if (!strncmp(line, "rail ", 5)) {
        return take_rail(b, rest);
    } else if (!strncmp(line, "load ", 5)) {
        return sscanf(rest, "%lf", &b->load_n) == 1;
    } else {
        return 0;
    }
    return 1;
}

static int load_physics(bench *b, const char *path)
{
    FILE *file = fopen(path, "rb");
    int good;
    if (!file) {
        return 0;
    }
    good = fread(&b->parameters, sizeof b->parameters, 1, file) == 1 &&
           fread(&b->plant, sizeof b->plant, 1, file) == 1 &&
           fread(&b->load_n, sizeof b->load_n, 1, file) == 1;
    fclose(file);
    b->parameters.sample_s = STEP_CYCLES / 16e6;
    b->parameters.skew_s = 0.0;
    b->parameters.carrier_v = 0.0;
    b->parameters.carrier_rad_s = 6.283185307179586 * CARRIER_HZ;
    twin_prepare(&b->parameters);
    b->plant.time_s = 0.0;
    return good;
}

static int start(bench *b, const char *elf, uint32_t supply_mv)
{
    elf_firmware_t firmware;
    uint32_t flags = 0;
    uint8_t *data;
    memset(&firmware, 0, sizeof firmware);
    avr_global_logger_set(ignore_log);
    if (elf_read_firmware(elf, &firmware) != 0 ||
        !(b->avr = avr_make_mcu_by_name("atmega2560"))) {
        return 0;
    }
    avr_init(b->avr);
    /* The simulator reports a write beyond the RAM, then does it anyway. */
    if (!(data = calloc(1, 0x10100))) {
        return 0;
    }
    memcpy(data, b->avr->data, b->avr->ramend + 1u);
    free(b->avr->data);
    b->avr->data = data;
    firmware.frequency = 16000000;
    firmware.vcc = firmware.avcc = firmware.aref = supply_mv;
    avr_load_firmware(b->avr, &firmware);
    b->avr->frequency = 16000000;
    b->avr->sleep = on_sleep;
    avr_ioctl(b->avr, AVR_IOCTL_UART_SET_FLAGS('0'), &flags);
    b->adc = avr_io_getirq(b->avr, AVR_IOCTL_ADC_GETIRQ, ADC_IRQ_ADC0);
    b->trigger = avr_io_getirq(b->avr, AVR_IOCTL_ADC_GETIRQ, ADC_IRQ_IN_TRIGGER);
    b->uart = avr_io_getirq(b->avr, AVR_IOCTL_UART_GETIRQ('0'), UART_IRQ_INPUT);
    avr_irq_register_notify(avr_io_getirq(b->avr, AVR_IOCTL_UART_GETIRQ('0'), UART_IRQ_OUTPUT),
                            on_uart, b);
    avr_irq_register_notify(
        avr_io_getirq(b->avr, AVR_IOCTL_TIMER_GETIRQ('1'), TIMER_IRQ_OUT_COMP + 1), on_compare, b);
    avr_irq_register_notify(
        avr_io_getirq(b->avr, AVR_IOCTL_TIMER_GETIRQ('3'), TIMER_IRQ_OUT_COMP + 0), on_carrier, b);
    return b->adc && b->trigger && b->uart;
}

int main(int argc, char **argv)
{
    static bench b;
    static char line[2 * MOST_QUEUED + 64];
    the_bench = &b;
    if (argc == 2 && !strcmp(argv[1], "--sizes")) {
        printf("%zu %zu\n", sizeof(twin_parameters), sizeof(twin_state));
        return 0;
    }
    b.lowest_sp = 0xffff;
    if (argc < 3 || argc > 4 ||
        !start(&b, argv[1], argc == 4 ? (uint32_t)strtoul(argv[3], NULL, 10) : 5000u) || !load_physics(&b, argv[2])) {
        fprintf(stderr, "usage: cosim FIRMWARE.elf PHYSICS.bin [SUPPLY_MV]\n");
        return 2;
    }
    while (fgets(line, sizeof line, stdin)) {
        line[strcspn(line, "\r\n")] = 0;
        if (!strcmp(line, "quit")) {
            break;
        }
        if (!obey(&b, line)) {
            printf("bad %s\n", line);
        }
        print_uart(&b);
        printf("ok cycle=%llu asleep=%llu resets=%u crashes=%u conversions=%u short_slots=%u "
               "stack=%u code=%u enable=%u length=%.9g high=%.9g broken=%d\n",
               (unsigned long long)b.avr->cycle, (unsigned long long)b.asleep, b.resets, b.crashes,
               b.conversions, b.short_slots,
               b.lowest_sp > b.avr->ramend ? 0 : b.avr->ramend - b.lowest_sp, b.code, b.enable,
               b.plant.motion.length_m, b.plant.amp_v, b.plant.broken);
        fflush(stdout);
    }
    return 0;
}
