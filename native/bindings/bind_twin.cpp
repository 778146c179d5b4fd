// Python face of the twin's stepping: haselab._twin.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/tuple.h>

#include <cstdint>
#include <cstring>
#include <stdexcept>
#include <tuple>

extern "C" {
#include "twin/twin.h"
}

namespace nb = nanobind;
using Codes = nb::ndarray<nb::numpy, int16_t, nb::shape<-1, 2>, nb::c_contig, nb::device::cpu>;
using Lengths = nb::ndarray<nb::numpy, double, nb::ndim<1>, nb::c_contig, nb::device::cpu>;
using Rows = nb::ndarray<nb::numpy, const double, nb::ndim<2>, nb::c_contig, nb::device::cpu>;
using Values = nb::ndarray<nb::numpy, const double, nb::ndim<1>, nb::c_contig, nb::device::cpu>;

namespace {

struct Field {
    const char *name;
    double twin_parameters::*member;
};

const Field kFields[] = {
    {"area_m2", &twin_parameters::area_m2},
    {"length_m", &twin_parameters::length_m},
    {"lateral_stretch", &twin_parameters::lateral_stretch},
    {"free_length_m", &twin_parameters::free_length_m},
    {"electrode_n_m", &twin_parameters::electrode_n_m},
    {"electrode_cubic", &twin_parameters::electrode_cubic},
    {"mullins", &twin_parameters::mullins},
    {"mullins_stretch", &twin_parameters::mullins_stretch},
    {"mullins_width", &twin_parameters::mullins_width},
    {"damping_n_s_m", &twin_parameters::damping_n_s_m},
    {"inertia_kg", &twin_parameters::inertia_kg},
    {"capacitance_f", &twin_parameters::capacitance_f},
    {"capacitance_exponent", &twin_parameters::capacitance_exponent},
    {"thickness_m", &twin_parameters::thickness_m},
    {"series_ohm", &twin_parameters::series_ohm},
    {"leakage_ohm", &twin_parameters::leakage_ohm},
    {"relaxation_share", &twin_parameters::relaxation_share},
    {"relaxation_s", &twin_parameters::relaxation_s},
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
    {"v_noise_v", &twin_parameters::v_noise_v},
    {"i_noise_v", &twin_parameters::i_noise_v},
};

class Bench {
  public:
    Bench(const nb::dict &values, Values ab, Values prony_g, Values prony_s, double length_m,
          uint64_t seed)
    {
        std::memset(&p_, 0, sizeof p_);
        std::memset(&s_, 0, sizeof s_);
        for (const Field &field : kFields) {
            p_.*(field.member) = nb::cast<double>(values[field.name]);
        }
        if (ab.size() != 5 || prony_g.size() > TWIN_BRANCHES || prony_g.size() != prony_s.size()) {
            throw std::invalid_argument("five Arruda-Boyce coefficients, at most four branches");
        }
        std::memcpy(p_.ab, ab.data(), sizeof p_.ab);
        for (size_t k = 0; k < prony_g.size(); ++k) {
            p_.prony_g[k] = prony_g.data()[k];
            p_.prony_s[k] = prony_s.data()[k];
        }
        twin_prepare(&p_);
        twin_seed(&s_, seed);
        s_.length_m = length_m;
        s_.longest_m = length_m;
        s_.elastic_n = twin_elastic_force(&p_, length_m, length_m);
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

    // A law on a grid instead of the built-in one; rows are voltages, columns lengths.
    void set_law(double low_m, double step_m, double step_v, int32_t substeps, Values elastic_n,
                 Values gap_m, Rows capacitance_f, Rows pull_n_v2)
    {
        const size_t n = elastic_n.size(), rows = capacitance_f.shape(0);
        if (n < 4 || n > TWIN_LENGTHS || gap_m.size() != n || capacitance_f.shape(1) != n ||
            pull_n_v2.shape(1) != n || pull_n_v2.shape(0) != rows || rows > TWIN_VOLTAGES ||
            (rows != 1 && rows < 4) || substeps < 1 || !(step_m > 0.0) || !(step_v > 0.0)) {
            throw std::invalid_argument("4 to 1024 lengths, 1 or 4 to 9 voltages, one grid");
        }
        twin_table &t = p_.law;
        t.lengths = static_cast<int32_t>(n);
        t.voltages = static_cast<int32_t>(rows);
        t.substeps = substeps;
        t.low_m = low_m;
        t.step_m = step_m;
        t.step_v = step_v;
        std::memcpy(t.elastic_n, elastic_n.data(), n * sizeof(double));
        std::memcpy(t.gap_m, gap_m.data(), n * sizeof(double));
        for (size_t k = 0; k < rows; ++k) {
            std::memcpy(t.capacitance_f[k], capacitance_f.data() + k * n, n * sizeof(double));
            std::memcpy(t.pull_n_v2[k], pull_n_v2.data() + k * n, n * sizeof(double));
        }
        s_.elastic_n = twin_elastic_force(&p_, s_.length_m, s_.longest_m);
    }

    void connect(double farad, double series_ohm) { twin_connect(&s_, farad, series_ohm); }

    double elastic_force(double length_m) const
    {
        return twin_elastic_force(&p_, length_m, s_.longest_m);
    }
    double capacitance(double length_m, double voltage_v) const
    {
        return twin_capacitance(&p_, length_m, voltage_v);
    }
    double gap(double length_m) const { return twin_gap(&p_, length_m); }

    twin_parameters p_;
    twin_state s_;
};

} // namespace

NB_MODULE(_twin, m)
{
    nb::set_leak_warnings(false); // objects that exist until the interpreter ends are not leaks
    m.doc() = "Stepping of the simulated bench";
    nb::class_<Bench>(m, "Bench")
        .def(nb::init<const nb::dict &, Values, Values, Values, double, uint64_t>())
        .def("acquire", &Bench::acquire)
        .def("move", &Bench::move)
        .def("connect", &Bench::connect)
        .def("elastic_force", &Bench::elastic_force)
        .def("capacitance", &Bench::capacitance, nb::arg("length_m"), nb::arg("voltage_v") = 0.0)
        .def("gap", &Bench::gap)
        .def("set_law", &Bench::set_law)
        .def_prop_rw(
            "inertia_kg", [](const Bench &b) { return b.p_.inertia_kg; },
            [](Bench &b, double kg) { b.p_.inertia_kg = kg; })
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
        .def_prop_ro("length_m", [](const Bench &b) { return b.s_.length_m; })
        .def_prop_ro("time_s", [](const Bench &b) { return b.s_.time_s; })
        .def_prop_ro("output_v", [](const Bench &b) { return b.s_.amp_v; })
        .def_prop_ro("field_v_m", [](const Bench &b) { return b.s_.field_v_m; })
        .def_prop_ro("broken", [](const Bench &b) { return b.s_.broken != 0; })
        .def_prop_ro("outside", [](const Bench &b) { return b.s_.outside != 0; })
        .def_prop_ro("limited_samples", [](const Bench &b) { return b.s_.limited; });
}
