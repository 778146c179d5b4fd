// Python face of core/: haselab._core. The numbers are those of the microcontroller.
#include <nanobind/nanobind.h>
#include <nanobind/stl/tuple.h>

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

} // namespace

NB_MODULE(_core, m)
{
    nb::set_leak_warnings(false); // objects that live to the end of the interpreter are no fault
    m.doc() = "The C core shared with the microcontroller";
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
    nb::class_<Pid>(m, "Pid")
        .def(nb::init<float, float, float, float, float, float, float>(), nb::arg("kp"),
             nb::arg("ki"), nb::arg("kd"), nb::arg("period_s"), nb::arg("derivative_filter_s"),
             nb::arg("u_low"), nb::arg("u_high"))
        .def("reset", &Pid::reset)
        .def("step", &Pid::step)
        .def_prop_ro("integral", &Pid::integral);
}
