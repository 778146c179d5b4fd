// Python face of core/: haselab._core. The numbers are those of the microcontroller.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/tuple.h>

#include <cmath>
#include <stdexcept>
#include <tuple>

#include "hs.h"

namespace nb = nanobind;
using Codes = nb::ndarray<nb::numpy, const int16_t, nb::shape<-1, 2>, nb::c_contig, nb::device::cpu>;
using Blocks =
    nb::ndarray<nb::numpy, const int16_t, nb::shape<-1, -1, 2>, nb::c_contig, nb::device::cpu>;
using Readings =
    nb::ndarray<nb::numpy, const double, nb::shape<-1, -1, 2>, nb::c_contig, nb::device::cpu>;
using Rows = nb::ndarray<nb::numpy, const float, nb::shape<-1, 2>, nb::c_contig, nb::device::cpu>;
using Basis = nb::ndarray<nb::numpy, const double, nb::shape<-1, 4>, nb::c_contig, nb::device::cpu>;
using Phasors = nb::ndarray<nb::numpy, double, nb::shape<-1, 4>, nb::c_contig, nb::device::cpu>;
using Noise = nb::ndarray<nb::numpy, double, nb::shape<-1, 2>, nb::c_contig, nb::device::cpu>;

namespace {

using Four = std::tuple<float, float, float, float>;

void check_block(size_t samples, size_t rows)
{
    if (samples != rows || samples % 8 != 0 || samples > 65528) {
        throw std::invalid_argument("a block needs as many samples as weights, a multiple of 8");
    }
}

Four demodulate(Codes codes, Rows weights)
{
    check_block(codes.shape(0), weights.shape(0));
    const hs_phasors p =
        hs_demodulate(codes.data(), weights.data(), static_cast<uint16_t>(codes.shape(0)));
    return {p.v_re, p.v_im, p.i_re, p.i_im};
}

// Samples that count: those with a non-zero row of the basis.
size_t count_used(const double *basis, size_t n)
{
    size_t used = 0;
    for (size_t k = 0; k < n; ++k) {
        used += basis[4 * k + 2] != 0.0;
    }
    return used;
}

// Least squares of one channel on the four columns of the basis (cosine, sine, 1, ramp), in double:
// parameters into `a` (the level's less the last sample, taken out so that the sum of squares keeps its
// digits), sum of squared residuals as the answer. Samples of the two channels alternate.
// Fixed lanes let the additions overlap.
template <typename T>
double fit_channel(const T *x, const double *basis, const double *inverse, size_t n, double *a)
{
    constexpr size_t lanes = 4;
    const double last = x[2 * (n - 1)];
    double lane[5][lanes] = {}, b[5] = {0, 0, 0, 0, 0};
    const auto add = [&](size_t k, size_t j) {
        const double *row = basis + 4 * k;
        const double d = row[2] * (static_cast<double>(x[2 * k]) - last);
        lane[0][j] += row[0] * d;
        lane[1][j] += row[1] * d;
        lane[2][j] += d;
        lane[3][j] += row[3] * d;
        lane[4][j] += d * d;
    };
    size_t k = 0;
    for (; k + lanes <= n; k += lanes) {
        for (size_t j = 0; j < lanes; ++j) {
            add(k + j, j);
        }
    }
    for (; k < n; ++k) {
        add(k, 0);
    }
    for (int i = 0; i < 5; ++i) {
        b[i] = (lane[i][0] + lane[i][1]) + (lane[i][2] + lane[i][3]);
    }
    double left = b[4];
    for (int i = 0; i < 4; ++i) {
        a[i] = 0.0;
        for (int j = 0; j < 4; ++j) {
            a[i] += inverse[4 * i + j] * b[j];
        }
        left -= a[i] * b[i];
    }
    return left > 0.0 ? left : 0.0;
}

void check_outputs(size_t blocks, size_t n, const Basis &basis, const Basis &inverse,
                   const Phasors &phasors, const Noise &variance)
{
    if (basis.shape(0) != n || inverse.shape(0) != 4 || phasors.shape(0) != blocks ||
        variance.shape(0) != blocks) {
        throw std::invalid_argument("shapes of basis, inverse or outputs do not fit the blocks");
    }
}

// Phasors of many blocks (B, 4) and, per channel, the residual variance (B, 2) in codes^2.
void demodulate_blocks(Blocks codes, Rows weights, Basis basis, Basis inverse, Phasors phasors,
                       Noise variance)
{
    const size_t blocks = codes.shape(0), n = codes.shape(1);
    check_block(n, weights.shape(0));
    check_outputs(blocks, n, basis, inverse, phasors, variance);
    nb::gil_scoped_release free_gil;
    const auto freedom = static_cast<double>(count_used(basis.data(), n) - 4);
    double unused[4];
    for (size_t b = 0; b < blocks; ++b) {
        const int16_t *x = codes.data() + 2 * n * b;
        const hs_phasors p = hs_demodulate(x, weights.data(), static_cast<uint16_t>(n));
        double *out = phasors.data() + 4 * b;
        out[0] = p.v_re;
        out[1] = p.v_im;
        out[2] = p.i_re;
        out[3] = p.i_im;
        for (size_t channel = 0; channel < 2; ++channel) {
            variance.data()[2 * b + channel] =
                fit_channel(x + channel, basis.data(), inverse.data(), n, unused) / freedom;
        }
    }
}

// The same from readings that are no ADC codes, in double throughout.
void demodulate_floats(Readings readings, Basis basis, Basis inverse, Phasors phasors,
                       Noise variance)
{
    const size_t blocks = readings.shape(0), n = readings.shape(1);
    check_outputs(blocks, n, basis, inverse, phasors, variance);
    nb::gil_scoped_release free_gil;
    const auto freedom = static_cast<double>(count_used(basis.data(), n) - 4);
    for (size_t b = 0; b < blocks; ++b) {
        for (size_t channel = 0; channel < 2; ++channel) {
            double a[4];
            variance.data()[2 * b + channel] =
                fit_channel(readings.data() + 2 * n * b + channel, basis.data(), inverse.data(), n,
                            a) /
                freedom;
            phasors.data()[4 * b + 2 * channel] = a[0];
            phasors.data()[4 * b + 2 * channel + 1] = -a[1]; // x = re cos - im sin
        }
    }
}

class Impedance {
  public:
    Impedance(float v_per_i, float omega_rad_s, float skew_s, float min_amplitude)
        : config_{v_per_i, omega_rad_s, std::cos(omega_rad_s * skew_s),
                  -std::sin(omega_rad_s * skew_s), min_amplitude}
    {
    }
    std::tuple<float, float, bool> operator()(float v_re, float v_im, float i_re, float i_im) const
    {
        const hs_phasors p = {v_re, v_im, i_re, i_im};
        const hs_impedance z = hs_impedance_from_phasors(&config_, &p);
        return {z.capacitance_f, z.resistance_ohm, z.valid != 0};
    }

  private:
    hs_impedance_config config_;
};

class Pid {
  public:
    Pid(float kp, float ki, float kd, float period_s, float derivative_filter_s, float u_low,
        float u_high)
        : config_{kp, ki, kd, period_s, period_s / (period_s + derivative_filter_s), u_low, u_high}
    {
        hs_pid_init(&state_, 0.0f);
    }
    void reset(float u) { hs_pid_init(&state_, u); }
    float step(float reference, float measurement)
    {
        return hs_pid_step(&config_, &state_, reference, measurement);
    }
    float integral() const { return state_.integral; }

  private:
    hs_pid_config config_;
    hs_pid_state state_;
};

} // namespace

NB_MODULE(_core, m)
{
    m.doc() = "The C core shared with the microcontroller";
    m.def("demodulate", &demodulate);
    m.def("demodulate_blocks", &demodulate_blocks);
    m.def("demodulate_floats", &demodulate_floats);
    m.def("exp", &hs_exp);
    m.def("voltage_from_strain", [](float a1_v, float b1, float a2_v, float b2, float strain) {
        const hs_voltage_map map = {a1_v, b1, a2_v, b2};
        return hs_voltage_from_strain(&map, strain);
    });
    m.def("strain_from_capacitance",
          [](float slope_per_f, float offset, float curvature_per_f2, float capacitance_f) {
              const hs_strain_map map = {slope_per_f, offset, curvature_per_f2};
              return hs_strain_from_capacitance(&map, capacitance_f);
          });
    m.def("limit", [](float value, float low, float high) {
        uint8_t limited = 0;
        const float out = hs_limit(value, low, high, &limited);
        return std::make_tuple(out, limited != 0);
    });
    nb::class_<Impedance>(m, "Impedance")
        .def(nb::init<float, float, float, float>())
        .def("__call__", &Impedance::operator());
    nb::class_<Pid>(m, "Pid")
        .def(nb::init<float, float, float, float, float, float, float>(), nb::arg("kp"),
             nb::arg("ki"), nb::arg("kd"), nb::arg("period_s"), nb::arg("derivative_filter_s"),
             nb::arg("u_low"), nb::arg("u_high"))
        .def("reset", &Pid::reset)
        .def("step", &Pid::step)
        .def_prop_ro("integral", &Pid::integral);
}
