/* Takes: drive voltage and load. Gives: ADC codes of both monitors and the true lengths. */
#include "twin/twin.h"

#include <math.h>
#include <stddef.h>
#include <string.h>

/* ---- random numbers: xoshiro256++, Box-Muller ---- */

static uint64_t rotate(uint64_t x, int k) { return (x << k) | (x >> (64 - k)); }

static uint64_t draw(uint64_t *r)
{
    const uint64_t out = rotate(r[0] + r[3], 23) + r[0];
    const uint64_t t = r[1] << 17;
    r[2] ^= r[0];
    r[3] ^= r[1];
    r[1] ^= r[2];
    r[0] ^= r[3];
    r[2] ^= t;
    r[3] = rotate(r[3], 45);
    return out;
}

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

static void normal_pair(uint64_t *r, float *a, float *b)
{
    const uint64_t bits = draw(r);
    const float u = ((float)(uint32_t)(bits >> 40) + 0.5f) * 5.9604645e-8f;  /* 24 bits */
    const float w = (float)(uint32_t)(bits & 0xFFFFFFu) * 3.7450703e-7f;     /* 2 pi / 2^24 */
    const float radius = sqrtf(-2.0f * logf(u));
    *a = radius * cosf(w);
    *b = radius * sinf(w);
}

/* ---- motion ---- */

/* 1 + share of a change that approaches its end within a time constant. */
static double changed(double share, double time_s, double constant_s)
{
    return share != 0.0 ? 1.0 - share * expm1(-time_s / constant_s) : 1.0;
}

static double permittivity(const twin_parameters *p, double time_s)
{
    return changed(p->capacitance_rise, fmax(time_s - p->begins_s, 0.0), p->warming_s);
}

/* Motion of the actuator with ageing, warming and the second mass, of which the force on the moving
 * end is that at the beginning: dt must be short against its period. */
static void move_further(const twin_parameters *p, twin_state *s, const motion_input *in,
                         double time_s, double dt)
{
    const double share = permittivity(p, time_s), before_m_s = s->motion.speed_m_s;
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

/* Moves on from a time under a voltage and its ripple; the law is valid inside its table only. */
static void move_on(const twin_parameters *p, twin_state *s, const motion_input *in, double time_s,
                    double dt)
{
    const motion_law *law = &p->law;
    if (p->capacitance_rise != 0.0 || p->stiffness_loss != 0.0 || p->second_kg > 0.0) {
        move_further(p, s, in, time_s, dt);
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

void twin_move(const twin_parameters *p, twin_state *s, const double *drive_v, int32_t n_drive,
               int32_t steps_per_value, double load_n, int32_t n_steps, double *lengths)
{
    const double dt = TWIN_SUB * p->sample_s, carrier = carrier_at_output(p);
    int32_t k = 0;
    while (k < n_steps) {
        const int32_t value = k / steps_per_value, last = n_drive - 1;
        const int32_t held = value < last ? (value + 1) * steps_per_value - k : n_steps - k;
        const int32_t left = held < n_steps - k ? held : n_steps - k;
        const int32_t parts = motion_steps(&p->law, &p->motion, &s->motion, dt * (double)left);
        const int32_t steps = parts < left && !(p->second_kg > 0.0) ? left / parts : 1;
        const motion_state before = s->motion;
        motion_input in = {0.0, 0.0, load_n};
        int32_t i;
        if (!s->broken && !(s->reference_f > 0.0)) {
            in.volt = p->gain * drive_v[value < last ? value : last];
            in.ripple_v2 = 0.5 * carrier * carrier;
        }
        watch_field(p, s, in.volt);
        move_on(p, s, &in, s->time_s + dt * (double)k, dt * (double)steps);
        if (lengths != NULL) { /* Hermite's cubic, by its powers */
            const double whole = dt * (double)steps, per = 1.0 / (double)steps;
            const double from = whole * before.speed_m_s, to = whole * s->motion.speed_m_s;
            const double rise = s->motion.length_m - before.length_m;
            for (i = 0; i < steps; ++i) {
                const double t = (double)(i + 1) * per;
                const double bend = 3.0 * rise - 2.0 * from - to + t * (from + to - 2.0 * rise);
                lengths[k + i] = before.length_m + t * (from + t * bend);
            }
        }
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
    return sum / (double)(in->last - in->first) * permittivity(p, before_s);
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

static double follow(const twin_lag *lag, double *shown, double *seen, double input)
{
    *shown = lag->last_output * *shown + lag->last_input * *seen + lag->input * input;
    *seen = input;
    return *shown;
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

/* The amplifier for one sample: linear dynamics, then the slew and the current it can deliver. */
/* One sample: the input is `held_v` and rises by `rise_v` in a straight line. */
static void amplify(const twin_parameters *p, twin_state *s, double held_v, double rise_v,
                    double largest_step)
{
    const double v0 = s->amp_v, r0 = s->amp_v_s;
    double v = p->amp_a[0][0] * v0 + p->amp_a[0][1] * r0 + p->amp_b[0] * held_v +
               p->amp_r[0] * rise_v;
    double rate = p->amp_a[1][0] * v0 + p->amp_a[1][1] * r0 + p->amp_b[1] * held_v +
                  p->amp_r[1] * rise_v;
    if (fabs(v - v0) > largest_step) {
        const double step = v > v0 ? largest_step : -largest_step;
        v = v0 + step;
        rate = step / p->sample_s;
        ++s->limited;
    }
    s->amp_v = v;
    s->amp_v_s = rate;
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

/* Series R-C with leakage, and the stray capacitance beside them, for one sample in which the
 * voltage follows the cubic from v0 with the rate r0 to the amplifier's output and rate. Exact for
 * it: with the derivatives v1, v2, v3 of that voltage, the capacitor has v - rc v1 + rc^2 v2 -
 * rc^3 v3 and a lag that decays. Returns the current when the second channel is converted. */
static double charge(const twin_parameters *p, twin_state *s, double v0, double r0, element load)
{
    const double dt = p->sample_s, t = p->skew_s, farad = load.farad;
    const double rc = load.series_ohm * farad, mean = (s->amp_v - v0) / dt;
    const double twist = 6.0 * (r0 + s->amp_v_s - 2.0 * mean) / (dt * dt);
    const double bend0 = 2.0 * (3.0 * mean - 2.0 * r0 - s->amp_v_s) / dt;
    const double bend1 = bend0 + twist * dt, bend = bend0 + twist * t;
    const double rate = r0 + t * (bend0 + 0.5 * twist * t);
    const double lag = s->plate_v - (v0 - rc * (r0 - rc * (bend0 - rc * twist)));
    const double left = load.decay > 0.0 ? lag * load.decay_read / load.series_ohm : 0.0;
    const double flow = farad * (rate - rc * (bend - rc * twist)) - left;
    s->plate_v = s->amp_v - rc * (s->amp_v_s - rc * (bend1 - rc * twist)) + lag * load.decay;
    return flow + s->plate_v / load.leakage_ohm + p->stray_f * rate;
}

static int16_t convert(double volt, double lsb)
{
    const double code = volt / lsb;
    if (code >= 32767.0) {
        return 32767;
    }
    if (code <= -32768.0) {
        return -32768;
    }
    return (int16_t)lrint(code);
}

void twin_acquire(const twin_parameters *p, twin_state *s, double before_v, double after_v,
                  int32_t switch_at, double load_n, int32_t n_samples, int16_t *codes,
                  double *lengths)
{
    const double dt = TWIN_SUB * p->sample_s;
    const double turn_c = cos(p->carrier_rad_s * p->sample_s);
    const double turn_s = sin(p->carrier_rad_s * p->sample_s);
    const double phase = fmod(p->carrier_rad_s * s->time_s, 6.283185307179586);
    const int noisy = p->v_noise_v != 0.0 || p->i_noise_v != 0.0;
    const double warm = permittivity(p, s->time_s);
    double c = cos(phase), q = sin(phase);
    int32_t n = 0, step;

    for (step = 0; step < n_samples / TWIN_SUB; ++step) {
        const element load = connected(p, s, q, c, warm);
        const carried rides = carrier_behind(p, load.series_ohm * load.farad);
        const double by_current = p->current_limit_a / (load.farad + p->stray_f);
        const double reach =
            p->sample_s * (by_current < p->slew_v_s ? by_current : p->slew_v_s);
        const double gain = s->broken ? 0.0 : p->gain;
        const double pulls = s->reference_f > 0.0 ? 0.0 : 1.0; /* a reference moves nothing */
        motion_input pull = {0.0, 0.0, load_n};
        double sum = 0.0, sum2 = 0.0, swing = 0.0;
        int j;
        for (j = 0; j < TWIN_SUB; ++j, ++n) {
            const double drive = n < switch_at ? before_v : after_v;
            const double v0 = s->amp_v, r0 = s->amp_v_s, plate0 = s->plate_v;
            const double now = q, before = c;
            float noise_v = 0.0f, noise_i = 0.0f;
            double amps;
            q = now * turn_c + c * turn_s;
            c = c * turn_c - now * turn_s;
            amplify(p, s, gain * (drive + p->carrier_v * now), gain * p->carrier_v * (q - now),
                    reach);
            amps = charge(p, s, v0, r0, load);
            if (noisy) {
                normal_pair(s->random, &noise_v, &noise_i);
            }
            codes[2 * n] = convert(follow(&p->v_lag, &s->v_shown, &s->v_seen, v0) * p->v_monitor +
                                       p->v_noise_v * (double)noise_v + p->v_offset_v,
                                   p->lsb_v);
            codes[2 * n + 1] =
                convert(follow(&p->i_lag, &s->i_shown, &s->i_seen, amps) * p->i_monitor +
                            p->i_noise_v * (double)noise_i + p->i_offset_v,
                        p->lsb_v);
            sum += 0.5 * pulls * (plate0 + s->plate_v);
            sum2 += 0.5 * pulls * (plate0 * plate0 + s->plate_v * s->plate_v);
            swing += 0.5 * pulls * (rides.sine * (now + q) + rides.cosine * (before + c));
        }
        watch_field(p, s, pulls * s->plate_v);
        pull.volt = sum / TWIN_SUB;
        pull.ripple_v2 = sum2 / TWIN_SUB - pull.volt * pull.volt;
        if (p->law.voltages > 1) {
            pull.volt -= swing / TWIN_SUB;
            pull.ripple_v2 = pulls * rides.square;
        }
        move_on(p, s, &pull, s->time_s + dt * (double)step, dt);
        lengths[step] = s->motion.length_m;
    }
    s->time_s += n_samples * p->sample_s;
}
