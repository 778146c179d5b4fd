// Python face of core/: haselab._core. The numbers are those of the microcontroller.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/tuple.h>

#include <cstddef>
#include <cstdint>
#include <stdexcept>
#include <tuple>

#include "hs.h"
#include "hs_motion.h"
#include "records.h"

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

// A controller of the motion: its configuration, of which a copy is kept, and its state.
template <class Config, class Gains, class State, void (*init)(State *),
          float (*update)(const Config *, State *, float, float, float, uint8_t)>
class Motion {
  public:
    Motion(nb::handle motion, nb::handle gains)
    {
        const Records<const hs_motion_config> tables(motion);
        const Records<const Gains> own(gains);
        if (tables.size() != 1 || own.size() != 1) {
            throw std::invalid_argument("one record of each kind is needed");
        }
        config_.motion = *tables.data();
        config_.gains = *own.data();
        init(&state_);
    }
    float step(float reference, float strain, float voltage_v, bool valid)
    {
        return update(&config_, &state_, reference, strain, voltage_v, valid ? 1 : 0);
    }
    const State &state() const { return state_; }

  private:
    Config config_{};
    State state_{};
};

using Force = Motion<hs_force_config, hs_force_gains, hs_force_state, hs_force_init, hs_force_step>;
using Observer = Motion<hs_observer_config, hs_observer_gains, hs_observer_state, hs_observer_init,
                        hs_observer_step>;

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
    m.attr("MOTION") = dtype_of<hs_motion_config>(
        {FIELD(hs_motion_config, low), FIELD(hs_motion_config, per_strain),
         FIELD(hs_motion_config, per_volt), FIELD(hs_motion_config, volt),
         FIELD(hs_motion_config, carrier), FIELD(hs_motion_config, carrier_w),
         FIELD(hs_motion_config, most),
         FIELD(hs_motion_config, rest), FIELD(hs_motion_config, push),
         FIELD(hs_motion_config, inverse), FIELD(hs_motion_config, highest),
         FIELD(hs_motion_config, move), FIELD(hs_motion_config, branch_share),
         FIELD(hs_motion_config, branch_gain), FIELD(hs_motion_config, branch_slow),
         FIELD(hs_motion_config, drag), FIELD(hs_motion_config, lowest),
         FIELD(hs_motion_config, rise), FIELD(hs_motion_config, root_unit),
         FIELD(hs_motion_config, root_shift), FIELD(hs_motion_config, branches),
         FIELD(hs_motion_config, shift)});
    m.attr("FORCE") = dtype_of<hs_force_gains>(
        {FIELD(hs_force_gains, kp), FIELD(hs_force_gains, kd), FIELD(hs_force_gains, ki),
         FIELD(hs_force_gains, lag), FIELD(hs_force_gains, lag_square),
         FIELD(hs_force_gains, filter)});
    m.attr("OBSERVER") = dtype_of<hs_observer_gains>(
        {FIELD(hs_observer_gains, kp), FIELD(hs_observer_gains, kd), FIELD(hs_observer_gains, lag),
         FIELD(hs_observer_gains, lag_square), FIELD(hs_observer_gains, gain_x),
         FIELD(hs_observer_gains, gain_v), FIELD(hs_observer_gains, gain_load)});
    nb::class_<Force>(m, "Force")
        .def(nb::init<nb::handle, nb::handle>(), nb::arg("motion"), nb::arg("gains"))
        .def("step", &Force::step);
    nb::class_<Observer>(m, "Observer")
        .def(nb::init<nb::handle, nb::handle>(), nb::arg("motion"), nb::arg("gains"))
        .def("step", &Observer::step)
        .def_prop_ro("load", [](const Observer &o) { return o.state().load; });
}
