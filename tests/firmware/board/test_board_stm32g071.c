/* The STM32G071's board: what stands before main, in a frame, behind a rail, on the wire. */
#include <stddef.h>

#include "stm32g071.h"

/* Up to the end of a frame. */
static void end_frame(void)
{
    do {
        play(1);
    } while (hw.slot != 0);
}

/* Switched on and initialised, the first frame over; no update has been completed. */
static uint8_t start(uint32_t cause)
{
    uint8_t fault;
    app_inputs in;
    power_up(cause);
    board_early();
    IWDG.kr = 0;
    fault = board_init();
    board_output(0, 0);
    end_frame();
    board_wait(0, &in);
    return fault;
}

/* ---- registers ---- */

/* Offsets of the reference manual's register maps. */
static void registers_lie_where_the_manual_puts_them(void)
{
    CHECK(offsetof(rcc_unit, iopenr) == 0x34 && offsetof(rcc_unit, apbenr1) == 0x3c &&
              offsetof(rcc_unit, apbenr2) == 0x40 && offsetof(rcc_unit, csr) == 0x60, "RCC");
    CHECK(offsetof(gpio_unit, ospeedr) == 0x08 && offsetof(gpio_unit, pupdr) == 0x0c &&
              offsetof(gpio_unit, odr) == 0x14 && offsetof(gpio_unit, afrl) == 0x20, "GPIO");
    CHECK(offsetof(adc_unit, cr) == 0x08 && offsetof(adc_unit, cfgr1) == 0x0c &&
              offsetof(adc_unit, cfgr2) == 0x10 && offsetof(adc_unit, smpr) == 0x14 &&
              offsetof(adc_unit, chselr) == 0x28 && offsetof(adc_unit, dr) == 0x40, "ADC");
    CHECK(offsetof(timer_unit, cr2) == 0x04 && offsetof(timer_unit, dier) == 0x0c &&
              offsetof(timer_unit, sr) == 0x10 && offsetof(timer_unit, ccmr1) == 0x18 &&
              offsetof(timer_unit, ccer) == 0x20 && offsetof(timer_unit, cnt) == 0x24 &&
              offsetof(timer_unit, arr) == 0x2c && offsetof(timer_unit, ccr1) == 0x34 &&
              offsetof(timer_unit, ccr2) == 0x38, "timers");
    CHECK(offsetof(spi_unit, cr2) == 0x04 && offsetof(spi_unit, sr) == 0x08 &&
              offsetof(spi_unit, dr) == 0x0c && sizeof SPI1.dr == 2, "SPI");
    CHECK(offsetof(usart_unit, cr3) == 0x08 && offsetof(usart_unit, brr) == 0x0c &&
              offsetof(usart_unit, isr) == 0x1c && offsetof(usart_unit, rdr) == 0x24 &&
              offsetof(usart_unit, tdr) == 0x28, "USART");
    CHECK(offsetof(iwdg_unit, pr) == 0x04 && offsetof(iwdg_unit, rlr) == 0x08 &&
              offsetof(iwdg_unit, sr) == 0x0c, "IWDG");
    CHECK(offsetof(nvic_unit, ipr) == 0xe000e400u - 0xe000e100u, "NVIC");
}

/* ---- reset ---- */

static void before_main_the_output_is_0_and_the_enable_pin_low(void)
{
    power_up(RCC_BY_POWER);
    board_early();
    CHECK((GPIOB.odr & PIN_ENABLE) == 0, "%x", GPIOB.odr);
    CHECK((GPIOB.moder >> 8 & 3u) == GPIO_OUTPUT, "%x", GPIOB.moder);
    CHECK((GPIOB.moder & 3u) == GPIO_OUTPUT && (GPIOB.odr & PIN_SELECT), "%x", GPIOB.moder);
    CHECK((GPIOB.moder >> 6 & 3u) == GPIO_ALTERNATE, "%x", GPIOB.moder);
    CHECK((GPIOB.moder >> 10 & 3u) == GPIO_ALTERNATE, "%x", GPIOB.moder);
    CHECK((GPIOB.moder >> 12) == 0xfffffu, "%x", GPIOB.moder); /* the rest as after reset */
    CHECK(SPI1.dr == 0x3000u, "%x", SPI1.dr);
    CHECK((SPI1.cr1 & (SPI_ENABLE | SPI_MASTER)) == (SPI_ENABLE | SPI_MASTER), "%x", SPI1.cr1);
    CHECK(IWDG.rlr == 119u && IWDG.pr == 0 && IWDG.kr == IWDG_KICK, "%u", IWDG.rlr);
    CHECK((RCC.iopenr & 3u) == 3u && (RCC.apbenr2 & RCC_SPI_1), "%x", RCC.iopenr);
    CHECK(RCC.csr == RCC_FORGET, "%x", RCC.csr);
}

static void the_cause_of_the_reset_is_told(void)
{
    CHECK(start(RCC_BY_POWER) == HP_FAULT_NONE, "power-up");
    CHECK(start(RCC_BY_POWER) == HP_FAULT_BROWN_OUT, "memory outlived it");
    CHECK(start(RCC_BY_WATCHDOG) == HP_FAULT_WATCHDOG, "watchdog");
    CHECK(start(0x4000000u) == HP_FAULT_NONE, "the pin");
}

static void a_unit_that_hangs_is_left(void)
{
    power_up(0);
    SPI1.sr = 0;
    IWDG.sr = 0xffu;
    board_early();
    board_init(); /* no flag of the converter ever comes up */
    CHECK((GPIOB.odr & (PIN_SELECT | PIN_ENABLE)) == PIN_SELECT, "%x", GPIOB.odr);
}

/* ---- sampling ---- */

static void timers_make_a_frame_of_eight_slots_and_a_carrier_of_5_khz(void)
{
    start(0);
    CHECK(TIM3.arr == 1999u && TIM2.arr == 15999u && TIM14.arr == 3199u, "%u", TIM3.arr);
    CHECK(TIM14.ccr1 == 1600u && TIM14.ccer == 1u, "%u", TIM14.ccr1);
    CHECK(TIM3.cr2 == TIMER_TELLS_UPDATE && TIM3.dier == TIMER_COMPARE_1, "%x", TIM3.cr2);
    CHECK((ADC1.cfgr1 & 0xfc0u) == (3u << 6 | 1u << 10), "%x", ADC1.cfgr1); /* trigger 3, rising */
    CHECK(NVIC.iser == (1u << 16 | 1u << 28), "%x", NVIC.iser);
    CHECK(NVIC.ipr[4] == 0 && NVIC.ipr[7] == 0xc0u, "%x", NVIC.ipr[7]);
    CHECK(USART2.brr * 500000u == 16000000u, "%u", USART2.brr);
}

static void the_first_conversion_is_that_of_slot_0(void)
{
    power_up(0);
    board_early();
    board_init();
    /* Timer 3 comes round in its cycles to go: then a frame begins. */
    CHECK((TIM2.cnt + TIM3.arr + 1u - TIM3.cnt) % 16000u == 0, "%u %u", TIM2.cnt, TIM3.cnt);
    CHECK(TIM3.cnt > TIM3.ccr1, "%u: no interrupt ahead of it", TIM3.cnt);
    CHECK(ADC1.cr & ADC_START, "%x", ADC1.cr);
}

static void a_window_is_two_frames_with_each_channel_in_its_place(void)
{
    static const uint8_t channels[8] = {4, 1, 0, 1, 0, 1, 0, 1};
    app_inputs in;
    uint16_t number;
    int k;
    start(0);
    hw.reading[0] = 1000;
    hw.reading[1] = 2000;
    hw.reading[4] = 300;
    board_done(1);
    end_frame();
    hw.reading[0] = 1001;
    hw.reading[1] = 4094;
    hw.reading[4] = 0;
    number = board_wait(1, &in);
    CHECK(number == 2 && in.alarms == 0, "%d %d", number, in.alarms);
    CHECK(memcmp(hw.channel, channels, 8) == 0, "%d %d %d", hw.channel[0], hw.channel[1],
          hw.channel[2]);
    board_done(2);
    number = board_wait(2, &in); /* sleeps for eight slots */
    CHECK(number == 3 && hw.slots == 24, "%d %d", number, hw.slots);
    CHECK(in.v[0] == 300 && in.v[4] == 0, "%d %d", in.v[0], in.v[4]);
    for (k = 0; k < 4; ++k) {
        CHECK(in.i[k] == 2000 && in.i[k + 4] == 4094, "%d %d", in.i[k], in.i[k + 4]);
        CHECK(k == 0 || (in.v[k] == 1000 && in.v[k + 4] == 1001), "%d %d", in.v[k], in.v[k + 4]);
    }
}

static void readings_stand_in_order_however_late_the_interrupt_is(void)
{
    app_inputs in;
    int k;
    start(0);
    board_done(1);
    end_frame();
    board_done(2);
    for (k = 0; k < 8; ++k) {
        play_late(k % 2 ? 1500u : 0u);
    }
    board_wait(2, &in);
    CHECK(in.alarms == 0, "%d", in.alarms);
    for (k = 0; k < 4; ++k) {
        CHECK(in.v[k] == 100 + 2 * k && in.v[k + 4] == in.v[k], "%d", in.v[k]);
        CHECK(in.i[k] == 101 + 2 * k && in.i[k + 4] == in.i[k], "%d", in.i[k]);
    }
}

/* Frames that end with an alarm, from the trouble on, and what the converter does afterwards. */
static int frames_with_slips(int frames)
{
    app_inputs in;
    int slips = 0;
    uint16_t number = board_wait(0, &in);
    for (; frames > 0; --frames) {
        board_done(number);
        number = board_wait(number, &in);
        slips += (in.alarms & HP_ALARM_LOST_SAMPLE) != 0;
    }
    return slips;
}

static void a_lost_trigger_is_told_and_the_sequence_begins_anew_with_a_frame(void)
{
    uint8_t lost;
    for (lost = 0; lost < 8; ++lost) {
        start(0);
        board_done(1);
        while (hw.slot != lost) {
            play(1);
        }
        hw.converts = 0;
        play(1);
        hw.converts = 1;
        CHECK(frames_with_slips(8) >= 1, "slot %d", lost);
        CHECK(frames_with_slips(1) == 0, "slot %d", lost);
        CHECK(hw.channel[0] == 4 && hw.channel[2] == 0 && hw.channel[7] == 1, "slot %d", lost);
    }
}

static void a_sequence_that_has_turned_is_told_within_its_frame(void)
{
    uint8_t turn;
    for (turn = 1; turn < 8; ++turn) {
        start(0);
        hw.sequence = turn;
        CHECK(frames_with_slips(1) == 1, "turned by %d", turn);
        CHECK(frames_with_slips(4) <= 3, "turned by %d", turn);
        CHECK(frames_with_slips(1) == 0, "turned by %d", turn);
        CHECK(hw.channel[0] == 4 && hw.channel[7] == 1, "turned by %d", turn);
    }
}

static void conversions_that_stop_are_told_in_every_frame(void)
{
    start(0);
    hw.converts = 0;
    CHECK(frames_with_slips(5) == 5, "frames without a conversion");
}

/* ---- output ---- */

static void the_output_changes_in_the_last_slot_alone_and_is_clamped_there(void)
{
    static const uint16_t codes[4] = {0, 1234, SETTINGS_CODE_HIGH, 0xffffu};
    int k, slot;
    start(0);
    for (k = 0; k < 4; ++k) {
        board_output(codes[k], 1);
        CHECK(GPIOB.odr & PIN_ENABLE, "%x", GPIOB.odr);
        board_done((uint16_t)(k + 1));
        end_frame();
        for (slot = 0; slot < 7; ++slot) {
            CHECK(hw.word[slot] == 0, "%x in slot %d", hw.word[slot], slot);
        }
        CHECK(hw.word[7] == (0x3000u | (k == 3 ? SETTINGS_CODE_HIGH : codes[k])), "%x",
              hw.word[7]);
    }
    board_output(1000, 0);
    CHECK((GPIOB.odr & PIN_ENABLE) == 0, "%x: at once", GPIOB.odr);
    end_frame();
    CHECK(hw.word[7] == 0x3000u, "%x", hw.word[7]);
}

/* One reading at `code` in a slot, while the output is on. Returns whether the pin fell in that
 * very interrupt. */
static uint8_t falls(uint8_t slot, uint8_t channel, uint16_t code)
{
    start(0);
    hw.reading[4] = 1000;
    end_frame();
    board_done(2);
    board_output(500, 1);
    while (hw.slot != slot) {
        play(1);
    }
    hw.reading[channel] = code;
    CHECK(GPIOB.odr & PIN_ENABLE, "slot %d: %x", slot, GPIOB.odr);
    play(1);
    return (GPIOB.odr & PIN_ENABLE) == 0;
}

static void a_rail_drops_the_enable_pin_in_its_interrupt_until_it_is_asked_for_0(void)
{
    app_inputs in;
    uint8_t slot;
    for (slot = 1; slot < 8; ++slot) {
        const uint8_t channel = slot % 2 ? 1 : 0;
        CHECK(falls(slot, channel, 4095), "slot %d", slot);
        CHECK(falls(slot, channel, 0), "slot %d", slot);
        CHECK(!falls(slot, channel, 4094), "slot %d", slot);
        CHECK(!falls(slot, channel, 1), "slot %d", slot);
    }
    CHECK(falls(3, 1, 4095), "current at its end");
    end_frame();
    CHECK(hw.word[7] == 0x3000u, "%x: without an update", hw.word[7]);
    board_output(700, 1); /* an update that was under way */
    CHECK((GPIOB.odr & PIN_ENABLE) == 0, "%x", GPIOB.odr);
    board_done(3);
    end_frame();
    CHECK(hw.word[7] == 0x3000u, "%x", hw.word[7]);
    board_wait(2, &in);
    CHECK(in.alarms == HP_ALARM_RAIL, "%d", in.alarms);
    hw.reading[1] = 500;
    board_output(0, 0);
    board_output(700, 1);
    CHECK(GPIOB.odr & PIN_ENABLE, "%x", GPIOB.odr);
}

static void a_level_that_collapses_drops_it_too(void)
{
    CHECK(falls(0, 4, (uint16_t)(1000u - SETTINGS_LEVEL_FALL - 1u)), "by more than it may");
    CHECK(!falls(0, 4, (uint16_t)(1000u - SETTINGS_LEVEL_FALL)), "by as much as it may");
    /* Five times 20 mV of 3.3 V in 4,096 codes. */
    CHECK(SETTINGS_LEVEL_FALL == 124u, "%u", SETTINGS_LEVEL_FALL);
}

/* ---- updates and watchdog ---- */

static void the_watchdog_is_kicked_by_completed_updates_alone(void)
{
    app_inputs in;
    uint16_t update;
    uint8_t byte;
    start(0);
    board_output(500, 1);
    for (update = 1; update <= 3; ++update) {
        CHECK(GPIOB.odr & PIN_ENABLE, "%d", update);
        end_frame();
        board_output(500, 1);
        board_receive(&byte);
        board_send(&byte, 1);
        board_link();
        board_cycles();
        see_watchdog();
        CHECK(hw.kicks == 0, "%d", hw.kicks);
    }
    /* Nobody took four frames: the interrupt takes the pin down. */
    CHECK((GPIOB.odr & PIN_ENABLE) == 0, "%x", GPIOB.odr);
    update = board_wait(1, &in);
    CHECK(in.alarms == HP_ALARM_LATE, "%d", in.alarms);
    see_watchdog();
    CHECK(hw.kicks == 0, "%d", hw.kicks);
    board_done(update);
    see_watchdog();
    CHECK(hw.kicks == 1, "%d", hw.kicks);
    board_done(update); /* the same again: the sampling stood still */
    see_watchdog();
    CHECK(hw.kicks == 1, "%d", hw.kicks);
    board_done((uint16_t)(update + 1u));
    see_watchdog();
    CHECK(hw.kicks == 2, "%d", hw.kicks);
}

static void a_fault_of_the_core_takes_the_pin_down(void)
{
    start(0);
    board_output(500, 1);
    board_drop();
    CHECK((GPIOB.odr & PIN_ENABLE) == 0, "%x", GPIOB.odr);
    board_output(500, 1);
    CHECK((GPIOB.odr & PIN_ENABLE) == 0, "%x", GPIOB.odr);
}

static void cycles_are_those_of_the_frame(void)
{
    TIM2.cnt = 15999u;
    CHECK(board_cycles() == 15999u, "%d", board_cycles());
}

/* ---- link ---- */

static void bytes_come_in_and_go_out_in_order_all_or_none(void)
{
    uint8_t bytes[200], byte, k;
    start(0);
    CHECK(board_receive(&byte) == 0, "nothing came");
    for (k = 0; k < 200; ++k) {
        bytes[k] = (uint8_t)(7u * k);
        receive(bytes[k]);
        CHECK(board_receive(&byte) == 1 && byte == bytes[k], "%d: %d", k, byte);
    }
    CHECK(board_receive(&byte) == 0, "no more came");
    CHECK(board_send(bytes, 0) == 0 && board_send(bytes, 128) == 0, "none, or too many");
    CHECK(board_send(bytes, 100) == 1 && board_send(bytes, 28) == 0, "100 and 28");
    CHECK(board_send(bytes + 100, 27) == 1, "and 27");
    for (k = 0; k < 127; ++k) {
        USART2.isr = USART_EMPTY;
        CHECK(USART2.cr1 & USART_TELLS_EMPTY, "%d", k);
        board_link();
        CHECK(USART2.tdr == bytes[k], "%d: %u", k, USART2.tdr);
    }
    board_link();
    CHECK((USART2.cr1 & USART_TELLS_EMPTY) == 0, "%x", USART2.cr1);
    CHECK((USART2.cr3 & USART_OVERWRITE) != 0, "%x", USART2.cr3);
    USART2.isr = 0;
}

int main(void)
{
    registers_lie_where_the_manual_puts_them();
    before_main_the_output_is_0_and_the_enable_pin_low();
    the_cause_of_the_reset_is_told();
    a_unit_that_hangs_is_left();
    timers_make_a_frame_of_eight_slots_and_a_carrier_of_5_khz();
    the_first_conversion_is_that_of_slot_0();
    a_window_is_two_frames_with_each_channel_in_its_place();
    readings_stand_in_order_however_late_the_interrupt_is();
    a_lost_trigger_is_told_and_the_sequence_begins_anew_with_a_frame();
    a_sequence_that_has_turned_is_told_within_its_frame();
    conversions_that_stop_are_told_in_every_frame();
    the_output_changes_in_the_last_slot_alone_and_is_clamped_there();
    a_rail_drops_the_enable_pin_in_its_interrupt_until_it_is_asked_for_0();
    a_level_that_collapses_drops_it_too();
    the_watchdog_is_kicked_by_completed_updates_alone();
    a_fault_of_the_core_takes_the_pin_down();
    cycles_are_those_of_the_frame();
    bytes_come_in_and_go_out_in_order_all_or_none();
    return check_end();
}
