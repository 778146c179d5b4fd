/* Takes: drive voltage and load. Gives: ADC codes of both monitors and the true lengths. */
#include "twin/twin.h"

#include "twin/noise.h"

#include <math.h>
#include <stddef.h>
#include <string.h>

void twin_seed(twin_state *s, uint64_t seed)
{
    int k;
    for (k = 0; k < 4; ++k) { /* splitmix64 */
        uint64_t z = (seed += 0x9E3779B97F4A7C15u);
        z = (z ^ (z >> 30)) * 0xBF58476D1CE4E5B9u;
        z = (z ^ (z >> 27)) * 0x94D049BB133111EBu;
        s->random[k] = z ^ (z >> 31);
    }
}

/* ---- motion ---- */

/* 1 + share of a change that approaches its end within a time constant. */
static double changed(double share, double time_s, double constant_s)
{
    return share != 0.0 ? 1.0 - share * expm1(-time_s / constant_s) : 1.0;
}

double twin_permittivity(const twin_parameters *p, double time_s)
{
    return changed(p->capacitance_rise, fmax(time_s - p->begins_s, 0.0), p->warming_s);
}

/* Motion of the actuator with ageing, warming and the second mass, of which the force on the moving
 * end is that at the beginning: dt must be short against its period. */
static void move_further(const twin_parameters *p, twin_state *s, const motion_input *in,
                         double time_s, double dt)
{
    const double share = twin_permittivity(p, time_s), before_m_s = s->motion.speed_m_s;
    const double spring = p->second_kg * p->second_rad_s * p->second_rad_s;
    const double damper = 2.0 * p->second_damping * p->second_kg * p->second_rad_s;
    const double force = spring * s->second_m + damper * s->second_m_s;
    motion_parameters moving = p->motion;
    motion_input pull = *in;
    moving.elastic_scale =
        changed(-p->stiffness_loss, fmax(time_s - p->begins_s, 0.0), p->ageing_s);
    pull.volt *= sqrt(share);
    pull.ripple_v2 *= share;
    pull.load_n += force;
    motion_advance(&p->law, &moving, &s->motion, NULL, &pull, dt);
    if (p->second_kg > 0.0) {
        s->second_m_s -= s->motion.speed_m_s - before_m_s + dt * force / p->second_kg;
        s->second_m += dt * s->second_m_s;
    }
}

/* Moves on from a time under a voltage and its ripple; the law is valid inside its table only.
 * `fits`: one step is enough. */
static void move_on(const twin_parameters *p, twin_state *s, const motion_input *in, double time_s,
                    double dt, int fits)
{
    const motion_law *law = &p->law;
    if (p->capacitance_rise != 0.0 || p->stiffness_loss != 0.0 || p->second_kg > 0.0) {
        move_further(p, s, in, time_s, dt);
    } else if (fits) {
        motion_step(law, &p->motion, &s->motion, NULL, in, dt);
    } else {
        motion_advance(law, &p->motion, &s->motion, NULL, in, dt);
    }
    if (!(s->motion.length_m >= law->low_m &&
          s->motion.length_m <= law->low_m + law->step_m * (double)(law->lengths - 1))) {
        s->outside = s->broken = 1;
    }
}

static void watch_field(const twin_parameters *p, twin_state *s, double voltage)
{
    const double field = fabs(voltage) / motion_gap(&p->law, s->motion.length_m);
    if (field > s->field_v_m) {
        s->field_v_m = field;
    }
    if (field > p->breakdown_v_m) {
        s->broken = 1;
    }
}

/* Peak of the carrier at the output: the amplifier is of second order. */
static double carrier_at_output(const twin_parameters *p)
{
    const double ratio = p->carrier_rad_s / p->amplifier_rad_s;
    const double real = 1.0 - ratio * ratio, imaginary = 2.0 * p->amplifier_damping * ratio;
    return p->gain * p->carrier_v / sqrt(real * real + imaginary * imaginary);
}

/* Lengths at `steps` equal parts of the time from a length and speed to a state: Hermite's cubic, by
 * its powers. */
HS_CLONES static void lengths_between(double start, double start_m_s, const motion_state *after,
                                      double whole_s, int32_t steps, double *lengths)
{
    const double per = 1.0 / (double)steps;
    const double from = whole_s * start_m_s, to = whole_s * after->speed_m_s;
    const double rise = after->length_m - start;
    const double second = 3.0 * rise - 2.0 * from - to, third = from + to - 2.0 * rise;
    int32_t i;
    for (i = 0; i < steps; ++i) {
        const double t = (double)(i + 1) * per;
        lengths[i] = start + t * (from + t * (second + t * third));
    }
}

#define SAME_STEPS 64 /* that long at most, before longer ones are tried */

/* Moves on by `steps` under a voltage in steps that are as equal as possible; lengths may be NULL. */
static void move_value(const twin_parameters *p, twin_state *s, double volt, double ripple_v2,
                       double load_n, double time_s, int32_t steps, double *lengths)
{
    const double dt = TWIN_SUB * p->sample_s;
    int32_t k = 0, equal = steps, until = steps;
    while (k < steps) {
        const int32_t left = steps - k;
        const double from_m = s->motion.length_m, from_m_s = s->motion.speed_m_s;
        motion_input in = {0.0, 0.0, load_n};
        int32_t now = equal < left ? equal : left;
        const int fits = motion_fits(&p->law, &p->motion, &s->motion, dt * (double)now);
        if (!fits || k >= until) {
            const int32_t parts =
                motion_steps(&p->law, &p->motion, &s->motion, dt * (double)left);
            now = equal = parts < left ? left / parts : 1;
            until = k + SAME_STEPS * equal;
        }
        if (p->second_kg > 0.0) {
            now = 1;
        }
        if (!s->broken && !(s->reference_f > 0.0)) {
            in.volt = volt;
            in.ripple_v2 = ripple_v2;
        }
        watch_field(p, s, in.volt);
        move_on(p, s, &in, time_s + dt * (double)k, dt * (double)now, fits);
        if (lengths != NULL) {
            lengths_between(from_m, from_m_s, &s->motion, dt * (double)now, now, lengths + k);
        }
        k += now;
    }
}

void twin_move(const twin_parameters *p, twin_state *s, const double *drive_v, int32_t n_drive,
               int32_t steps_per_value, double load_n, int32_t n_steps, double *lengths)
{
    const double dt = TWIN_SUB * p->sample_s, carrier = carrier_at_output(p);
    int32_t value, k = 0;
    for (value = 0; value < n_drive && k < n_steps; ++value) {
        const int32_t left = n_steps - k;
        const int32_t steps =
            value < n_drive - 1 && steps_per_value < left ? steps_per_value : left;
        move_value(p, s, p->gain * drive_v[value], 0.5 * carrier * carrier, load_n,
                   s->time_s + dt * (double)k, steps, lengths == NULL ? NULL : lengths + k);
        k += steps;
    }
    s->amp_v = p->gain * drive_v[n_drive - 1];
    s->amp_v_s = 0.0;
    s->plate_v = s->amp_v;
    s->v_seen = s->v_shown = s->amp_v;
    s->i_seen = s->i_shown = 0.0;
    s->time_s += n_steps * dt;
}

double twin_update(const twin_parameters *p, twin_state *s, const twin_update_input *in,
                   double *lengths, int32_t at)
{
    const double before_s = s->time_s;
    double sum = 0.0;
    int32_t k;
    if (in->switch_at > 0) {
        twin_move(p, s, &in->before_v, 1, 1, in->load_n, in->switch_at, lengths + at);
    }
    if (in->switch_at < in->steps) {
        twin_move(p, s, &in->after_v, 1, 1, in->load_n, in->steps - in->switch_at,
                  lengths + at + in->switch_at);
    }
    for (k = in->first; k <= in->last; ++k) { /* trapezoidal rule */
        const double volt = p->gain * (k > in->switch_at ? in->after_v : in->before_v);
        const double weight = k == in->first || k == in->last ? 0.5 : 1.0;
        sum += weight * motion_capacitance(&p->law, lengths[at - 1 + k], volt);
    }
    return sum / (double)(in->last - in->first) * twin_permittivity(p, before_s);
}

/* ---- electricity ---- */

/* First-order lag, exact for an input that is a straight line from sample to sample. Without a lag
 * the output is the input, bit for bit. */
static void prepare_lag(twin_lag *lag, double lag_s, double sample_s)
{
    const double x = lag_s > 0.0 ? sample_s / lag_s : 0.0;
    const double decay = lag_s > 0.0 ? exp(-x) : 0.0;
    const double mean = lag_s > 0.0 ? (1.0 - decay) / x : 0.0;
    lag->last_output = decay;
    lag->last_input = mean - decay;
    lag->input = 1.0 - mean;
}

void twin_connect(twin_state *s, double farad, double series_ohm)
{
    s->reference_f = farad;
    s->reference_ohm = series_ohm;
    s->plate_v = s->amp_v;
    s->i_seen = s->i_shown = 0.0;
}

void twin_prepare(twin_parameters *p)
{
    /* Exact discretisation of the amplifier, x = (v, dv/dt): of a held input, and of a ramp, which
     * has the particular solution (t / dt - 2 z / (w dt), 1 / dt). */
    const double w = p->amplifier_rad_s, z = p->amplifier_damping, t = p->sample_s;
    const double d = w * sqrt(1.0 - z * z), e = exp(-z * w * t);
    const double c = cos(d * t), s = sin(d * t);
    p->amp_a[0][0] = e * (c + z * w / d * s);
    p->amp_a[0][1] = e * s / d;
    p->amp_a[1][0] = -e * w * w / d * s;
    p->amp_a[1][1] = e * (c - z * w / d * s);
    p->amp_b[0] = 1.0 - p->amp_a[0][0];
    p->amp_b[1] = -p->amp_a[1][0];
    p->amp_r[0] = 1.0 - 2.0 * z / (w * t) * p->amp_b[0] - p->amp_a[0][1] / t;
    p->amp_r[1] = 1.0 / t + 2.0 * z / (w * t) * p->amp_a[1][0] - p->amp_a[1][1] / t;
    prepare_lag(&p->v_lag, p->v_monitor_lag_s, t);
    prepare_lag(&p->i_lag, p->i_monitor_lag_s, t);
}

/* What is connected to the output. */
typedef struct {
    double farad, series_ohm, leakage_ohm;
    double decay, decay_read; /* of what is left of a lag: over a sample, and to the second channel */
} element;

/* The carrier at the actuator: its parts in phase with the generator's and a quarter ahead, and its
 * mean square. */
typedef struct {
    double sine, cosine, square;
} carried;

static carried carrier_behind(const twin_parameters *p, double rc)
{
    const double ratio = p->carrier_rad_s / p->amplifier_rad_s, lag = p->carrier_rad_s * rc;
    const double first = 1.0 - ratio * ratio, second = 2.0 * p->amplifier_damping * ratio;
    const double real = first - second * lag, imaginary = second + first * lag;
    const double size = p->gain * p->carrier_v / (real * real + imaginary * imaginary);
    carried found = {size * real, -size * imaginary, 0.0};
    found.square = 0.5 * (found.sine * found.sine + found.cosine * found.cosine);
    return found;
}

/* `sine`, `cosine`: of the carrier's phase. `warm`: factor on the actuator's capacitance. */
static element connected(const twin_parameters *p, const twin_state *s, double sine, double cosine,
                         double warm)
{
    element load = {s->reference_f, s->reference_ohm, INFINITY, 0.0, 0.0};
    double rc;
    if (!(s->reference_f > 0.0)) { /* as it will be in the middle of the next mechanical step */
        const double ahead_s = 0.5 * TWIN_SUB * p->sample_s;
        const double middle_m = s->motion.length_m + ahead_s * s->motion.speed_m_s;
        double root_v = s->plate_v;
        if (p->law.voltages > 1) { /* what it depends on, such as zipping, is too slow to follow */
            const double near_f = motion_capacitance(&p->law, middle_m, root_v) * warm;
            const carried c = carrier_behind(p, p->series_ohm * near_f);
            const double slow_v = s->plate_v - c.sine * sine - c.cosine * cosine;
            root_v = sqrt(slow_v * slow_v + c.square);
        }
        load.farad = motion_capacitance(&p->law, middle_m, root_v) * warm;
        load.series_ohm = p->series_ohm;
        load.leakage_ohm = p->leakage_ohm;
    }
    rc = load.series_ohm * load.farad;
    if (rc > 0.02 * p->sample_s) {
        load.decay = exp(-p->sample_s / rc);
        load.decay_read = exp(-p->skew_s / rc);
    }
    return load;
}

/* A change of the voltage in a step that moves no law. */
#define STEADY 1e-3
#define STEADY_V 1.0

/* Samples of one mechanical step, one array for each quantity: most of the work needs no earlier
 * sample and is done on vectors. A voltage and its rate have one value more, at the end. */
typedef struct {
    double held_v[TWIN_SUB], rise_v[TWIN_SUB]; /* input of the amplifier, straight from v to v + rise */
    double amp_v[TWIN_SUB + 1], amp_v_s[TWIN_SUB + 1];
    double start_v[TWIN_SUB], end_v[TWIN_SUB]; /* of the capacitor, without what is left of a lag */
    double plate_v[TWIN_SUB + 1], lag_v[TWIN_SUB];
    double flow_a[TWIN_SUB], amps[TWIN_SUB];
    float noise_v[TWIN_SUB], noise_i[TWIN_SUB];
    double sine[TWIN_SUB + 1], cosine[TWIN_SUB + 1]; /* of the carrier's phase */
} samples;

/* The amplifier: linear dynamics, then the slew and the current it can deliver. */
static void amplify(const twin_parameters *p, twin_state *s, double largest_step, samples *x)
{
    double v = s->amp_v, rate = s->amp_v_s;
    int32_t since = s->since_limited;
    int j;
    x->amp_v[0] = v;
    x->amp_v_s[0] = rate;
    for (j = 0; j < TWIN_SUB; ++j) {
        const double held = x->held_v[j], rise = x->rise_v[j], before = v;
        v = p->amp_a[0][0] * before + p->amp_a[0][1] * rate + p->amp_b[0] * held +
            p->amp_r[0] * rise;
        rate = p->amp_a[1][0] * before + p->amp_a[1][1] * rate + p->amp_b[1] * held +
               p->amp_r[1] * rise;
        if (fabs(v - before) > largest_step) {
            const double step = v > before ? largest_step : -largest_step;
            v = before + step;
            rate = step / p->sample_s;
            ++s->limited;
            since = -1;
        }
        ++since;
        x->amp_v[j + 1] = v;
        x->amp_v_s[j + 1] = rate;
    }
    s->amp_v = v;
    s->amp_v_s = rate;
    s->since_limited = since < TWIN_LONG ? since : TWIN_LONG;
}

/* Series R-C in samples in which the voltage follows the cubic from one output and rate of the
 * amplifier to the next. Exact for it: with the derivatives v1, v2, v3 of that voltage, the capacitor
 * has v - rc v1 + rc^2 v2 - rc^3 v3 and a lag that decays. `flow_a`: the current of the former when
 * the second channel is converted, with that through the stray capacitance. */
HS_CLONES static void follow_cubics(const twin_parameters *p, const element *load, samples *x)
{
    const double dt = p->sample_s, t = p->skew_s, farad = load->farad, stray = p->stray_f;
    const double rc = load->series_ohm * farad, dt2 = dt * dt;
    int j;
    for (j = 0; j < TWIN_SUB; ++j) {
        const double v0 = x->amp_v[j], r0 = x->amp_v_s[j], v1 = x->amp_v[j + 1];
        const double r1 = x->amp_v_s[j + 1], mean = (v1 - v0) / dt;
        const double twist = 6.0 * (r0 + r1 - 2.0 * mean) / dt2;
        const double bend0 = 2.0 * (3.0 * mean - 2.0 * r0 - r1) / dt;
        const double bend1 = bend0 + twist * dt, bend = bend0 + twist * t;
        const double rate = r0 + t * (bend0 + 0.5 * twist * t);
        x->start_v[j] = v0 - rc * (r0 - rc * (bend0 - rc * twist));
        x->end_v[j] = v1 - rc * (r1 - rc * (bend1 - rc * twist));
        x->flow_a[j] = farad * (rate - rc * (bend - rc * twist));
        x->amps[j] = stray * rate;
    }
}

static void charge(twin_state *s, const element *load, samples *x)
{
    double plate = s->plate_v;
    int j;
    x->plate_v[0] = plate;
    for (j = 0; j < TWIN_SUB; ++j) {
        x->lag_v[j] = plate - x->start_v[j];
        plate = x->end_v[j] + x->lag_v[j] * load->decay;
        x->plate_v[j + 1] = plate;
    }
    s->plate_v = plate;
}

/* Adds the current of the lag, and the leakage. */
HS_CLONES static void add_currents(const element *load, samples *x)
{
    const double ohm = load->decay > 0.0 ? load->series_ohm : INFINITY;
    const double read = load->decay_read, leakage = load->leakage_ohm;
    int j;
    for (j = 0; j < TWIN_SUB; ++j) {
        x->amps[j] += x->flow_a[j] - x->lag_v[j] * read / ohm + x->plate_v[j + 1] / leakage;
    }
}

/* What the monitors show, from their inputs, in place. */
static void follow(const twin_lag *lag, double *shown, double *seen, double *values)
{
    double last = *seen, now = *shown;
    int j;
    if (lag->last_output == 0.0 && lag->last_input == 0.0 && lag->input == 1.0) {
        *seen = *shown = values[TWIN_SUB - 1];
        return;
    }
    for (j = 0; j < TWIN_SUB; ++j) {
        now = lag->last_output * now + lag->last_input * last + lag->input * values[j];
        last = values[j];
        values[j] = now;
    }
    *seen = last;
    *shown = now;
}

HS_CLONES static void convert(const double *values, double scale, double offset_v,
                              const float *noise, double noise_v, double lsb_v, double top,
                              int16_t *codes)
{
    int32_t rounded[TWIN_SUB];
    int j;
    for (j = 0; j < TWIN_SUB; ++j) {
        double code = (values[j] * scale + noise_v * (double)noise[j] + offset_v) / lsb_v;
        code = code < top ? code : top;
        code = code > -top - 1.0 ? code : -top - 1.0;
        rounded[j] = (int32_t)nearbyint(code);
    }
    for (j = 0; j < TWIN_SUB; ++j) {
        codes[2 * j] = (int16_t)rounded[j];
    }
}

/* Generator and drive, from a sample of the block on; moves the carrier's (cosine, sine) on. */
static void generate(const twin_parameters *p, double gain, const double drive_v[2], int32_t until,
                     const double turn[2], double carrier[2], samples *x)
{
    double c = carrier[0], q = carrier[1];
    int j;
    for (j = 0; j < TWIN_SUB; ++j) {
        const double now = q;
        x->sine[j] = q;
        x->cosine[j] = c;
        q = now * turn[0] + c * turn[1];
        c = c * turn[0] - now * turn[1];
        x->held_v[j] = gain * (drive_v[j >= until] + p->carrier_v * now);
        x->rise_v[j] = gain * p->carrier_v * (q - now);
    }
    x->sine[TWIN_SUB] = q;
    x->cosine[TWIN_SUB] = c;
    carrier[0] = c;
    carrier[1] = q;
}

static void read_monitors(const twin_parameters *p, twin_state *s, samples *x, int16_t *codes)
{
    if (p->v_noise_v != 0.0 || p->i_noise_v != 0.0) {
        normal_pairs(s->random, x->noise_v, x->noise_i);
    }
    follow(&p->v_lag, &s->v_shown, &s->v_seen, x->amp_v); /* at the begin of each sample */
    follow(&p->i_lag, &s->i_shown, &s->i_seen, x->amps);
    convert(x->amp_v, p->v_monitor, p->v_offset_v, x->noise_v, p->v_noise_v, p->lsb_v, p->top_code,
            codes);
    convert(x->amps, p->i_monitor, p->i_offset_v, x->noise_i, p->i_noise_v, p->lsb_v, p->top_code,
            codes + 1);
}

/* Mean voltage and its ripple over some samples, by the trapezoidal rule. */
static motion_input pull_of(const double *volt, int samples_used, double load_n)
{
    motion_input pull = {0.0, 0.0, load_n};
    double sum = 0.0, sum2 = 0.0;
    int j;
    for (j = 0; j < samples_used; ++j) {
        const double v0 = volt[j], v1 = volt[j + 1];
        sum += 0.5 * (v0 + v1);
        sum2 += 0.5 * (v0 * v0 + v1 * v1);
    }
    pull.volt = sum / samples_used;
    pull.ripple_v2 = sum2 / samples_used - pull.volt * pull.volt;
    return pull;
}

/* Moves by a step under a law that does not follow the carrier, whose mean square acts. Its force is
 * not proportional to the square of the voltage, so that a change is followed sample by sample. */
static void move_without_carrier(const twin_parameters *p, twin_state *s, const samples *x,
                                 const carried *rides, double load_n, double time_s)
{
    double volt[TWIN_SUB + 1], change = 0.0;
    int j, at_once = TWIN_SUB;
    for (j = 0; j <= TWIN_SUB; ++j) {
        volt[j] = x->plate_v[j] - rides->sine * x->sine[j] - rides->cosine * x->cosine[j];
        change = fmax(change, fabs(volt[j] - volt[0]));
    }
    if (change > STEADY * fabs(volt[0]) + STEADY_V) {
        at_once = 1;
    }
    for (j = 0; j < TWIN_SUB; j += at_once) {
        motion_input pull = pull_of(volt + j, at_once, load_n);
        pull.ripple_v2 += rides->square;
        move_on(p, s, &pull, time_s + p->sample_s * j, p->sample_s * at_once, 0);
    }
}

void twin_acquire(const twin_parameters *p, twin_state *s, double before_v, double after_v,
                  int32_t switch_at, double load_n, int32_t n_samples, int16_t *codes,
                  double *lengths)
{
    const double dt = TWIN_SUB * p->sample_s, drive_v[2] = {before_v, after_v};
    const double turned = p->carrier_rad_s * p->sample_s, turn[2] = {cos(turned), sin(turned)};
    const double phase = fmod(p->carrier_rad_s * s->time_s, 6.283185307179586);
    const double warm = twin_permittivity(p, s->time_s);
    double carrier[2] = {cos(phase), sin(phase)};
    samples x = {0};
    int32_t step;

    for (step = 0; step < n_samples / TWIN_SUB; ++step) {
        const element load = connected(p, s, carrier[1], carrier[0], warm);
        const carried rides = carrier_behind(p, load.series_ohm * load.farad);
        const double by_current = p->current_limit_a / (load.farad + p->stray_f);
        const double reach =
            p->sample_s * (by_current < p->slew_v_s ? by_current : p->slew_v_s);
        const double time_s = s->time_s + dt * (double)step;
        motion_input pull = {0.0, 0.0, load_n};
        generate(p, s->broken ? 0.0 : p->gain, drive_v, switch_at - step * TWIN_SUB, turn, carrier,
                 &x);
        amplify(p, s, reach, &x);
        follow_cubics(p, &load, &x);
        charge(s, &load, &x);
        add_currents(&load, &x);
        read_monitors(p, s, &x, codes + 2 * TWIN_SUB * step);
        if (s->reference_f > 0.0) { /* it feels no voltage */
            move_on(p, s, &pull, time_s, dt, 0);
        } else {
            watch_field(p, s, s->plate_v);
            if (p->law.voltages > 1) {
                move_without_carrier(p, s, &x, &rides, load_n, time_s);
            } else {
                pull = pull_of(x.plate_v, TWIN_SUB, load_n);
                move_on(p, s, &pull, time_s, dt, 0);
            }
        }
        lengths[step] = s->motion.length_m;
    }
    s->time_s += n_samples * p->sample_s;
}
