// Python face of the twin's stepping: haselab._twin.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/tuple.h>
#include <nanobind/stl/vector.h>

#include <cstdint>
#include <cstdlib>
#include <cstring>
#include <memory>
#include <new>
#include <stdexcept>
#include <tuple>
#include <utility>
#include <vector>

#include "bindings/law.h"
#include "bindings/records.h"

extern "C" {
#include "twin/twin.h"
}

namespace nb = nanobind;
using Codes = nb::ndarray<nb::numpy, int16_t, nb::shape<-1, 2>, nb::c_contig, nb::device::cpu>;
using Lengths = nb::ndarray<nb::numpy, double, nb::ndim<1>, nb::c_contig, nb::device::cpu>;
using Indices = nb::ndarray<const int64_t, nb::ndim<1>, nb::c_contig, nb::device::cpu>;
namespace {

struct Value {
    const char *name;
    double twin_parameters::*member;
};

const Value kValues[] = {
    {"series_ohm", &twin_parameters::series_ohm},
    {"leakage_ohm", &twin_parameters::leakage_ohm},
    {"breakdown_v_m", &twin_parameters::breakdown_v_m},
    {"carrier_v", &twin_parameters::carrier_v},
    {"carrier_rad_s", &twin_parameters::carrier_rad_s},
    {"gain", &twin_parameters::gain},
    {"amplifier_rad_s", &twin_parameters::amplifier_rad_s},
    {"amplifier_damping", &twin_parameters::amplifier_damping},
    {"slew_v_s", &twin_parameters::slew_v_s},
    {"current_limit_a", &twin_parameters::current_limit_a},
    {"stray_f", &twin_parameters::stray_f},
    {"v_monitor", &twin_parameters::v_monitor},
    {"i_monitor", &twin_parameters::i_monitor},
    {"v_monitor_lag_s", &twin_parameters::v_monitor_lag_s},
    {"i_monitor_lag_s", &twin_parameters::i_monitor_lag_s},
    {"v_offset_v", &twin_parameters::v_offset_v},
    {"i_offset_v", &twin_parameters::i_offset_v},
    {"sample_s", &twin_parameters::sample_s},
    {"skew_s", &twin_parameters::skew_s},
    {"lsb_v", &twin_parameters::lsb_v},
    {"top_code", &twin_parameters::top_code},
    {"v_noise_v", &twin_parameters::v_noise_v},
    {"i_noise_v", &twin_parameters::i_noise_v},
    {"capacitance_rise", &twin_parameters::capacitance_rise},
    {"warming_s", &twin_parameters::warming_s},
    {"stiffness_loss", &twin_parameters::stiffness_loss},
    {"ageing_s", &twin_parameters::ageing_s},
    {"begins_s", &twin_parameters::begins_s},
    {"second_kg", &twin_parameters::second_kg},
    {"second_rad_s", &twin_parameters::second_rad_s},
    {"second_damping", &twin_parameters::second_damping},
};

class Bench {
  public:
    Bench(const nb::dict &values, nb::handle motion, double length_m, uint64_t seed, double low_m,
          double step_m, double step_v, Values elastic_n, Values gap_m, Rows capacitance_f,
          Rows pull_n_v2)
        : memory_(zeroed()), p_(*memory_)
    {
        const Records<const motion_parameters> moving(motion);
        std::memset(&s_, 0, sizeof s_);
        for (const Value &value : kValues) {
            p_.*(value.member) = nb::cast<double>(values[value.name]);
        }
        if (moving.size() != 1 || !(moving.data()->step_s > 0.0)) {
            throw std::invalid_argument("one set of parameters of the motion, with a step");
        }
        p_.motion = *moving.data();
        fill_law(p_.law, low_m, step_m, step_v, elastic_n, gap_m, capacitance_f, pull_n_v2);
        twin_prepare(&p_);
        twin_seed(&s_, seed);
        motion_rest(&p_.law, &p_.motion, &s_.motion, length_m, length_m);
    }

    void acquire(double before_v, double after_v, int32_t switch_at, double load_n, Codes codes,
                 Lengths lengths)
    {
        const auto n = static_cast<int32_t>(codes.shape(0));
        if (n % TWIN_SUB != 0 || static_cast<int32_t>(lengths.shape(0)) != n / TWIN_SUB) {
            throw std::invalid_argument("samples must be a multiple of 20, lengths a 20th of them");
        }
        nb::gil_scoped_release free_gil;
        twin_acquire(&p_, &s_, before_v, after_v, switch_at, load_n, n, codes.data(),
                     lengths.data());
    }

    void move(Values drive_v, int32_t steps_per_value, double load_n, Lengths lengths)
    {
        if (drive_v.size() == 0 || steps_per_value < 1) {
            throw std::invalid_argument("at least one drive value and one step for each");
        }
        nb::gil_scoped_release free_gil;
        twin_move(&p_, &s_, drive_v.data(), static_cast<int32_t>(drive_v.size()), steps_per_value,
                  load_n, static_cast<int32_t>(lengths.shape(0)), lengths.data());
    }

    // timing: steps, switch_at, first, last of twin_update
    double update(double before_v, double after_v, double load_n,
                  std::tuple<int32_t, int32_t, int32_t, int32_t> timing, Lengths lengths,
                  int32_t at)
    {
        const auto [steps, switch_at, first, last] = timing;
        if (steps < 1 || switch_at < 0 || switch_at > steps || last > steps || first >= last ||
            at + first < 1 || at + steps > static_cast<int32_t>(lengths.shape(0))) {
            throw std::invalid_argument("an update within the lengths, and a window within it");
        }
        const twin_update_input in = {before_v, after_v, load_n, steps, switch_at, first, last};
        return twin_update(&p_, &s_, &in, lengths.data(), at);
    }

    void connect(double farad, double series_ohm) { twin_connect(&s_, farad, series_ohm); }

    double elastic_force(double length_m) const
    {
        return motion_elastic(&p_.law, length_m) *
               motion_softening(&p_.motion, s_.motion.longest_m);
    }
    double capacitance(double length_m, double voltage_v) const
    {
        return motion_capacitance(&p_.law, length_m, voltage_v);
    }
    double gap(double length_m) const { return motion_gap(&p_.law, length_m); }

    // Pages of the law's table that no voltage of this law needs stay without memory.
    struct Free {
        void operator()(void *memory) const { std::free(memory); }
    };
    static twin_parameters *zeroed()
    {
        void *memory = std::calloc(1, sizeof(twin_parameters));
        if (memory == nullptr) {
            throw std::bad_alloc();
        }
        return static_cast<twin_parameters *>(memory);
    }
    std::unique_ptr<twin_parameters, Free> memory_;
    twin_parameters &p_;
    twin_state s_;
};

// Many devices that move one update further in one call. Each slot has a state of its own; slots of
// the same bench share its parameters. The benches are kept and not changed.
class Ensemble {
  public:
    // switch_at: of each bench; window: steps, first and last of twin_update
    Ensemble(std::vector<const Bench *> benches, std::vector<int32_t> switch_at, int32_t slots,
             std::tuple<int32_t, int32_t, int32_t> window)
        : benches_(std::move(benches)), switch_at_(std::move(switch_at)), window_(window)
    {
        const auto [steps, first, last] = window_;
        if (benches_.empty() || switch_at_.size() != benches_.size() || slots < 1 || steps < 1 ||
            last > steps || first >= last || first < -1000) {
            throw std::invalid_argument("a bench, a slot, and a window that ends in its update");
        }
        for (const int32_t at : switch_at_) {
            if (at < 0 || at > steps) {
                throw std::invalid_argument("an output that changes within its update");
            }
        }
        lead_ = first < 1 ? 1 - first : 1;
        states_.resize(static_cast<size_t>(slots));
        owner_.assign(static_cast<size_t>(slots), 0);
        lengths_.resize(static_cast<size_t>(slots) * static_cast<size_t>(lead_ + steps));
        for (size_t k = 0; k < states_.size(); ++k) {
            restart(k, 0);
        }
    }

    // Puts devices into slots, in the states that their benches have now.
    void reset(Indices slots, Indices benches)
    {
        if (slots.size() != benches.size()) {
            throw std::invalid_argument("as many benches as slots");
        }
        for (size_t k = 0; k < slots.size(); ++k) {
            const auto slot = static_cast<size_t>(slots.data()[k]);
            const auto bench = static_cast<size_t>(benches.data()[k]);
            if (slot >= states_.size() || bench >= benches_.size()) {
                throw std::invalid_argument("a slot or a bench that does not exist");
            }
            restart(slot, bench);
        }
    }

    // One update of every slot. Writes the mean capacitances and the lengths at the end.
    void update(Values before_v, Values after_v, Values load_n, Lengths capacitances_f,
                Lengths lengths_m)
    {
        const size_t n = states_.size();
        if (before_v.size() != n || after_v.size() != n || load_n.size() != n ||
            capacitances_f.size() != n || lengths_m.size() != n) {
            throw std::invalid_argument("one value for each slot");
        }
        const auto [steps, first, last] = window_;
        const auto lead = static_cast<size_t>(lead_);
        const size_t row = lead + static_cast<size_t>(steps);
        nb::gil_scoped_release free_gil;
        for (size_t k = 0; k < n; ++k) {
            const twin_update_input in = {before_v.data()[k], after_v.data()[k], load_n.data()[k],
                                          steps, switch_at_[owner_[k]], first, last};
            double *lengths = lengths_.data() + k * row;
            capacitances_f.data()[k] =
                twin_update(&benches_[owner_[k]]->p_, &states_[k], &in, lengths, lead_);
            lengths_m.data()[k] = lengths[row - 1];
            std::memmove(lengths, lengths + row - lead, lead * sizeof *lengths);
        }
    }

    // 0: works; 1: broken down; 2: left the lengths in which the law is valid.
    int32_t fault(size_t slot) const
    {
        const twin_state &state = states_.at(slot);
        return state.outside != 0 ? 2 : state.broken != 0;
    }

    // Whether any slot no longer works.
    bool any_fault() const
    {
        for (const twin_state &state : states_) {
            if (state.broken != 0) {
                return true;
            }
        }
        return false;
    }

  private:
    void restart(size_t slot, size_t bench)
    {
        const auto lead = static_cast<size_t>(lead_);
        const size_t row = lead + static_cast<size_t>(std::get<0>(window_));
        owner_[slot] = bench;
        states_[slot] = benches_[bench]->s_;
        for (size_t k = 0; k < lead; ++k) {
            lengths_[slot * row + k] = states_[slot].motion.length_m;
        }
    }

    std::vector<const Bench *> benches_;
    std::vector<int32_t> switch_at_;
    std::tuple<int32_t, int32_t, int32_t> window_;
    int32_t lead_ = 1;
    std::vector<twin_state> states_;
    std::vector<size_t> owner_;
    std::vector<double> lengths_;
};

} // namespace

NB_MODULE(_twin, m)
{
    nb::set_leak_warnings(false); // objects that exist until the interpreter ends are not leaks
    m.doc() = "Stepping of the simulated bench";
    // Where numbers lie in twin_parameters, by the names of their values; motion: its record.
    nb::dict offsets;
    const twin_parameters *none = nullptr;
    for (const Value &value : kValues) {
        offsets[value.name] = reinterpret_cast<uintptr_t>(&(none->*(value.member)));
    }
    offsets["motion"] = offsetof(twin_parameters, motion);
    m.attr("OFFSETS") = offsets;
    m.attr("SIZES") = std::make_tuple(sizeof(twin_parameters), sizeof(twin_state));
    nb::class_<Ensemble>(m, "Ensemble")
        .def(nb::init<std::vector<const Bench *>, std::vector<int32_t>, int32_t,
                      std::tuple<int32_t, int32_t, int32_t>>(),
             nb::keep_alive<1, 2>()) // the list, and with it the benches
        .def("reset", &Ensemble::reset)
        .def("update", &Ensemble::update)
        .def("fault", &Ensemble::fault)
        .def_prop_ro("any_fault", &Ensemble::any_fault);
    nb::class_<Bench>(m, "Bench")
        .def(nb::init<const nb::dict &, nb::handle, double, uint64_t, double, double, double, Values,
                      Values, Rows, Rows>())
        .def("acquire", &Bench::acquire)
        .def("move", &Bench::move)
        .def("update", &Bench::update)
        .def("connect", &Bench::connect)
        .def("elastic_force", &Bench::elastic_force)
        .def("capacitance", &Bench::capacitance, nb::arg("length_m"), nb::arg("voltage_v") = 0.0)
        .def("gap", &Bench::gap)
        .def_prop_rw(
            "inertia_kg", [](const Bench &b) { return b.p_.motion.inertia_kg; },
            [](Bench &b, double kg) { b.p_.motion.inertia_kg = kg; })
        .def_prop_rw(
            "carrier_v", [](const Bench &b) { return b.p_.carrier_v; },
            [](Bench &b, double volt) { b.p_.carrier_v = volt; })
        .def_prop_rw(
            "carrier_rad_s", [](const Bench &b) { return b.p_.carrier_rad_s; },
            [](Bench &b, double value) { b.p_.carrier_rad_s = value; })
        // Where parameters and state lie, for the co-simulation: twin.h says what is there.
        .def_prop_ro("addresses",
                     [](Bench &b) {
                         return std::make_tuple(reinterpret_cast<uintptr_t>(&b.p_),
                                                reinterpret_cast<uintptr_t>(&b.s_));
                     })
        .def_prop_ro("length_m", [](const Bench &b) { return b.s_.motion.length_m; })
        .def_prop_ro("time_s", [](const Bench &b) { return b.s_.time_s; })
        .def_prop_ro("output_v", [](const Bench &b) { return b.s_.amp_v; })
        .def_prop_ro("field_v_m", [](const Bench &b) { return b.s_.field_v_m; })
        .def_prop_ro("broken", [](const Bench &b) { return b.s_.broken != 0; })
        .def_prop_ro("outside", [](const Bench &b) { return b.s_.outside != 0; })
        .def_prop_ro("limited_samples", [](const Bench &b) { return b.s_.limited; });
}
