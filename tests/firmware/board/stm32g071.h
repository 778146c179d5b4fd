/* The STM32G071 played on this machine: its registers are plain memory, and what the hardware does
 * between two interrupts is done here. board.c is taken in as it is, so that its variables can be
 * zeroed, as start.c does. */
#ifndef STM32G071_H
#define STM32G071_H

#include <string.h>

#include "../../core/check.h"
#include "board.c"

#define PIN_ENABLE 0x10u /* of port B */
#define PIN_SELECT 0x1u
#define LAST 7u

volatile rcc_unit RCC;
volatile gpio_unit GPIOA, GPIOB;
volatile adc_unit ADC1;
volatile timer_unit TIM2, TIM3, TIM14;
volatile spi_unit SPI1;
volatile usart_unit USART2;
volatile iwdg_unit IWDG;
volatile nvic_unit NVIC;

/* ---- what the hardware does ---- */

static struct {
    uint8_t slot;         /* of timer 2 */
    uint8_t sequence;     /* the converter's place in its own */
    uint8_t converts;     /* 0: its trigger is gone */
    uint8_t locked;       /* interrupts are off */
    uint8_t waiting;      /* an interrupt came while they were */
    uint8_t channel[8];   /* converted in each slot */
    uint16_t reading[16]; /* of each channel; 65535: of the slot, 100 + slot */
    uint16_t word[8];     /* sent to the output in each slot, 0: none */
    uint16_t slots;       /* played */
    uint16_t kicks;       /* of the watchdog */
} hw;

static void see_watchdog(void)
{
    if (IWDG.kr == IWDG_KICK) {
        ++hw.kicks;
    }
    IWDG.kr = 0;
}

static void convert(void)
{
    ADC1.isr = 0;
    hw.channel[hw.slot] = 255;
    if (ADC1.cr & ADC_STOP) {
        ADC1.cr = ADC_REGULATOR | ADC_ENABLE;
        hw.sequence = 0;
    }
    if ((ADC1.cr & ADC_START) && hw.converts) {
        const uint8_t channel = (uint8_t)(ADC1.chselr >> (4u * hw.sequence)) & 15u;
        hw.channel[hw.slot] = channel;
        ADC1.dr = hw.reading[channel] == 65535u ? 100u + hw.slot : hw.reading[channel];
        ADC1.isr = ADC_CONVERTED | (hw.sequence == LAST ? ADC_SEQUENCE_END : 0u);
        hw.sequence = (hw.sequence + 1u) & LAST;
    }
}

/* A conversion and the sampling interrupt behind it, `late` cycles after its compare. */
static void play_late(uint32_t late)
{
    CHECK(!hw.locked, "slot %d", hw.slot);
    convert();
    TIM2.cnt = hw.slot * 2000u + TIM3.ccr1 + late;
    TIM3.sr = TIMER_COMPARE_1;
    SPI1.dr = 0;
    board_sample();
    hw.word[hw.slot] = SPI1.dr;
    CHECK(SPI1.dr == 0 || (GPIOB.odr & PIN_SELECT), "the converter stays selected in %d", hw.slot);
    CHECK((TIM3.sr & TIMER_COMPARE_1) == 0, "%x", TIM3.sr);
    hw.slot = (hw.slot + 1u) & LAST;
    ++hw.slots;
}

static void play(uint16_t slots)
{
    for (; slots > 0; --slots) {
        play_late(20);
    }
}

uint32_t cpu_lock(void)
{
    const uint32_t before = hw.locked;
    hw.locked = 1;
    return before;
}

static void (*play_other)(void); /* instead of one slot */

void cpu_unlock(uint32_t before)
{
    hw.locked = before != 0;
    if (!hw.locked && hw.waiting) {
        hw.waiting = 0;
        if (play_other) {
            play_other();
        } else {
            play(1);
        }
    }
}

void cpu_sleep(void)
{
    hw.waiting = 1;
}

/* As after reset; what memory holds by chance is all ones. */
static void power_up(uint32_t cause)
{
    memset((void *)&RCC, 0, sizeof RCC);
    memset((void *)&ADC1, 0, sizeof ADC1);
    memset((void *)&USART2, 0, sizeof USART2);
    memset((void *)&SPI1, 0, sizeof SPI1);
    memset((void *)&GPIOB, 0xff, sizeof GPIOB);
    memset((void *)&IWDG, 0, sizeof IWDG);
    memset(&hw, 0, sizeof hw);
    memset(hw.reading, 0xff, sizeof hw.reading);
    memset((void *)&samples, 0, sizeof samples);
    pending = 0;
    dropped = 0;
    receive_put = receive_got = send_put = send_got = 0;
    RCC.csr = cause;
    GPIOA.moder = 0xebffffffu;
    SPI1.sr = SPI_RECEIVED;
    hw.converts = 1;
}

/* A byte of the link comes in. */
static void receive(uint8_t byte)
{
    USART2.isr = USART_RECEIVED;
    USART2.rdr = byte;
    board_link();
    USART2.isr = 0;
}

#endif
