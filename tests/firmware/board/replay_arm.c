/* Kept updates through the board, core and app as the chip's compiler makes them, in an emulator of
 * the processor's instructions. The registers are plain memory; what is read and told goes through
 * the emulator's system calls.
 *
 * In, a record an update: 8 codes (2 bytes each, V I V I ...), event, alarms, the reference's bits.
 * Out: state, code (2 bytes each), the bits of strain and of corrected strain.
 */
#include "board.h"
#include "cpu.h"
#include "link.h"
#include "registers.h"
#include "settings.h"

volatile rcc_unit RCC;
volatile gpio_unit GPIOA, GPIOB;
volatile adc_unit ADC1;
volatile timer_unit TIM2, TIM3, TIM14;
volatile spi_unit SPI1;
volatile usart_unit USART2;
volatile iwdg_unit IWDG;
volatile nvic_unit NVIC;

typedef struct {
    uint16_t codes[8];
    uint8_t event, alarms;
    uint16_t gap;
    float reference;
} latched;

typedef struct {
    uint16_t state, code;
    float strain, corrected;
} told;

void _start(void);

static int32_t call(uint32_t what, uint32_t a, const void *b, uint32_t c)
{
    register uint32_t number __asm__("r7") = what;
    register uint32_t first __asm__("r0") = a;
    register const void *second __asm__("r1") = b;
    register uint32_t third __asm__("r2") = c;
    __asm__ volatile("svc 0" : "+r"(first) : "r"(number), "r"(second), "r"(third) : "memory");
    return (int32_t)first;
}

static uint8_t read_all(uint8_t *to, uint32_t n)
{
    while (n > 0) {
        const int32_t got = call(3, 0, to, n);
        if (got <= 0) {
            return 0;
        }
        to += got;
        n -= (uint32_t)got;
    }
    return 1;
}

uint32_t cpu_lock(void) { return 0; }
void cpu_unlock(uint32_t before) { (void)before; }
void cpu_sleep(void) {}

/* Marks for whoever counts instructions. */
APP_APART void mark_update(void);
APP_APART void mark_end(void);
void mark_update(void) { __asm__ volatile("nop"); }
void mark_end(void) { __asm__ volatile("nop\n\tnop"); }

static void sample(const latched *l, uint8_t slot)
{
    ADC1.cr = ADC_REGULATOR | ADC_START;
    ADC1.isr = ADC_CONVERTED | (slot == SAMPLER_SLOTS - 1u ? ADC_SEQUENCE_END : 0u);
    ADC1.dr = l->codes[slot];
    TIM2.cnt = slot * 2000u + 420u;
    board_sample();
}

void _start(void)
{
    static latched l;
    static told t;
    static app_inputs in;
    static app_outputs out;
    static app_state state;
    static link_state link;
    static uint8_t frame[LINK_FRAME_BYTES];
    uint16_t update = 0;
    SPI1.sr = SPI_RECEIVED;
    board_early();
    app_init(&state, board_init());
    link_init(&link);
    while (read_all((uint8_t *)&l, sizeof l)) {
        uint8_t slot;
        for (slot = 0; slot < SAMPLER_SLOTS; ++slot) {
            sample(&l, slot);
        }
        mark_update();
        update = board_wait(update, &in);
        in.event = l.event;
        in.alarms = l.alarms;
        in.reference = l.reference;
        app_step(&settings, &state, &in, &out);
        board_output(out.code, out.enable);
        board_done(update);
        link_report(&link, &state, &in, &out, update, frame);
        mark_end();
        t.state = state.state;
        t.code = out.code;
        t.strain = out.strain;
        t.corrected = out.corrected;
        call(4, 1, &t, sizeof t);
    }
    call(1, 0, 0, 0);
}
