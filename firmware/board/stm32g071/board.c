/* STM32G071 (Cortex-M0+, no floating-point unit) at 16 MHz, internal oscillator as after reset: no
 * flash wait states, cycles of an update count as on the ATmega2560. One frame is 1 ms:
 *
 *   timer 3   every 2,000 cycles: starts a conversion by hardware, and 400 cycles later, when it is
 *             done, the sampling interrupt (pin PA7 toggles at the start to trigger a scope)
 *   timer 14  carrier: square wave of 5 kHz on PB1, filtered to a sine outside
 *   timer 2   16,000 cycles: gives the slot, one of eight in a frame
 *   ADC       8 MHz clock, 12 bits, 11.5 us a conversion; a sequence of eight, one a trigger: PA4
 *             level of the high voltage first, then PA1 current and PA0 voltage in turns
 *   SPI 1     MCP4921, on 3.3 V: PB0 select, PB3 clock, PB5 data; 12 bits, 2.048 V
 *   PB4       enable of the high-voltage module, active high, pulled down outside
 *   USART 2   PA2 out, PA3 in, 500,000 baud
 *   watchdog  15 ms, with a separate oscillator
 *
 * Counted in an emulator, cycles by the processor's manual: the sampling interrupt takes 175 cycles
 * of the 2,000 from one to the next, 290 if it writes the output. Not tested on hardware.
 */
#include "board.h"

#include "cpu.h"
#include "registers.h"
#include "settings.h"

#define SLOT_CYCLES 2000u
#define FRAME_CYCLES 16000u
#define CARRIER_CYCLES 3200u
#define READ_CYCLES 400u  /* from a conversion's start, which takes 190, to the interrupt */
#define AHEAD_CYCLES 500u /* the timers begin here in the last slot: slot 0 is converted first */
#define HIGHEST_CODE 4095u
#define LAST_SLOT (SAMPLER_SLOTS - 1u)

#define VOLTAGE 0u /* channels */
#define CURRENT 1u
#define LEVEL 4u
/* First slot to last, from the lowest bits: L C V C V C V C. */
#define SEQUENCE                                                                                   \
    (LEVEL | (CURRENT << 4) | (VOLTAGE << 8) | (CURRENT << 12) | (VOLTAGE << 16) |                 \
     (CURRENT << 20) | (VOLTAGE << 24) | (CURRENT << 28))

#define SELECT GPIO_PIN(0u) /* of port B */
#define ENABLE GPIO_PIN(4u)
#define DAC_ACTIVE 0x3000u /* gain 1, not shut down */

#define BAUD_CYCLES 32u /* 500,000 baud */
#define WATCHDOG_TICKS 120u /* of 8 kHz: 15 ms */
#define MOST_LOOKS 2000u /* readings of a hardware flag before continuing without it */

#define RECEIVE_BYTES 64u
#define SEND_BYTES 128u
#define RAN 0x52414e21u /* in memory that survives a short dip of the supply */

static volatile sampler samples;
static volatile uint16_t pending; /* output code of the last update */
static volatile uint8_t dropped;  /* an interrupt has cleared the enable pin */
static volatile uint8_t received[RECEIVE_BYTES], receive_put;
static volatile uint8_t to_send[SEND_BYTES], send_put, send_got;
static uint8_t receive_got;
static uint32_t reset_cause __attribute__((section(".noinit")));
static uint32_t ran __attribute__((section(".noinit")));

static void look_for(const volatile uint32_t *unit, uint32_t bits, uint32_t value)
{
    uint32_t left = MOST_LOOKS;
    while ((*unit & bits) != value && --left > 0) {
    }
}

/* 16 bits at 8 MHz, 32 cycles; a unit that hangs is abandoned, and the converter ignores an
 * incomplete word. */
static inline void dac_write(uint16_t code)
{
    uint8_t left = 32;
    GPIOB.odr &= ~SELECT;
    SPI1.dr = (uint16_t)(DAC_ACTIVE | code);
    while (!(SPI1.sr & SPI_RECEIVED) && --left > 0) {
    }
    (void)SPI1.dr;
    GPIOB.odr |= SELECT;
}

/* Before main and the initialisation of memory: enable pin inactive, output 0, and a watchdog
 * of 15 ms. Pins of port B: 0 select, 1 carrier, 3 clock, 4 enable, 5 data. */
APP_APART void board_early(void)
{
    RCC.iopenr = RCC_PORT_A | RCC_PORT_B;
    RCC.apbenr2 = RCC_SPI_1;
    (void)RCC.apbenr2; /* the clocks run two cycles after they were switched on */
    GPIOB.odr = SELECT;
    GPIOB.ospeedr = GPIO_TWO(3u, GPIO_FAST) | GPIO_TWO(5u, GPIO_FAST);
    GPIOB.moder = (0xffffffffu & ~(GPIO_TWO(0u, 3u) | GPIO_TWO(3u, 3u) | GPIO_TWO(4u, 3u) |
                                    GPIO_TWO(5u, 3u))) |
                  GPIO_TWO(0u, GPIO_OUTPUT) | GPIO_TWO(3u, GPIO_ALTERNATE) |
                  GPIO_TWO(4u, GPIO_OUTPUT) | GPIO_TWO(5u, GPIO_ALTERNATE);
    SPI1.cr2 = SPI_16_BITS;
    SPI1.cr1 = SPI_MASTER | SPI_OWN_SELECT | SPI_ENABLE;
    dac_write(0);
    reset_cause = RCC.csr;
    RCC.csr = RCC_FORGET;
    IWDG.kr = IWDG_BEGIN; /* its divider is 4 after reset */
    IWDG.kr = IWDG_OPEN;
    IWDG.rlr = WATCHDOG_TICKS - 1u;
    look_for(&IWDG.sr, 0xffffffffu, 0); /* until the new length is in its clock domain */
    IWDG.kr = IWDG_KICK;
}

/* ---- interrupts ---- */

void board_drop(void)
{
    GPIOB.odr &= ~ENABLE;
    dropped = 1;
    pending = 0;
}

/* The converter's sequence must end with the frame given by timer 2. Otherwise it is stopped and
 * restarted with a frame; until then no reading is valid. */
static inline uint8_t keep_in_step(uint32_t flags, uint8_t slot)
{
    const uint8_t ends = (flags & ADC_SEQUENCE_END) != 0;
    const uint8_t in_step = (flags & ADC_CONVERTED) && ends == (slot == LAST_SLOT);
    const uint32_t control = ADC1.cr;
    if (!in_step && (control & ADC_START)) {
        ADC1.cr = ADC_REGULATOR | ADC_STOP;
    } else if (slot == LAST_SLOT && !(control & (ADC_START | ADC_STOP))) {
        ADC1.cr = ADC_REGULATOR | ADC_START;
    }
    return in_step;
}

/* The reading of this slot, finished 200 cycles ago. After the last one of a frame the output of
 * the update changes, as far as possible from the readings that are used: the first of each channel
 * in a frame is not. */
void board_sample(void)
{
    sampler *s = (sampler *)&samples; /* nothing else runs meanwhile */
    const uint32_t flags = ADC1.isr;
    const uint16_t code = (uint16_t)ADC1.dr;
    /* At 400 of the slot's 2,000 cycles: 2^22 / 2097 = 2,000.1. */
    const uint8_t slot = (uint8_t)((TIM2.cnt * 2097u) >> 22) & LAST_SLOT;
    TIM3.sr = ~TIMER_COMPARE_1;
    ADC1.isr = ADC_CONVERTED | ADC_SEQUENCE_END | ADC_OVERRUN;
    if (!keep_in_step(flags, slot)) {
        s->alarms |= HP_ALARM_LOST_SAMPLE;
    }
    if (sampler_take(s, slot, code, HIGHEST_CODE, SETTINGS_LEVEL_FALL,
                     (GPIOB.odr & ENABLE) != 0)) {
        board_drop();
    }
    if (slot == LAST_SLOT) {
        dac_write(pending > SETTINGS_CODE_HIGH ? SETTINGS_CODE_HIGH : pending);
    }
}

/* Less urgent than sampling, which interrupts it. */
void board_link(void)
{
    const uint32_t flags = USART2.isr;
    if (flags & USART_RECEIVED) {
        const uint8_t at = receive_put & (RECEIVE_BYTES - 1u);
        received[at] = (uint8_t)USART2.rdr;
        receive_put = (uint8_t)(at + 1u);
    }
    if ((flags & USART_EMPTY) && (USART2.cr1 & USART_TELLS_EMPTY)) {
        const uint8_t at = send_got & (SEND_BYTES - 1u);
        if (at == send_put) {
            USART2.cr1 &= ~USART_TELLS_EMPTY;
        } else {
            USART2.tdr = to_send[at];
            send_got = (uint8_t)(at + 1u) & (SEND_BYTES - 1u);
        }
    }
}

/* ---- functions of board.h ---- */

/* Power-up and brown-out share one flag: a reset after which memory still contains this value is a
 * brown-out. */
static uint8_t fault_of_reset(void)
{
    const uint8_t was_running = ran == RAN;
    ran = RAN;
    if (reset_cause & RCC_BY_WATCHDOG) {
        return HP_FAULT_WATCHDOG;
    }
    return (reset_cause & RCC_BY_POWER) && was_running ? HP_FAULT_BROWN_OUT : HP_FAULT_NONE;
}

/* Port A: 0, 1, 4 analogue as after reset, 2 and 3 the link, 7 the scope's trigger. */
static void init_pins(void)
{
    GPIOA.afrl = GPIO_FOUR(2u, 1u) | GPIO_FOUR(3u, 1u) | GPIO_FOUR(7u, 1u);
    GPIOA.pupdr |= GPIO_TWO(3u, GPIO_UP); /* an open line idles */
    GPIOA.moder &= ~(GPIO_TWO(2u, 1u) | GPIO_TWO(3u, 1u) | GPIO_TWO(7u, 1u));
    GPIOB.moder &= ~GPIO_TWO(1u, 1u);
}

static void init_link(void)
{
    USART2.brr = BAUD_CYCLES;
    USART2.cr3 = USART_OVERWRITE;
    USART2.cr1 = USART_ENABLE | USART_RECEIVE | USART_SEND | USART_TELLS_RECEIVED;
}

/* At least `looks` times two cycles. */
static void pause(uint8_t looks)
{
    while (looks-- > 0) {
        (void)ADC1.cr;
    }
}

static void set_sequence(volatile uint32_t *part, uint32_t value)
{
    ADC1.isr = ADC_SEQUENCE_SET;
    *part = value;
    look_for(&ADC1.isr, ADC_SEQUENCE_SET, ADC_SEQUENCE_SET);
}

static void init_converter(void)
{
    ADC1.cfgr2 = ADC_HALF_CLOCK;
    ADC1.smpr = ADC_79_CLOCKS;
    ADC1.cr = ADC_REGULATOR;
    pause(200); /* it needs 20 us */
    ADC1.cr = ADC_REGULATOR | ADC_CALIBRATE;
    look_for(&ADC1.cr, ADC_CALIBRATE, 0);
    pause(8); /* four clocks of the converter */
    ADC1.isr = ADC_READY;
    ADC1.cr = ADC_REGULATOR | ADC_ENABLE;
    look_for(&ADC1.isr, ADC_READY, ADC_READY);
    set_sequence(&ADC1.cfgr1,
                 ADC_BY_TIMER_3 | ADC_RISING | ADC_OVERWRITE | ADC_ONE_BY_ONE | ADC_IN_ORDER);
    set_sequence(&ADC1.chselr, SEQUENCE);
    ADC1.cr = ADC_REGULATOR | ADC_START;
}

/* All within a slot, so the order does not matter: timer 2 is read 400 cycles into one. */
static void start_timers(void)
{
    TIM14.arr = CARRIER_CYCLES - 1u;
    TIM14.ccr1 = CARRIER_CYCLES / 2u;
    TIM14.ccmr1 = TIMER_1_HIGH_FIRST;
    TIM14.ccer = TIMER_1_OUT;
    TIM3.arr = SLOT_CYCLES - 1u;
    TIM3.ccr1 = READ_CYCLES;
    TIM3.ccr2 = 0;
    TIM3.ccmr1 = TIMER_2_TOGGLES;
    TIM3.ccer = TIMER_2_OUT;
    TIM3.cr2 = TIMER_TELLS_UPDATE;
    TIM3.cnt = AHEAD_CYCLES;
    TIM3.sr = 0;
    TIM3.dier = TIMER_COMPARE_1;
    TIM2.arr = FRAME_CYCLES - 1u;
    TIM2.cnt = FRAME_CYCLES - SLOT_CYCLES + AHEAD_CYCLES;
    TIM14.cr1 = TIMER_RUN;
    TIM2.cr1 = TIMER_RUN;
    TIM3.cr1 = TIMER_RUN;
}

uint8_t board_init(void)
{
    const uint32_t before = cpu_lock();
    RCC.apbenr1 = RCC_TIMER_2 | RCC_TIMER_3 | RCC_USART_2;
    RCC.apbenr2 = RCC_SPI_1 | RCC_TIMER_14 | RCC_ADC;
    (void)RCC.apbenr2;
    samples.slot = LAST_SLOT;
    init_pins();
    init_link();
    init_converter();
    NVIC.ipr[IRQ_USART_2 / 4u] = 0xc0u << (8u * (IRQ_USART_2 % 4u));
    NVIC.iser = (1u << IRQ_TIMER_3) | (1u << IRQ_USART_2);
    start_timers();
    cpu_unlock(before);
    return fault_of_reset();
}

uint16_t board_supply(void)
{
    return 0;
}

uint16_t board_wait(uint16_t last, app_inputs *in)
{
    uint32_t before;
    uint8_t start;
    for (;;) {
        before = cpu_lock();
        if ((uint8_t)(samples.frames & 0xffu) != (uint8_t)(last & 0xffu)) {
            break;
        }
        cpu_sleep(); /* ends also with interrupts off; they are served by the next line */
        cpu_unlock(before);
    }
    last = samples.frames;
    in->alarms = samples.alarms;
    samples.alarms = 0;
    start = samples.start;
    cpu_unlock(before);
    /* The two frames of the window are not written for another frame's time. */
    sampler_window((const sampler *)&samples, start, in->v, in->i);
    return last;
}

void board_output(uint16_t code, uint8_t enable)
{
    const uint32_t before = cpu_lock();
    if (!enable) {
        GPIOB.odr &= ~ENABLE;
        dropped = 0;
    } else if (!dropped) {
        GPIOB.odr |= ENABLE;
    }
    pending = enable && !dropped ? code : 0;
    cpu_unlock(before);
}

void board_done(uint16_t update)
{
    static uint16_t last;
    if (update != last) {
        IWDG.kr = IWDG_KICK;
        last = update;
    }
    samples.taken = (uint8_t)(update & 0xffu);
}

uint16_t board_cycles(void)
{
    return (uint16_t)TIM2.cnt;
}

uint8_t board_receive(uint8_t *byte)
{
    if (receive_got == (receive_put & (RECEIVE_BYTES - 1u))) {
        return 0;
    }
    *byte = received[receive_got];
    receive_got = (uint8_t)(receive_got + 1u) & (RECEIVE_BYTES - 1u);
    return 1;
}

uint8_t board_send(const uint8_t *bytes, uint8_t n)
{
    const uint8_t put = send_put;
    const uint8_t room = (uint8_t)(send_got - put - 1) & (SEND_BYTES - 1u);
    uint8_t k;
    if (n == 0 || n > room) {
        return 0;
    }
    for (k = 0; k < n; ++k) {
        to_send[(uint8_t)(put + k) & (SEND_BYTES - 1u)] = bytes[k];
    }
    send_put = (uint8_t)(put + n) & (SEND_BYTES - 1u);
    USART2.cr1 |= USART_TELLS_EMPTY;
    return 1;
}
