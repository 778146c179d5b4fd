/* ATmega2560 at 16 MHz, registers only. One frame is 1 ms:
 *
 *   timer 1  every 2,000 cycles: compare B starts a conversion by hardware; compare A, when it
 *            holds its reading, is the sampling interrupt (pin OC1B toggles to trigger a scope)
 *   timer 3  carrier: square wave of 5 kHz on OC3A, filtered to a sine outside
 *   timer 5  16,000 cycles: gives the slot, one of eight in a frame
 *   ADC      125 kHz clock, 8,000 conversions a second at 10 bits (data sheet: 50 to 200 kHz for
 *            full resolution); ADC0 voltage, ADC1 current, each every 1.25 periods of the carrier;
 *            ADC2 level of the high voltage, in the first slot of a frame
 *   PB0-PB2  MCP4921 by SPI: select, clock, data; 12 bits, 2.048 V
 *   PB4      enable of the high-voltage module, active high, pulled down outside
 *   USART0   500,000 baud
 *   watchdog 15 ms
 *
 * Measured in co-simulation: the sampling interrupt takes 165 cycles of the 2,000 from one to the
 * next, 330 if it writes the output; sending a byte takes 50. The budget of each is 500: beyond it,
 * two in a row could delay the sampling interrupt by a whole slot.
 */
#include "board.h"

#include <avr/interrupt.h>
#include <avr/io.h>
#include <avr/sleep.h>
#include <avr/wdt.h>
#include <util/delay_basic.h>

#include "settings.h"

#define SLOT_CYCLES 2000u
#define FRAME_CYCLES 16000u
#define HALF_CARRIER_CYCLES 1600u
#define START_CYCLES 1700u /* of a conversion: two clocks of the converter before compare A */
#define LEVEL 2u           /* channel */
#define HIGHEST_CODE 1023
#define REFERENCE 0x1eu    /* channel: internal 1.1 V reference (data sheet, MUX5:0 = 011110) */
#define SETTLING 4u        /* conversions of it to discard, 104 us each: it starts in 70 us */
#define COUNTING 4u        /* conversions of it to use */

#define CS _BV(PB0)
#define CLOCK _BV(PB1)
#define DATA _BV(PB2)
#define ENABLE _BV(PB4)

/* On, started by timer 1, clock / 128; clears the flag of a finished conversion. */
#define CONVERTER (_BV(ADEN) | _BV(ADATE) | _BV(ADIF) | _BV(ADPS2) | _BV(ADPS1) | _BV(ADPS0))
#define AHEAD_CYCLES 1000u /* of timer 5: the interrupt comes halfway through a slot of it */

#define DAC_ACTIVE 0x3000u /* gain 1, not shut down */

#define RECEIVE_BYTES 64u
#define SEND_BYTES 128u

static volatile sampler samples;
static volatile uint16_t pending; /* output code of the last update */
static volatile uint8_t dropped; /* an interrupt has cleared the enable pin */
static volatile uint8_t received[RECEIVE_BYTES], receive_put;
static volatile uint8_t to_send[SEND_BYTES], send_put, send_got;
static uint8_t receive_got;
static uint16_t supply;
static uint8_t reset_cause __attribute__((section(".noinit")));

/* The converter takes a bit where the clock rises. Pin by pin: no register is needed. */
static inline void dac_bit(uint8_t bit)
{
    PORTB &= (uint8_t)~DATA;
    if (bit) {
        PORTB |= DATA;
    }
    PORTB |= CLOCK;
    PORTB &= (uint8_t)~CLOCK;
}

static inline void dac_byte(uint8_t byte)
{
    dac_bit(byte & 0x80u);
    dac_bit(byte & 0x40u);
    dac_bit(byte & 0x20u);
    dac_bit(byte & 0x10u);
    dac_bit(byte & 0x08u);
    dac_bit(byte & 0x04u);
    dac_bit(byte & 0x02u);
    dac_bit(byte & 0x01u);
}

/* Shifted out bit by bit, 150 cycles: the same on silicon and in the simulator, whose SPI unit
 * takes 1,600 cycles per byte whatever its clock. */
static inline void dac_write(uint16_t code)
{
    const uint16_t word = DAC_ACTIVE | code;
    PORTB &= (uint8_t)~CS;
    dac_byte((uint8_t)(word >> 8));
    dac_byte((uint8_t)(word & 0xffu));
    PORTB |= CS;
}

/* Before main and the initialisation of memory: enable pin inactive, output 0, and the watchdog
 * kept at 15 ms (after a watchdog reset it keeps running). */
void board_early(void) __attribute__((naked, used, section(".init3")));
void board_early(void)
{
    PORTB = CS;
    DDRB = CS | CLOCK | DATA | ENABLE;
    reset_cause = MCUSR;
    MCUSR = 0;
    wdt_enable(WDTO_15MS);
    dac_write(0);
}

/* ---- interrupts ---- */

static inline void drop(void)
{
    PORTB &= (uint8_t)~ENABLE;
    dropped = 1;
    pending = 0;
}

/* Early in a conversion: the result of the one before it, the channel of the one after it, and the
 * trigger's flag. In the last slot of a frame the output of the update changes here, as far
 * as possible from the readings that are used: the first of each channel in a frame is not. */
ISR(TIMER1_COMPA_vect)
{
    sampler *s = (sampler *)&samples; /* nothing else runs meanwhile */
    const uint16_t code = ADC;
    const uint8_t low = TCNT5L, at = TCNT5H; /* in this order */
    /* Timer 5 is 1,060 to 1,400 cycles into the slot; a slot is 256 / 33 of its high byte. */
    const uint8_t slot = (uint8_t)(((uint16_t)(at * 33u) >> 8) & (SAMPLER_SLOTS - 1u));
    (void)low;
    if (!(ADCSRA & _BV(ADIF))) {
        s->alarms |= HP_ALARM_LOST_SAMPLE; /* not finished or not started */
    }
    /* The next one but one. */
    ADMUX = (uint8_t)(_BV(REFS0) | (slot == SAMPLER_SLOTS - 2u ? LEVEL : slot & 1u));
    ADCSRA = CONVERTER;
    TIFR1 = _BV(OCF1B);
    if (sampler_take(s, slot, code, HIGHEST_CODE, SETTINGS_LEVEL_FALL, PORTB & ENABLE)) {
        drop();
    }
    if (slot == SAMPLER_SLOTS - 2u) {
        dac_write(pending > SETTINGS_CODE_HIGH ? SETTINGS_CODE_HIGH : pending);
    }
}

ISR(USART0_RX_vect)
{
    const uint8_t at = receive_put & (RECEIVE_BYTES - 1u);
    received[at] = UDR0;
    receive_put = (uint8_t)(at + 1u);
}

ISR(USART0_UDRE_vect)
{
    const uint8_t at = send_got & (SEND_BYTES - 1u);
    if (at == send_put) {
        UCSR0B &= (uint8_t)~_BV(UDRIE0);
    } else {
        UDR0 = to_send[at];
        send_got = (uint8_t)(at + 1u) & (SEND_BYTES - 1u);
    }
}

/* ---- functions of board.h ---- */

static uint8_t fault_of_reset(void)
{
    if (reset_cause & _BV(WDRF)) {
        return HP_FAULT_WATCHDOG;
    }
    return (reset_cause & _BV(BORF)) && !(reset_cause & _BV(PORF)) ? HP_FAULT_BROWN_OUT
                                                                   : HP_FAULT_NONE;
}

static uint16_t convert(uint8_t channel)
{
    ADMUX = (uint8_t)(_BV(REFS0) | channel);
    ADCSRA = _BV(ADEN) | _BV(ADSC) | _BV(ADPS2) | _BV(ADPS1) | _BV(ADPS0);
    while (ADCSRA & _BV(ADSC)) {
    }
    return ADC;
}

/* The internal reference relative to the supply, which scales all readings: 1 ms, once. The first
 * conversion takes twice as long, and is among those that are discarded. */
static void init_converter(void)
{
    uint8_t k;
    uint16_t sum = 0;
    DIDR0 = _BV(ADC0D) | _BV(ADC1D) | _BV(ADC2D);
    for (k = 0; k < SETTLING + COUNTING; ++k) {
        const uint16_t code = convert(REFERENCE);
        sum = (uint16_t)(sum + (k < SETTLING ? 0u : code));
    }
    supply = (sum + COUNTING / 2u) / COUNTING;
    convert(0);                       /* the input settles on the first channel */
    ADCSRB = _BV(ADTS2) | _BV(ADTS0); /* timer 1 compare B */
    ADCSRA = CONVERTER;
}

static void start_timers(void)
{
    OCR1A = SLOT_CYCLES - 1u;
    OCR1B = START_CYCLES;
    OCR3A = HALF_CARRIER_CYCLES - 1u;
    OCR5A = FRAME_CYCLES - 1u;
    DDRE |= _BV(PE3); /* OC3A */
    DDRB |= _BV(PB6); /* OC1B */
    TCCR1A = _BV(COM1B0);
    TCCR3A = _BV(COM3A0);
    TIMSK1 = _BV(OCIE1A);
    TCCR3B = _BV(WGM32) | _BV(CS30);
    TCCR5B = _BV(WGM52) | _BV(CS50);
    _delay_loop_2(AHEAD_CYCLES / 4u);
    TCCR1B = _BV(WGM12) | _BV(CS10);
}

uint8_t board_init(void)
{
    UCSR0A = _BV(U2X0); /* before the divider, because the simulator reads it then */
    UBRR0 = 3;
    UCSR0C = _BV(UCSZ01) | _BV(UCSZ00);
    UCSR0B = _BV(RXCIE0) | _BV(RXEN0) | _BV(TXEN0);
    samples.slot = SAMPLER_SLOTS - 1u;
    init_converter();
    start_timers();
    SMCR = _BV(SE); /* idle: all clocks except the CPU's continue */
    sei();
    return fault_of_reset();
}

uint16_t board_supply(void)
{
    return supply;
}

uint16_t board_wait(uint16_t last, app_inputs *in)
{
    uint8_t start;
    for (;;) {
        cli();
        if ((uint8_t)(samples.frames & 0xffu) != (uint8_t)(last & 0xffu)) {
            break;
        }
        sei(); /* takes effect after the next instruction: no interrupt slips between */
        sleep_cpu();
        __asm__ volatile("nop"); /* the simulator serves the interrupt after this one */
    }
    last = samples.frames;
    in->alarms = samples.alarms;
    samples.alarms = 0;
    start = samples.start;
    sei();
    /* The two frames of the window are not written for another frame's time. */
    sampler_window((const sampler *)&samples, start, in->v, in->i);
    return last;
}

void board_output(uint16_t code, uint8_t enable)
{
    const uint8_t sreg = SREG;
    cli();
    if (!enable) {
        PORTB &= (uint8_t)~ENABLE;
        dropped = 0;
    } else if (!dropped) {
        PORTB |= ENABLE;
    }
    pending = enable && !dropped ? code : 0;
    SREG = sreg;
}

void board_done(uint16_t update)
{
    static uint16_t last;
    if (update != last) {
        wdt_reset();
        last = update;
    }
    samples.taken = (uint8_t)(update & 0xffu);
}

uint16_t board_cycles(void)
{
    const uint8_t sreg = SREG;
    uint16_t now;
    cli(); /* both halves go through one register that the interrupt uses too */
    now = TCNT5;
    SREG = sreg;
    return now;
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
    UCSR0B |= _BV(UDRIE0);
    return 1;
}
