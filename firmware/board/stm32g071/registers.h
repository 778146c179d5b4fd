/* The registers of an STM32G071 that this board uses, by the reference manual RM0444; the rest of
 * each unit is left out or named `gap`. Units are objects at addresses that chip.ld gives: a test
 * on another machine defines them as plain memory. */
#ifndef REGISTERS_H
#define REGISTERS_H

#include <stdint.h>

typedef struct {
    uint32_t gap0[13];
    uint32_t iopenr; /* 0x34 */
    uint32_t gap1;
    uint32_t apbenr1; /* 0x3c */
    uint32_t apbenr2;
    uint32_t gap2[7];
    uint32_t csr; /* 0x60 */
} rcc_unit;

#define RCC_PORT_A 0x1u
#define RCC_PORT_B 0x2u
#define RCC_TIMER_2 0x1u /* apbenr1 */
#define RCC_TIMER_3 0x2u
#define RCC_USART_2 0x20000u
#define RCC_SPI_1 0x1000u /* apbenr2 */
#define RCC_TIMER_14 0x8000u
#define RCC_ADC 0x100000u
#define RCC_FORGET 0x800000u /* csr: clear the causes of a reset */
#define RCC_BY_POWER 0x8000000u
#define RCC_BY_WATCHDOG 0x20000000u

typedef struct {
    uint32_t moder; /* 2 bits a pin */
    uint32_t gap0;
    uint32_t ospeedr;
    uint32_t pupdr;
    uint32_t idr;
    uint32_t odr;
    uint32_t gap1[2];
    uint32_t afrl; /* 4 bits a pin */
} gpio_unit;

#define GPIO_INPUT 0u
#define GPIO_OUTPUT 1u
#define GPIO_ALTERNATE 2u
#define GPIO_ANALOG 3u
#define GPIO_FAST 2u /* ospeedr */
#define GPIO_UP 1u   /* pupdr */
#define GPIO_TWO(pin, value) ((value) << (2u * (pin)))
#define GPIO_FOUR(pin, value) ((value) << (4u * (pin)))
#define GPIO_PIN(pin) (1u << (pin))

typedef struct {
    uint32_t isr; /* write 1 to clear a bit */
    uint32_t ier;
    uint32_t cr;
    uint32_t cfgr1;
    uint32_t cfgr2; /* 0x10 */
    uint32_t smpr;
    uint32_t gap0[4];
    uint32_t chselr; /* 0x28 */
    uint32_t gap1[5];
    uint32_t dr; /* 0x40 */
} adc_unit;

#define ADC_READY 0x1u /* isr */
#define ADC_CONVERTED 0x4u
#define ADC_SEQUENCE_END 0x8u
#define ADC_OVERRUN 0x10u
#define ADC_SEQUENCE_SET 0x2000u
#define ADC_ENABLE 0x1u /* cr: these bits are set by software, cleared by hardware */
#define ADC_START 0x4u
#define ADC_STOP 0x10u
#define ADC_REGULATOR 0x10000000u
#define ADC_CALIBRATE 0x80000000u
#define ADC_BY_TIMER_3 0xc0u /* cfgr1 */
#define ADC_RISING 0x400u
#define ADC_OVERWRITE 0x1000u
#define ADC_ONE_BY_ONE 0x10000u /* each trigger converts one of the sequence */
#define ADC_IN_ORDER 0x200000u  /* chselr holds a sequence of eight, 4 bits each */
#define ADC_HALF_CLOCK 0x40000000u /* cfgr2 */
#define ADC_79_CLOCKS 0x6u         /* smpr: sampling takes 79.5 of them */

typedef struct {
    uint32_t cr1;
    uint32_t cr2;
    uint32_t gap0;
    uint32_t dier;
    uint32_t sr; /* 0x10; write 0 to clear a bit */
    uint32_t gap1;
    uint32_t ccmr1;
    uint32_t gap2;
    uint32_t ccer; /* 0x20 */
    uint32_t cnt;
    uint32_t psc;
    uint32_t arr;
    uint32_t gap3;
    uint32_t ccr1; /* 0x34 */
    uint32_t ccr2;
} timer_unit;

#define TIMER_RUN 0x1u            /* cr1 */
#define TIMER_TELLS_UPDATE 0x20u  /* cr2: to the converter */
#define TIMER_COMPARE_1 0x2u      /* dier, sr */
#define TIMER_1_HIGH_FIRST 0x60u  /* ccmr1: high up to ccr1 */
#define TIMER_2_TOGGLES 0x3000u   /* at ccr2 */
#define TIMER_1_OUT 0x1u          /* ccer */
#define TIMER_2_OUT 0x10u

typedef struct {
    uint32_t cr1;
    uint32_t cr2;
    uint32_t sr;
    uint16_t dr; /* 16 bits at once: one word of the converter */
    uint16_t gap0;
} spi_unit;

#define SPI_MASTER 0x4u /* cr1; half the clock, 8 MHz */
#define SPI_ENABLE 0x40u
#define SPI_OWN_SELECT 0x300u
#define SPI_16_BITS 0xf00u /* cr2 */
#define SPI_RECEIVED 0x1u  /* sr: as many bits came in as went out */

typedef struct {
    uint32_t cr1;
    uint32_t cr2;
    uint32_t cr3;
    uint32_t brr;
    uint32_t gap0[3];
    uint32_t isr; /* 0x1c */
    uint32_t icr;
    uint32_t rdr;
    uint32_t tdr;
} usart_unit;

#define USART_ENABLE 0x1u /* cr1 */
#define USART_RECEIVE 0x4u
#define USART_SEND 0x8u
#define USART_TELLS_RECEIVED 0x20u
#define USART_TELLS_EMPTY 0x80u
#define USART_OVERWRITE 0x1000u /* cr3: an unread byte does not block the interrupt */
#define USART_RECEIVED 0x20u    /* isr */
#define USART_EMPTY 0x80u

typedef struct {
    uint32_t kr;
    uint32_t pr;
    uint32_t rlr;
    uint32_t sr;
} iwdg_unit;

#define IWDG_BEGIN 0xccccu /* kr */
#define IWDG_OPEN 0x5555u
#define IWDG_KICK 0xaaaau

/* Of the core, ARMv6-M: from 0xe000e100. */
typedef struct {
    uint32_t iser;
    uint32_t gap0[191];
    uint32_t ipr[8]; /* 0x300; 8 bits an interrupt, the upper 2 count: 0 is the most urgent */
} nvic_unit;

#define IRQ_TIMER_3 16u
#define IRQ_USART_2 28u

extern volatile rcc_unit RCC;
extern volatile gpio_unit GPIOA, GPIOB;
extern volatile adc_unit ADC1;
extern volatile timer_unit TIM2, TIM3, TIM14;
extern volatile spi_unit SPI1;
extern volatile usart_unit USART2;
extern volatile iwdg_unit IWDG;
extern volatile nvic_unit NVIC;

#endif
