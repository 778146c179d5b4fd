/* A controller of your own on the microcontroller: one C file with the two functions below.
 *
 *     haselab firmware build RUN --controller-source my_controller.c
 *
 * It is compiled in place of the PID (firmware/app/controller_pid.c). The firmware calls it once
 * per update and applies its own limits: the drive stays within [u_low, u_high] and changes at most
 * at the rate of the settings; a late update, a lost sensor, a lost link or a drive that is not a
 * number takes the output to 0 V.
 *
 * Rules: C99, float only, no heap, no globals, no libm. An update has 16,000 cycles on the ATmega2560,
 * of which sensing and limits take about 6,000; a multiplication takes 150, a division 500.
 */
#ifndef HS_CONTROLLER_H
#define HS_CONTROLLER_H

#include "hs.h"
#include "hs_motion.h"

#define HS_CONTROLLER_STATES 16
#define HS_CONTROLLER_PARAMETERS 8

/* Constant while it runs. */
typedef struct {
    float period_s;      /* time between two steps */
    float u_low, u_high; /* strain; the drive is limited to this range after the step */
    float u_start;       /* drive before the first step, strain */
    union {
        float parameter[HS_CONTROLLER_PARAMETERS]; /* in the order in which the kind declares them */
        hs_pid_config pid;                         /* of the built-in PID */
    } own;
} hs_controller_setting;

/* State that the firmware keeps between the steps. */
typedef union {
    float x[HS_CONTROLLER_STATES];
    hs_pid_state pid;
    hs_force_state force; /* of the built-in controllers of the identified motion */
    hs_observer_state observer;
} hs_controller_state;

typedef struct {
    float strain;
    float capacitance_f;
    float voltage_v; /* present drive, at the amplifier's input */
    uint32_t update; /* number of the step since the start */
    uint8_t valid;   /* 0: strain and capacitance are not valid, and the output is kept */
} hs_measurement;

/* Start a new run. */
void hs_controller_init(const hs_controller_setting *setting, hs_controller_state *state);

/* One update: the new drive, in strain, which the voltage table turns into a voltage; in V if the
 * kind of the controller has the output "voltage". */
float hs_controller_step(const hs_controller_setting *setting, hs_controller_state *state,
                         float reference, const hs_measurement *measurement);

#endif
