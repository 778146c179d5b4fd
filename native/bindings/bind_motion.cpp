// Python face of the motion of an actuator: haselab._motion.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

#include <algorithm>
#include <cstdint>
#include <stdexcept>
#include <vector>

#include "bindings/law.h"
#include "bindings/records.h"

extern "C" {
#include "motion/record.h"
}

namespace nb = nanobind;
using Tables = nb::ndarray<nb::numpy, const double, nb::ndim<3>, nb::c_contig, nb::device::cpu>;
using Flags = nb::ndarray<nb::numpy, const uint8_t, nb::ndim<1>, nb::c_contig, nb::device::cpu>;
using Kinds = nb::ndarray<nb::numpy, const int32_t, nb::ndim<1>, nb::c_contig, nb::device::cpu>;
using OutRow = nb::ndarray<nb::numpy, double, nb::ndim<1>, nb::c_contig, nb::device::cpu>;
using OutRows = nb::ndarray<nb::numpy, double, nb::ndim<2>, nb::c_contig, nb::device::cpu>;

namespace {

void need(bool is_so, const char *what)
{
    if (!is_so) {
        throw std::invalid_argument(what);
    }
}

class Law {
  public:
    Law(double low_m, double step_m, double step_v, Values elastic_n, Values gap_m,
        Rows capacitance_f, Rows pull_n_v2)
    {
        fill_law(law, low_m, step_m, step_v, elastic_n, gap_m, capacitance_f, pull_n_v2);
    }
    motion_law law{};
};

// Derivatives by `kind.size()` columns; the tables have one row for each parameter of the law. Those
// of the columns at hand are put side by side.
struct Tangent {
    Tangent(const Law &law, Kinds kind, Rows elastic, Tables pull, Tables capacitance,
            Values free_m)
        : work(static_cast<size_t>(MOTION_WORK) * kind.size()),
          kept(static_cast<size_t>(MOTION_ROWS) * 2 * kind.size())
    {
        const size_t laws = free_m.size(), n = static_cast<size_t>(law.law.lengths);
        const auto volts = static_cast<size_t>(law.law.voltages);
        need(elastic.shape(0) == laws && pull.shape(0) == laws && capacitance.shape(0) == laws &&
                 pull.shape(1) == volts && capacitance.shape(1) == volts &&
                 elastic.shape(1) == n && pull.shape(2) == n && capacitance.shape(2) == n,
             "one table of derivatives for each parameter of the law");
        std::vector<size_t> table;
        for (size_t j = 0; j < kind.size(); ++j) {
            if (kind.data()[j] < MOTION_START) {
                need(kind.data()[j] >= 0 && static_cast<size_t>(kind.data()[j]) < laws,
                     "one table of derivatives for each parameter of the law");
                table.push_back(static_cast<size_t>(kind.data()[j]));
                law_column.push_back(static_cast<int32_t>(j));
                free_length.push_back(free_m.data()[table.back()]);
            } else if (kind.data()[j] > MOTION_START) {
                other_column.push_back(static_cast<int32_t>(j));
            }
        }
        beside(elastic.data(), n, table, elastic_by);
        beside(pull.data(), n * volts, table, pull_by);
        beside(capacitance.data(), n * volts, table, capacitance_by);
        c.columns = static_cast<int32_t>(kind.size());
        c.laws = static_cast<int32_t>(table.size());
        c.kind = kind.data();
        c.law_column = law_column.data();
        c.others = static_cast<int32_t>(other_column.size());
        c.other_column = other_column.data();
        c.elastic = elastic_by.data();
        c.pull = pull_by.data();
        c.capacitance = capacitance_by.data();
        c.free_length = free_length.data();
        c.work = work.data();
    }
    static void beside(const double *rows, size_t knots, const std::vector<size_t> &table,
                       std::vector<double> &out)
    {
        out.resize(knots * table.size());
        for (size_t l = 0; l < table.size(); ++l) {
            for (size_t i = 0; i < knots; ++i) {
                out[i * table.size() + l] = rows[table[l] * knots + i];
            }
        }
    }
    std::vector<double> work, kept, elastic_by, pull_by, capacitance_by, free_length;
    std::vector<int32_t> law_column, other_column;
    motion_tangent c{};
};

void play(const Law &law, nb::handle parameters, nb::handle state, Values edge_s, nb::handle input,
          Values mass_kg, Flags sensed, Values time_s, OutRow length_m, OutRow speed_m_s,
          OutRow mean_f, OutRow drift_f_s, Kinds kind, Rows elastic, Tables pull, Tables capacitance, Values free_m,
          OutRows rows, OutRows length_by, OutRows mean_by)
{
    const Records<const motion_parameters> p(parameters);
    Records<motion_state> s(state);
    const Records<const motion_input> in(input);
    const size_t n = in.size(), columns = kind.size();
    need(p.size() == 1 && s.size() == 1 && n > 0 && edge_s.size() == n + 1 &&
             mass_kg.size() == n && sensed.size() == n && mean_f.size() == n &&
             drift_f_s.size() == n &&
             length_m.size() == time_s.size() && speed_m_s.size() == time_s.size() &&
             p.data()->step_s > 0.0 && p.data()->phase > 0.0,
         "one input, mass and mean for each interval; one length for each time");
    const motion_record record = {static_cast<int32_t>(n), edge_s.data(), in.data(),
                                  mass_kg.data(), sensed.data(),
                                  static_cast<int32_t>(time_s.size()), time_s.data()};
    motion_output output = {length_m.data(), speed_m_s.data(), mean_f.data(), drift_f_s.data(),
                            nullptr, nullptr, nullptr};
    if (columns == 0) {
        nb::gil_scoped_release free_gil;
        motion_play(&law.law, p.data(), s.data(), nullptr, &record, &output);
        return;
    }
    const auto wanted = static_cast<size_t>(
        std::count_if(sensed.data(), sensed.data() + n, [](uint8_t is) { return is != 0; }));
    need(rows.shape(0) == MOTION_ROWS && rows.shape(1) == columns &&
             length_by.shape(0) == time_s.size() && length_by.shape(1) == columns &&
             mean_by.shape(0) == wanted && mean_by.shape(1) == columns,
         "one column of derivatives for each kind");
    Tangent tangent(law, kind, elastic, pull, capacitance, free_m);
    tangent.c.rows = rows.data();
    output.length_by = length_by.data();
    output.mean_by = mean_by.data();
    output.kept = tangent.kept.data();
    nb::gil_scoped_release free_gil;
    motion_play(&law.law, p.data(), s.data(), &tangent.c, &record, &output);
}

} // namespace

NB_MODULE(_motion, m)
{
    nb::set_leak_warnings(false); // objects that exist until the interpreter ends are not leaks
    m.doc() = "Motion of an actuator that follows a law, with derivatives";
    m.attr("PARAMETERS") = dtype_of<motion_parameters>({
        FIELD(motion_parameters, free_length_m),
        FIELD(motion_parameters, softening_share),
        FIELD(motion_parameters, softening_stretch),
        FIELD(motion_parameters, softening_width),
        FIELD(motion_parameters, branch_share),
        FIELD(motion_parameters, branch_s),
        FIELD(motion_parameters, damping_n_s_m),
        FIELD(motion_parameters, inertia_kg),
        FIELD(motion_parameters, charge_share),
        FIELD(motion_parameters, charge_s),
        FIELD(motion_parameters, hysteresis_n),
        FIELD(motion_parameters, hysteresis_width),
        FIELD(motion_parameters, elastic_scale),
        FIELD(motion_parameters, elastic_drift),
        FIELD(motion_parameters, electric_drift),
        FIELD(motion_parameters, step_s),
        FIELD(motion_parameters, phase),
    });
    m.attr("STATE") = dtype_of<motion_state>({
        FIELD(motion_state, length_m),
        FIELD(motion_state, speed_m_s),
        FIELD(motion_state, relaxed_n),
        FIELD(motion_state, charge_v),
        FIELD(motion_state, longest_m),
        FIELD(motion_state, hysteresis_n),
    });
    m.attr("INPUT") = dtype_of<motion_input>({
        FIELD(motion_input, volt),
        FIELD(motion_input, ripple_v2),
        FIELD(motion_input, load_n),
    });
    m.attr("BRANCHES") = MOTION_BRANCHES;
    m.attr("ROWS") = static_cast<int>(MOTION_ROWS);
    m.attr("START") = static_cast<int>(MOTION_START);
    m.attr("DAMPING") = static_cast<int>(MOTION_DAMPING);
    m.attr("INERTIA") = static_cast<int>(MOTION_INERTIA);
    m.attr("SOFTENING_SHARE") = static_cast<int>(MOTION_SOFTENING_SHARE);
    m.attr("SOFTENING_STRETCH") = static_cast<int>(MOTION_SOFTENING_STRETCH);
    m.attr("SOFTENING_WIDTH") = static_cast<int>(MOTION_SOFTENING_WIDTH);
    m.attr("CHARGE_SHARE") = static_cast<int>(MOTION_CHARGE_SHARE);
    m.attr("CHARGE_S") = static_cast<int>(MOTION_CHARGE_S);
    m.attr("HYSTERESIS_N") = static_cast<int>(MOTION_HYSTERESIS_N);
    m.attr("HYSTERESIS_WIDTH") = static_cast<int>(MOTION_HYSTERESIS_WIDTH);
    m.attr("VOLTAGE_SCALE") = static_cast<int>(MOTION_VOLTAGE_SCALE);
    m.attr("ELASTIC_DRIFT") = static_cast<int>(MOTION_ELASTIC_DRIFT);
    m.attr("ELECTRIC_DRIFT") = static_cast<int>(MOTION_ELECTRIC_DRIFT);
    m.attr("BRANCH_SHARE") = static_cast<int>(MOTION_BRANCH_SHARE);
    m.attr("BRANCH_S") = static_cast<int>(MOTION_BRANCH_S);
    nb::class_<Law>(m, "Law").def(
        nb::init<double, double, double, Values, Values, Rows, Rows>());
    m.def("play", &play);
}
