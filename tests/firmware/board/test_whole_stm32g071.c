/* The whole firmware on the STM32G071, from reset: armed, the loop closed, and how that ends. */
#include <math.h>
#include <setjmp.h>

#include "link.h"
#include "stm32g071.h"

#undef main /* the firmware's has another name here */
int firmware_main(void);

static struct {
    jmp_buf end;
    uint32_t slots;              /* played */
    uint16_t sequence;           /* of the last command */
    uint16_t token;              /* that the chip gave */
    hp_status status;            /* last one that it told */
    uint16_t code, code_highest; /* that went out */
    uint8_t heard[80], heard_bytes;
    uint8_t rails;          /* the current reads its end */
    uint8_t silent;         /* no more signs of life */
    uint16_t slots_to_drop; /* with a rail and the pin still up */
    void (*script)(uint32_t frame);
} world;

static void command(uint8_t code, const void *payload, uint8_t n)
{
    uint8_t bytes[FRAME_LONGEST], frame[FRAME_LONGEST + 3], length, k;
    bytes[0] = code;
    hp_put_u16(bytes + 1, ++world.sequence);
    memcpy(bytes + 3, payload, n);
    length = frame_encode(bytes, (uint8_t)(3 + n), frame);
    for (k = 0; k < length; ++k) {
        receive(frame[k]);
    }
}

static void hear(uint8_t byte)
{
    if (byte != 0) {
        world.heard[world.heard_bytes++ % sizeof world.heard] = byte;
        return;
    }
    if (frame_decode(world.heard, world.heard_bytes) > 0) {
        const uint8_t *m = world.heard + 3;
        if (world.heard[0] == HP_ACK) {
            CHECK(m[3] == HP_RESULT_ACCEPTED, "command %d: result %d", m[0], m[3]);
            world.token = m[0] == HP_REQUEST_ARMING ? hp_get_u16(m + 4) : world.token;
        } else if (world.heard[0] == HP_STATUS) {
            world.status.state = m[2];
            world.status.fault = m[3];
            world.status.reason = m[4];
            world.status.strain = hp_get_f32(m + 5);
            world.status.overruns = m[17];
            world.status.bad_frames = m[18];
        }
    } else {
        CHECK(0, "no frame: %d bytes", world.heard_bytes);
    }
    world.heard_bytes = 0;
}

/* What the monitors show: a capacitor that grows with the output, carriers about the middle. */
static void monitors(void)
{
    const double angle = 1.5707963267948966 * (hw.slot / 2);
    const double v = 1178.0, i = 760.0 + 0.1 * world.code;
    const uint8_t on = (GPIOB.odr & PIN_ENABLE) != 0;
    hw.reading[0] = (uint16_t)lrint(2048.0 + v * cos(angle));
    hw.reading[1] = (uint16_t)lrint(
        2048.0 + i * cos(1.5707963267948966 * (hw.slot / 2) + 1.5707963267948966 +
                         3.9269908169872414));
    hw.reading[4] = on ? (uint16_t)((double)world.code * settings.level_share / 65536.0) : 0;
    if (world.rails) {
        hw.reading[1] = 4095;
    }
}

static void play_all(void)
{
    const uint8_t slot = hw.slot;
    uint8_t k;
    monitors();
    play(1);
    ++world.slots;
    if (world.rails && (GPIOB.odr & PIN_ENABLE)) {
        ++world.slots_to_drop;
    }
    if (slot == LAST) {
        CHECK(hw.word[LAST] >= 0x3000u && hw.word[LAST] <= 0x3000u + SETTINGS_CODE_HIGH, "%x",
              hw.word[LAST]);
        world.code = hw.word[LAST] & 0xfffu;
        if (world.code > world.code_highest) {
            world.code_highest = world.code;
        }
        see_watchdog();
        world.script(world.slots / 8u);
    }
    for (k = 0; k < 6 && (USART2.cr1 & USART_TELLS_EMPTY); ++k) { /* bytes in 125 us */
        USART2.isr = USART_EMPTY;
        USART2.tdr = 0x100;
        board_link();
        USART2.isr = 0;
        if (USART2.tdr != 0x100) {
            hear((uint8_t)USART2.tdr);
        }
    }
}

static uint8_t is_on(void)
{
    return (GPIOB.odr & PIN_ENABLE) != 0;
}

static void closed_loop(uint32_t frame)
{
    uint8_t bytes[4];
    CHECK(world.status.state >= HP_STATE_ARMED || world.code == 0, "frame %u", frame);
    if (frame == 10) {
        hp_put_u16(bytes, HP_VERSION);
        command(HP_HELLO, bytes, 2);
    } else if (frame == 20) {
        CHECK(!is_on(), "armed by nothing");
        command(HP_REQUEST_ARMING, bytes, 0);
    } else if (frame == 30) {
        CHECK(!is_on(), "armed by one frame");
        hp_put_u16(bytes, world.token);
        command(HP_CONFIRM_ARMING, bytes, 2);
    } else if (frame == 100) {
        CHECK(is_on() && world.code == 0, "armed: %d", world.code);
        CHECK(world.status.state == HP_STATE_ARMED && world.status.reason == 0, "%d",
              world.status.reason);
        hp_put_f32(bytes, 0.03f);
        command(HP_RUN, bytes, 4);
    } else if (frame > 100 && frame % 50u == 0 && !world.silent) {
        command(HP_KEEP_ALIVE, bytes, 0);
    }
}

/* The firmware from reset for so many frames. */
static void run_firmware(void (*script)(uint32_t frame))
{
    memset(&world, 0, sizeof world);
    world.script = script;
    power_up(0);
    board_early();
    see_watchdog();
    hw.kicks = 0;
    play_other = play_all;
    if (setjmp(world.end) == 0) {
        firmware_main();
    }
    play_other = 0;
    hw.locked = 0;
    hw.waiting = 0;
}

static void breakdown_at_2000(uint32_t frame)
{
    closed_loop(frame);
    if (frame == 2000) {
        CHECK(is_on() && world.code > 100, "the loop is closed: %d", world.code);
        CHECK(world.status.state == HP_STATE_RUNNING, "%d", world.status.state);
        CHECK(world.status.overruns == 0 && world.status.bad_frames == 0, "%d",
              world.status.bad_frames);
        /* From -0.031 with the output at 0: nine tenths of the way, and no further by more. */
        CHECK(fabs((double)world.status.strain - 0.03) < 0.006, "%g", (double)world.status.strain);
        /* The first frame is for nobody, and the update of the last one is to come. */
        CHECK(hw.kicks == frame - 2u, "%d kicks", hw.kicks);
        world.rails = 1;
    }
    if (frame == 2001) {
        CHECK(world.slots_to_drop == 1, "%d", world.slots_to_drop); /* the level's comes first */
        CHECK(!is_on(), "breakdown");
    }
    if (frame == 2040) {
        CHECK(world.status.state == HP_STATE_TRIPPED, "%d", world.status.state);
        CHECK(world.status.fault == HP_FAULT_BREAKDOWN, "%d", world.status.fault);
        CHECK(world.code == 0 && !is_on(), "%d", world.code);
        longjmp(world.end, 1);
    }
}

static void silence_from_1500(uint32_t frame)
{
    closed_loop(frame);
    world.silent = frame >= 1500;
    if (frame == 1600) {
        CHECK(is_on() && world.code > 100, "%d", world.code);
    }
    if (frame == 2300) {
        CHECK(!is_on() && world.code == 0, "%d", world.code);
        CHECK(world.status.fault == HP_FAULT_LINK, "%d", world.status.fault);
        longjmp(world.end, 1);
    }
}

static void the_whole_firmware_arms_closes_the_loop_and_trips_in_the_interrupt(void)
{
    run_firmware(breakdown_at_2000);
    CHECK(world.code_highest > 100 && world.code_highest <= SETTINGS_CODE_HIGH, "%d",
          world.code_highest);
    CHECK(world.slots == 2040u * 8u, "%u", world.slots);
}

static void the_whole_firmware_ramps_down_in_silence(void)
{
    run_firmware(silence_from_1500);
    CHECK(world.slots == 2300u * 8u, "%u", world.slots);
}

int main(void)
{
    the_whole_firmware_arms_closes_the_loop_and_trips_in_the_interrupt();
    the_whole_firmware_ramps_down_in_silence();
    return check_end();
}
