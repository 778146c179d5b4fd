/* Controller: closed forms, saturation, wind-up, start. */
#include <math.h>
#include <string.h>

#include "check.h"
#include "hs.h"

/* Powers of two: every sum below is exact in float. */
static hs_pid_config exact_config(void)
{
    hs_pid_config c;
    c.kp = 0.5f;
    c.ki = 2.0f;
    c.kd = 0.0f;
    c.period_s = 0.0078125f;
    c.filter_constant = 1.0f;
    c.u_low = -0.0625f;
    c.u_high = 0.125f;
    return c;
}

static void pi_follows_its_closed_form(void)
{
    const hs_pid_config c = exact_config();
    hs_pid_state s;
    int k;
    hs_pid_init(&s, 0.0f);
    for (k = 1; k <= 100; ++k) { /* u = kp e + k ki e T, inside the limits */
        const float error = 0.0625f;
        const float expected = 0.5f * error + (float)k * 2.0f * error * 0.0078125f;
        const float u = hs_pid_step(&c, &s, error, 0.0f);
        if (expected <= c.u_high) {
            CHECK(u == expected, "step %d: %.9g of %.9g", k, (double)u, (double)expected);
        } else {
            CHECK(u == c.u_high, "step %d: %.9g", k, (double)u);
        }
    }
}

static void output_never_leaves_its_limits(void)
{
    hs_pid_config c = exact_config();
    hs_pid_state s;
    uint32_t seed = 11;
    int k;
    c.kd = 0.25f;
    c.filter_constant = 0.25f;
    hs_pid_init(&s, 0.0f);
    for (k = 0; k < 100000; ++k) {
        const float r = check_uniform(&seed, -10.0f, 10.0f);
        const float y = check_uniform(&seed, -10.0f, 10.0f);
        const float u = hs_pid_step(&c, &s, r, y);
        CHECK(u >= c.u_low && u <= c.u_high, "step %d: %.9g", k, (double)u);
    }
}

/* Held at a limit for long, the integral stands still, and the first error of the other sign takes
 * the output off the limit in that very step. */
static void integral_is_frozen_at_a_limit_and_released_at_once(float sign)
{
    const hs_pid_config c = exact_config();
    const float limit = sign > 0.0f ? c.u_high : c.u_low;
    hs_pid_state s;
    float frozen, u;
    int k;
    hs_pid_init(&s, 0.0f);
    for (k = 0; k < 40; ++k) {
        hs_pid_step(&c, &s, sign * 0.1875f, 0.0f);
    }
    frozen = s.integral;
    for (k = 0; k < 100000; ++k) {
        u = hs_pid_step(&c, &s, sign * 0.1875f, 0.0f);
        CHECK(u == limit, "%.9g", (double)u);
    }
    CHECK(s.integral == frozen, "%.9g, was %.9g", (double)s.integral, (double)frozen);
    CHECK(fabsf(frozen) <= fabsf(limit) + 2.0f * 0.1875f * c.period_s, "%.9g", (double)frozen);
    u = hs_pid_step(&c, &s, -sign * 0.03125f, 0.0f);
    CHECK(sign * u < sign * limit, "%.9g still at the limit", (double)u);
    CHECK(sign * s.integral < sign * frozen, "%.9g did not move back", (double)s.integral);
}

static void the_first_output_without_error_is_where_it_was_started(void)
{
    hs_pid_config c = exact_config();
    hs_pid_state s;
    float u;
    c.kd = 0.25f;
    c.filter_constant = 0.125f;
    hs_pid_init(&s, 0.0546875f);
    u = hs_pid_step(&c, &s, 0.7f, 0.7f); /* far from 0: no kick from the derivative */
    CHECK(u == 0.0546875f, "%.9g", (double)u);
    CHECK(s.filtered == 0.7f, "%.9g", (double)s.filtered);
}

static void derivative_of_a_step_decays_as_its_filter(void)
{
    hs_pid_config c = exact_config();
    hs_pid_state s;
    int k;
    c.kp = c.ki = 0.0f;
    c.kd = 0.001f;
    c.filter_constant = 0.25f; /* a = T / (T + Tf) */
    c.u_low = -1.0f;
    c.u_high = 1.0f;
    hs_pid_init(&s, 0.0f);
    CHECK(hs_pid_step(&c, &s, 0.0f, 0.0f) == 0.0f, "%.9g", (double)s.filtered);
    for (k = 1; k <= 30; ++k) { /* y 0 -> 1: u = -kd a (1 - a)^(k - 1) / T */
        const double scale = 0.001 / 0.0078125;
        const double expected = -scale * 0.25 * pow(0.75, k - 1);
        const double u = (double)hs_pid_step(&c, &s, 0.0f, 1.0f);
        /* Each filtered value, below 1, has two roundings a step; their difference is scaled. */
        const double bound = scale * 4.0 * k * ROUNDOFF;
        CHECK(fabs(u - expected) <= bound, "step %d: %.9g of %.9g", k, u, expected);
    }
}

static void reference_steps_do_not_pass_through_the_derivative(void)
{
    hs_pid_config c = exact_config();
    hs_pid_state s;
    float u;
    c.ki = 0.0f;
    c.kd = 8.0f;
    hs_pid_init(&s, 0.0f);
    hs_pid_step(&c, &s, 0.0f, 0.0f);
    u = hs_pid_step(&c, &s, 0.125f, 0.0f);
    CHECK(u == 0.0625f, "%.9g", (double)u);
}

static void a_measurement_that_is_no_number_leaves_the_state(void)
{
    const hs_pid_config c = exact_config();
    hs_pid_state s, before;
    uint8_t limited;
    float u;
    memset(&s, 0, sizeof s);
    hs_pid_init(&s, 0.01f);
    hs_pid_step(&c, &s, 0.05f, 0.02f);
    memcpy(&before, &s, sizeof s);
    u = hs_pid_step(&c, &s, 0.05f, NAN);
    CHECK(u != u, "%.9g", (double)u);
    CHECK(memcmp(&before, &s, sizeof s) == 0, "state changed: %.9g", (double)s.integral);
    CHECK(hs_limit(u, c.u_low, c.u_high, &limited) == 0.0f && limited == 1, "%d", limited);
    u = hs_pid_step(&c, &s, NAN, 0.02f);
    CHECK(u != u && memcmp(&before, &s, sizeof s) == 0, "%.9g", (double)u);
}

int main(void)
{
    pi_follows_its_closed_form();
    output_never_leaves_its_limits();
    integral_is_frozen_at_a_limit_and_released_at_once(1.0f);
    integral_is_frozen_at_a_limit_and_released_at_once(-1.0f);
    the_first_output_without_error_is_where_it_was_started();
    derivative_of_a_step_decays_as_its_filter();
    reference_steps_do_not_pass_through_the_derivative();
    a_measurement_that_is_no_number_leaves_the_state();
    return check_end();
}
