// Python face of native/loops/realtime.c with the twin as its plant: haselab._realtime.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/tuple.h>

#include <array>
#include <cstring>
#include <stdexcept>
#include <string>
#include <tuple>
#include <vector>

extern "C" {
#include "loops/realtime.h"
#include "twin/realtime_twin.h"
}

namespace nb = nanobind;
using Floats = nb::ndarray<nb::numpy, const float, nb::ndim<1>, nb::c_contig, nb::device::cpu>;
using Block =
    nb::ndarray<nb::numpy, const int16_t, nb::shape<-1, 2>, nb::c_contig, nb::device::cpu>;
using CodesOut =
    nb::ndarray<nb::numpy, int16_t, nb::shape<-1, -1, 2>, nb::c_contig, nb::device::cpu>;
using RowsOut = nb::ndarray<nb::numpy, double, nb::ndim<2>, nb::c_contig, nb::device::cpu>;

namespace {

static_assert(sizeof(rt_row) == 6 * sizeof(double), "a row of numbers");

template <size_t N> std::array<float, N> numbers(const Floats &from, const char *what)
{
    std::array<float, N> to{};
    if (from.size() != N) {
        throw std::invalid_argument(std::string(what) + " has the wrong size");
    }
    std::memcpy(to.data(), from.data(), sizeof to);
    return to;
}

// The loop's body with its tables.
class Control {
  public:
    Control(uint32_t samples, uint32_t first, Floats cosine, Floats sine, Floats inverse,
            Floats impedance, Floats strain_map, Floats pid, Floats voltage_map, Floats limits,
            int full_scale)
        : cosine_(cosine.data(), cosine.data() + cosine.size()),
          sine_(sine.data(), sine.data() + sine.size())
    {
        const auto count = static_cast<uint32_t>(cosine_.size());
        if (count < 8 || sine_.size() != count || first + count > samples ||
            samples > RT_MOST_SAMPLES) {
            throw std::invalid_argument("tables do not fit the block");
        }
        const auto z = numbers<6>(impedance, "impedance");
        const auto m = numbers<3>(strain_map, "strain_map");
        const auto p = numbers<7>(pid, "pid");
        const auto v = numbers<4>(voltage_map, "voltage_map");
        const auto l = numbers<2>(limits, "limits");
        const auto i = numbers<8>(inverse, "inverse");
        control_ = {samples, first, count, cosine_.data(), sine_.data(), {},
                    {z[0], z[1], z[2], z[3], z[4], z[5]},
                    {m[0], m[1], m[2], 0.0f},
                    {p[0], p[1], p[2], p[3], p[3] / (p[3] + p[4]), p[5], p[6]},
                    {v[0], v[1], v[2], v[3]}, l[0], l[1], static_cast<int16_t>(full_scale)};
        std::memcpy(control_.inverse, i.data(), sizeof control_.inverse);
        reset();
    }
    Control(const Control &) = delete;
    Control &operator=(const Control &) = delete;

    void reset()
    {
        hs_pid_init(&state_.pid, 0.0f);
        state_.output_v = hs_voltage_from_strain(&control_.voltage_map, 0.0f);
    }
    std::tuple<float, float, float, unsigned> step(Block codes, float reference)
    {
        if (codes.shape(0) != control_.samples) {
            throw std::invalid_argument("a step needs one whole block, voltage and current");
        }
        const rt_result r = rt_step(&control_, &state_, codes.data(), reference);
        return {r.output_v, r.strain, r.capacitance_f, r.reason};
    }
    const rt_control &get() const { return control_; }

  private:
    std::vector<float> cosine_, sine_;
    rt_control control_{};
    rt_state state_{};
};

class Loop {
  public:
    Loop(const Control &control, uintptr_t parameters, uintptr_t state, double load_n,
         int switch_sample, Floats reference, size_t slots, uint32_t patience,
         uint32_t patience_missed, int priority, int64_t spin_ns)
        : reference_(reference.data(), reference.data() + reference.size()), rows_(slots),
          codes_(slots * 2 * control.get().samples)
    {
        const auto samples = static_cast<int32_t>(control.get().samples);
        if (samples % TWIN_SUB != 0 || slots == 0 || switch_sample < 0 || switch_sample > samples ||
            patience == 0 || patience_missed == 0) {
            throw std::invalid_argument("blocks of a multiple of 20 samples, counts above 0");
        }
        const auto *p = reinterpret_cast<const twin_parameters *>(parameters);
        twin_.parameters = p;
        twin_.state = reinterpret_cast<twin_state *>(state);
        twin_.load_n = load_n;
        twin_.samples = samples;
        twin_.switch_sample = switch_sample;
        loop_.control = &control.get();
        loop_.plant = rt_plant_of_twin(&twin_);
        loop_.period_ns = static_cast<int64_t>(p->sample_s * samples * 1e9 + 0.5);
        loop_.late_ns = static_cast<int64_t>(p->sample_s * switch_sample * 1e9 + 0.5);
        loop_.patience = patience;
        loop_.patience_missed = patience_missed;
        loop_.priority = priority;
        loop_.spin_ns = spin_ns;
        loop_.reference = reference_.data();
        loop_.n_ticks = reference_.size();
        loop_.rows = rows_.data();
        loop_.codes = codes_.data();
        loop_.slots = slots;
    }
    Loop(const Loop &) = delete;
    Loop &operator=(const Loop &) = delete;
    ~Loop() { end(); }

    void start()
    {
        end();
        const int error = rt_start(&loop_);
        if (error != 0) {
            throw std::runtime_error(std::strerror(error));
        }
        started_ = true;
    }
    void stop() { rt_stop(&loop_); }
    void join()
    {
        nb::gil_scoped_release free_gil;
        if (started_) {
            rt_join(&loop_);
            started_ = false;
        }
    }
    int outcome() const { return rt_outcome(&loop_); }
    // Copies the blocks that wait, at most as many as there is room for.
    size_t take(CodesOut codes, RowsOut rows)
    {
        const size_t block = 2 * loop_.control->samples;
        if (codes.shape(1) * 2 != block || rows.shape(1) != 6 || rows.shape(0) != codes.shape(0)) {
            throw std::invalid_argument("no room for whole blocks");
        }
        size_t first, count = rt_available(&loop_, &first);
        count = count < rows.shape(0) ? count : rows.shape(0);
        for (size_t k = 0; k < count; ++k) {
            const size_t slot = (first + k) % loop_.slots;
            std::memcpy(codes.data() + k * block, loop_.codes + slot * block,
                        block * sizeof(int16_t));
            std::memcpy(rows.data() + k * 6, loop_.rows + slot, sizeof(rt_row));
        }
        rt_release(&loop_, count);
        return count;
    }
    nb::dict counts() const
    {
        const rt_counts &n = loop_.counts;
        nb::dict d;
        d["ticks"] = n.ticks;
        d["late"] = n.late;
        d["missed"] = n.missed;
        d["blind"] = n.blind;
        d["most_missed"] = n.most_missed;
        d["longest_ns"] = n.longest_ns;
        d["has_priority"] = loop_.has_priority != 0;
        return d;
    }
    void histogram(bool of_work, RowsOut out) const
    {
        if (out.size() != RT_BINS) {
            throw std::invalid_argument("the histogram has another size");
        }
        const uint64_t *bins = of_work ? loop_.counts.work : loop_.counts.latency;
        for (size_t k = 0; k < RT_BINS; ++k) {
            out.data()[k] = static_cast<double>(bins[k]);
        }
    }

  private:
    void end()
    {
        if (started_) {
            rt_stop(&loop_);
            join();
        }
    }

    std::vector<float> reference_;
    std::vector<rt_row> rows_;
    std::vector<int16_t> codes_;
    rt_twin twin_{};
    rt_loop loop_{};
    bool started_ = false;
};

} // namespace

NB_MODULE(_realtime, m)
{
    nb::set_leak_warnings(false); // objects that live to the end of the interpreter are no fault
    m.doc() = "The closed loop in a thread of its own";
    m.attr("BINS") = RT_BINS;
    m.attr("BIN_NS") = RT_BIN_NS;
    nb::class_<Control>(m, "Control")
        .def(nb::init<uint32_t, uint32_t, Floats, Floats, Floats, Floats, Floats, Floats, Floats,
                      Floats, int>(),
             nb::kw_only(), nb::arg("samples"), nb::arg("first"), nb::arg("cosine"),
             nb::arg("sine"), nb::arg("inverse"), nb::arg("impedance"), nb::arg("strain_map"),
             nb::arg("pid"), nb::arg("voltage_map"), nb::arg("limits"), nb::arg("full_scale"))
        .def("reset", &Control::reset)
        .def("step", &Control::step);
    // Ticks missed, and the longest latency in ns, of a thread that does nothing.
    m.def(
        "idle",
        [](int64_t period_ns, size_t n_ticks, int priority) {
            rt_counts counts{};
            int error;
            {
                nb::gil_scoped_release free_gil;
                error = rt_idle(period_ns, n_ticks, priority, &counts);
            }
            if (error != 0) {
                throw std::runtime_error(std::strerror(error));
            }
            return std::make_tuple(counts.missed, counts.longest_ns);
        },
        nb::arg("period_ns"), nb::arg("n_ticks"), nb::arg("priority"));
    // The bench's parameters and state are used where they lie: the bench is kept alive by `bench`.
    nb::class_<Loop>(m, "Loop")
        .def(nb::init<const Control &, uintptr_t, uintptr_t, double, int, Floats, size_t, uint32_t,
                      uint32_t, int, int64_t>(),
             nb::arg("control"), nb::arg("parameters"), nb::arg("state"), nb::arg("load_n"),
             nb::arg("switch_sample"), nb::arg("reference"), nb::arg("slots"), nb::arg("patience"),
             nb::arg("patience_missed"), nb::arg("priority"), nb::arg("spin_ns"),
             nb::keep_alive<1, 2>())
        .def("start", &Loop::start)
        .def("stop", &Loop::stop)
        .def("join", &Loop::join)
        .def("take", &Loop::take)
        .def("counts", &Loop::counts)
        .def("histogram", &Loop::histogram)
        .def_prop_ro("outcome", &Loop::outcome);
}
