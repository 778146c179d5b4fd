// Python face of core/: haselab._core. The numbers are those of the microcontroller.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/tuple.h>

#include <cstddef>
#include <cstdint>
#include <stdexcept>
#include <tuple>

#include "hs.h"

namespace nb = nanobind;

namespace {

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

using Codes = nb::ndarray<const int16_t, nb::shape<-1, 2>, nb::c_contig, nb::device::cpu>;
using Farads = nb::ndarray<float, nb::shape<-1>, nb::c_contig, nb::device::cpu>;
using Reasons = nb::ndarray<uint8_t, nb::shape<-1>, nb::c_contig, nb::device::cpu>;

/* Half a window further at each update; the caller gives one more than it wants updates. */
void capacitances_from_quadrature(const hs_quadrature_config &config, Codes codes, Farads farad,
                              Reasons reason)
{
    constexpr size_t half = HS_QUADRATURE_SAMPLES / 2;
    const size_t updates = farad.shape(0);
    if (reason.shape(0) != updates || codes.shape(0) != (updates + 1) * half) {
        throw std::invalid_argument("shapes of codes and results do not belong together");
    }
    for (size_t k = 0; k < updates; ++k) {
        int16_t v[HS_QUADRATURE_SAMPLES], i[HS_QUADRATURE_SAMPLES];
        for (size_t j = 0; j < HS_QUADRATURE_SAMPLES; ++j) {
            v[j] = codes(k * half + j, 0);
            i[j] = codes(k * half + j, 1);
        }
        const hs_capacitance found =
            hs_capacitance_of(&config, hs_demodulate_quadrature(v), hs_demodulate_quadrature(i));
        farad(k) = found.capacitance_f;
        reason(k) = found.reason;
    }
}

} // namespace

NB_MODULE(_core, m)
{
    nb::set_leak_warnings(false); // objects that exist until the interpreter ends are not leaks
    m.doc() = "The C core shared with the microcontroller";
    m.def("exp", &hs_exp);
    m.def("voltage_from_strain", [](float a1_v, float b1, float a2_v, float b2, float strain) {
        const hs_voltage_map map = {a1_v, b1, a2_v, b2};
        return hs_voltage_from_strain(&map, strain);
    });
    m.def("strain_from_capacitance",
          [](float slope_per_f, float offset, float curvature_per_f2, float cubic_per_f3,
             float capacitance_f) {
              const hs_strain_map map = {slope_per_f, offset, curvature_per_f2, cubic_per_f3};
              return hs_strain_from_capacitance(&map, capacitance_f);
          });
    m.def("limit", [](float value, float low, float high) {
        uint8_t limited = 0;
        const float out = hs_limit(value, low, high, &limited);
        return std::make_tuple(out, limited != 0);
    });
    m.def("capacitances_from_quadrature",
          [](float turn_re, float turn_im, int32_t v_low, int32_t v_high, int32_t i_low, Codes codes,
             Farads farad, Reasons reason) {
              capacitances_from_quadrature({turn_re, turn_im, v_low, v_high, i_low}, codes, farad,
                                       reason);
          });
    nb::class_<Pid>(m, "Pid")
        .def(nb::init<float, float, float, float, float, float, float>(), nb::arg("kp"),
             nb::arg("ki"), nb::arg("kd"), nb::arg("period_s"), nb::arg("derivative_filter_s"),
             nb::arg("u_low"), nb::arg("u_high"))
        .def("reset", &Pid::reset)
        .def("step", &Pid::step)
        .def_prop_ro("integral", &Pid::integral);
}
