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

/* ---- a law on a grid ---- */

typedef struct {
    int32_t first;
    double weight[4];
} cubic;

/* Lagrange's cubic through the four knots about `at`, counted in knots; constant beyond the ends. */
static cubic cubic_at(double at, int32_t knots)
{
    const double last = (double)(knots - 1);
    const double inside = at > 0.0 ? (at < last ? at : last) : 0.0;
    int32_t i = (int32_t)inside;
    cubic c;
    double t;
    i = i < 1 ? 1 : i > knots - 3 ? knots - 3 : i;
    t = inside - (double)i;
    c.first = i - 1;
    c.weight[0] = -t * (t - 1.0) * (t - 2.0) / 6.0;
    c.weight[1] = (t + 1.0) * (t - 1.0) * (t - 2.0) / 2.0;
    c.weight[2] = -(t + 1.0) * t * (t - 2.0) / 2.0;
    c.weight[3] = (t + 1.0) * t * (t - 1.0) / 6.0;
    return c;
}

static double along(const double *values, const cubic *c)
{
    const double *v = values + c->first;
    return c->weight[0] * v[0] + c->weight[1] * v[1] + c->weight[2] * v[2] + c->weight[3] * v[3];
}

static cubic at_length(const twin_table *t, double length_m)
{
    return cubic_at((length_m - t->low_m) / t->step_m, t->lengths);
}

static double across(const twin_table *t, const double rows[][TWIN_LENGTHS], double length_m,
                     double voltage_v)
{
    const cubic c = at_length(t, length_m);
    double sum = 0.0;
    cubic row;
    int k;
    if (t->voltages == 1) {
        return along(rows[0], &c);
    }
    row = cubic_at(fabs(voltage_v) / t->step_v, t->voltages);
    for (k = 0; k < 4; ++k) {
        sum += row.weight[k] * along(rows[row.first + k], &c);
    }
    return sum;
}

/* ---- mechanics ---- */

static double shell_stress(const twin_parameters *p, double stretch)
{
    const double l2 = p->lateral_stretch * p->lateral_stretch;
    const double s2 = stretch * stretch;
    const double i1 = s2 + l2 + 1.0 / (s2 * l2);
    const double slope =
        p->ab[0] + i1 * (p->ab[1] + i1 * (p->ab[2] + i1 * (p->ab[3] + i1 * p->ab[4])));
    return 2.0 * slope * (stretch - 1.0 / (s2 * stretch * l2));
}

/* Of shell and electrodes, without the virgin's stiffness. */
static double softened_force(const twin_parameters *p, double length_m)
{
    const double e = length_m / p->free_length_m - 1.0;
    const double shell = p->area_m2 * shell_stress(p, length_m / p->length_m);
    const double gel = p->electrode_n_m * p->free_length_m * e * (1.0 + p->electrode_cubic * e * e);
    return shell + gel;
}

static double tabled_force(const twin_parameters *p, double length_m)
{
    const cubic c = at_length(&p->law, length_m);
    return along(p->law.elastic_n, &c);
}

double twin_elastic_force(const twin_parameters *p, double length_m, double longest_m)
{
    const double softened =
        p->law.lengths ? tabled_force(p, length_m) : softened_force(p, length_m);
    const double reached = longest_m / p->free_length_m;
    const double virgin =
        p->mullins / (1.0 + exp((reached - p->mullins_stretch) / p->mullins_width));
    return softened * (1.0 + virgin);
}

static double power_law(const twin_parameters *p, double length_m)
{
    return p->capacitance_f * pow(length_m / p->free_length_m, p->capacitance_exponent);
}

double twin_capacitance(const twin_parameters *p, double length_m, double voltage_v)
{
    return p->law.lengths ? across(&p->law, p->law.capacitance_f, length_m, voltage_v)
                          : power_law(p, length_m);
}

double twin_gap(const twin_parameters *p, double length_m)
{
    if (p->law.lengths) {
        const cubic c = at_length(&p->law, length_m);
        return along(p->law.gap_m, &c);
    }
    return p->thickness_m * pow(length_m / p->free_length_m, -0.5 * p->capacitance_exponent);
}

/* Force of the field under the mean square voltage `v2`, along the length. */
static double electric_force(const twin_parameters *p, double length_m, double v2)
{
    if (v2 == 0.0) {
        return 0.0;
    }
    if (p->law.lengths) {
        return v2 * across(&p->law, p->law.pull_n_v2, length_m, sqrt(v2));
    }
    return 0.5 * v2 * p->capacitance_exponent * power_law(p, length_m) / length_m;
}

/* One step under the mean square voltage `v2`: branches by backward Euler, the rest symplectic. */
static void move(const twin_parameters *p, twin_state *s, double v2, double load_n, double dt)
{
    const double x = s->length_m;
    const double electric = electric_force(p, x, v2);
    double elastic, change, force, share;
    int k;

    if (x > s->longest_m) {
        s->longest_m = x;
    }
    elastic = twin_elastic_force(p, x, s->longest_m);
    change = elastic - s->elastic_n;
    s->elastic_n = elastic;
    force = load_n + electric - elastic;
    for (k = 0; k < TWIN_BRANCHES; ++k) {
        if (p->prony_g[k] > 0.0) {
            const double decay = p->prony_s[k] / (p->prony_s[k] + dt);
            s->branch_n[k] = decay * (s->branch_n[k] + p->prony_g[k] * change);
            force -= s->branch_n[k];
        }
    }
    share = dt * p->damping_n_s_m / p->inertia_kg;
    s->speed_m_s = (s->speed_m_s + dt * force / p->inertia_kg) / (1.0 + share);
    s->length_m = x + dt * s->speed_m_s;
}

/* One mechanical step; a law in a table may need finer ones, and is valid inside its table only. */
static void move_on(const twin_parameters *p, twin_state *s, double v2, double load_n, double dt)
{
    const twin_table *law = &p->law;
    int32_t k;
    if (!law->lengths) {
        move(p, s, v2, load_n, dt);
        return;
    }
    for (k = 0; k < law->substeps; ++k) {
        move(p, s, v2, load_n, dt / (double)law->substeps);
    }
    if (!(s->length_m >= law->low_m &&
          s->length_m <= law->low_m + law->step_m * (double)(law->lengths - 1))) {
        s->outside = s->broken = 1;
    }
}

/* Square of the voltage that pulls: part of it follows at once, part with the oil's charge. */
static double pulling_square(const twin_parameters *p, twin_state *s, double mean_v, double mean_v2,
                             double dt)
{
    const double share = p->relaxation_share;
    double pulling;
    if (!(share > 0.0)) {
        return mean_v2;
    }
    s->relaxed_v += (mean_v - s->relaxed_v) * dt / (p->relaxation_s + dt);
    pulling = (1.0 - share) * mean_v + share * s->relaxed_v;
    return pulling * pulling + mean_v2 - mean_v * mean_v;
}

static void watch_field(const twin_parameters *p, twin_state *s, double voltage)
{
    const double field = voltage != 0.0 ? fabs(voltage) / twin_gap(p, s->length_m) : 0.0;
    if (field > s->field_v_m) {
        s->field_v_m = field;
    }
    if (field > p->breakdown_v_m) {
        s->broken = 1;
    }
}

void twin_move(const twin_parameters *p, twin_state *s, const double *drive_v, int32_t n_drive,
               int32_t steps_per_value, double load_n, int32_t n_steps, double *lengths)
{
    const double dt = TWIN_SUB * p->sample_s;
    int32_t k;
    for (k = 0; k < n_steps; ++k) {
        int32_t index = k / steps_per_value;
        double v;
        index = index < n_drive ? index : n_drive - 1;
        v = s->broken || s->reference_f > 0.0 ? 0.0 : p->gain * drive_v[index];
        watch_field(p, s, v);
        move_on(p, s, pulling_square(p, s, v, v * v, dt), load_n, dt);
        if (lengths != NULL) {
            lengths[k] = s->length_m;
        }
    }
    s->amp_v = p->gain * drive_v[n_drive - 1];
    s->amp_v_s = 0.0;
    s->plate_v = s->amp_v;
    s->v_seen = s->v_shown = s->amp_v;
    s->current_a = s->i_seen = s->i_shown = 0.0;
    s->time_s += n_steps * dt;
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
    s->current_a = s->i_seen = s->i_shown = 0.0;
}

void twin_prepare(twin_parameters *p)
{
    /* Exact discretisation of the amplifier, x = (v, dv/dt), held input. */
    const double w = p->amplifier_rad_s, z = p->amplifier_damping, t = p->sample_s;
    const double d = w * sqrt(1.0 - z * z), e = exp(-z * w * t);
    const double c = cos(d * t), s = sin(d * t);
    p->amp_a[0][0] = e * (c + z * w / d * s);
    p->amp_a[0][1] = e * s / d;
    p->amp_a[1][0] = -e * w * w / d * s;
    p->amp_a[1][1] = e * (c - z * w / d * s);
    p->amp_b[0] = 1.0 - p->amp_a[0][0];
    p->amp_b[1] = -p->amp_a[1][0];
    prepare_lag(&p->v_lag, p->v_monitor_lag_s, t);
    prepare_lag(&p->i_lag, p->i_monitor_lag_s, t);
}

/* The amplifier for one sample: linear dynamics, then the slew and the current it can deliver. */
static void amplify(const twin_parameters *p, twin_state *s, double target_v, double largest_step)
{
    const double v0 = s->amp_v;
    double v = p->amp_a[0][0] * v0 + p->amp_a[0][1] * s->amp_v_s + p->amp_b[0] * target_v;
    double rate = p->amp_a[1][0] * v0 + p->amp_a[1][1] * s->amp_v_s + p->amp_b[1] * target_v;
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
    double decay; /* of the voltage across the series resistance, over one sample */
} element;

static element connected(const twin_parameters *p, const twin_state *s)
{
    element load = {s->reference_f, s->reference_ohm, INFINITY, 0.0};
    double rc;
    if (!(s->reference_f > 0.0)) {
        load.farad = twin_capacitance(p, s->length_m, s->plate_v);
        load.series_ohm = p->series_ohm;
        load.leakage_ohm = p->leakage_ohm;
    }
    rc = load.series_ohm * load.farad;
    load.decay = rc > 0.02 * p->sample_s ? exp(-p->sample_s / rc) : 0.0;
    return load;
}

/* Series R-C with leakage, and the stray capacitance beside them, for one sample in which the
 * voltage goes v0 -> v1 in a straight line. */
static void charge(const twin_parameters *p, twin_state *s, double v0, double v1, element load)
{
    const double dt = p->sample_s, farad = load.farad, rc = load.series_ohm * farad;
    const double decay = load.decay;
    const double slope = (v1 - v0) / dt;
    const double plate = v1 - slope * rc * (1.0 - decay) + (s->plate_v - v0) * decay;
    s->current_a =
        farad * (plate - s->plate_v) / dt + plate / load.leakage_ohm + p->stray_f * slope;
    s->plate_v = plate;
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
    const double later = p->skew_s / p->sample_s; /* 0 to 1: place of the second channel */
    const double phase = fmod(p->carrier_rad_s * s->time_s, 6.283185307179586);
    const int noisy = p->v_noise_v != 0.0 || p->i_noise_v != 0.0;
    double c = cos(phase), q = sin(phase);
    int32_t n = 0, step;

    for (step = 0; step < n_samples / TWIN_SUB; ++step) {
        const element load = connected(p, s);
        const double by_current = p->current_limit_a / (load.farad + p->stray_f);
        const double reach =
            p->sample_s * (by_current < p->slew_v_s ? by_current : p->slew_v_s);
        const double pulls = s->reference_f > 0.0 ? 0.0 : 1.0; /* a reference moves nothing */
        double sum = 0.0, sum2 = 0.0;
        int j;
        for (j = 0; j < TWIN_SUB; ++j, ++n) {
            const double drive = n < switch_at ? before_v : after_v;
            const double v0 = s->amp_v, i0 = s->current_a;
            const double now = q;
            float noise_v = 0.0f, noise_i = 0.0f;
            double amps;
            amplify(p, s, s->broken ? 0.0 : p->gain * (drive + p->carrier_v * now), reach);
            charge(p, s, v0, s->amp_v, load);
            /* the mean current of a sample is that of its middle */
            amps = later < 0.5 ? i0 + (s->current_a - i0) * (later + 0.5)
                               : s->current_a;
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
            sum += pulls * s->plate_v;
            sum2 += pulls * s->plate_v * s->plate_v;
            q = now * turn_c + c * turn_s;
            c = c * turn_c - now * turn_s;
        }
        watch_field(p, s, pulls * s->plate_v);
        move_on(p, s, pulling_square(p, s, sum / TWIN_SUB, sum2 / TWIN_SUB, dt), load_n, dt);
        lengths[step] = s->length_m;
    }
    s->time_s += n_samples * p->sample_s;
}
