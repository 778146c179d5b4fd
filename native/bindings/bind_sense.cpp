// Python face of native/sensing/sense.c and native/sensing/paper.c: haselab._sense.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/tuple.h>
#include <nanobind/stl/vector.h>

#include <algorithm>
#include <cmath>
#include <cstring>
#include <stdexcept>
#include <thread>
#include <tuple>
#include <vector>

#include "bindings/records.h"
#include "sensing/paper.h"
#include "sensing/parts.h"
#include "sensing/sense.h"

namespace nb = nanobind;
using Doubles = nb::ndarray<nb::numpy, const double, nb::c_contig, nb::device::cpu>;
using Any = nb::ndarray<nb::numpy, nb::ro, nb::c_contig, nb::device::cpu>;
using Floats = nb::ndarray<nb::numpy, const float, nb::ndim<1>, nb::c_contig, nb::device::cpu>;
using PaperBlocks =
    nb::ndarray<nb::numpy, const double, nb::shape<-1, -1, 2>, nb::c_contig, nb::device::cpu>;

using Drives =
    nb::ndarray<nb::numpy, const double, nb::shape<-1, 2, -1>, nb::c_contig, nb::device::cpu>;
using Tables = nb::ndarray<nb::numpy, const double, nb::shape<-1, PARTS_SIZE>, nb::c_contig,
                           nb::device::cpu>;

namespace {

constexpr size_t samples_a_thread = 200'000;
constexpr size_t ahead_bytes = 2048; // of memory, while a block is summed

void copy(const Doubles &from, double *to, size_t count, const char *what)
{
    if (from.size() != count) {
        throw std::invalid_argument(std::string(what) + " has the wrong size");
    }
    std::memcpy(to, from.data(), count * sizeof(double));
}

sense_type type_of(const Any &x)
{
    if (x.dtype() == nb::dtype<int16_t>()) {
        return SENSE_INT16;
    }
    if (x.dtype() == nb::dtype<float>()) {
        return SENSE_FLOAT;
    }
    if (x.dtype() == nb::dtype<double>()) {
        return SENSE_DOUBLE;
    }
    throw std::invalid_argument("readings must be int16, float32 or float64");
}

size_t size_of(sense_type type)
{
    return type == SENSE_INT16 ? sizeof(int16_t)
                               : (type == SENSE_FLOAT ? sizeof(float) : sizeof(double));
}

// Readings of both channels, wherever they lie.
struct Source {
    sense_type type;
    const char *v, *i;
    size_t stride, samples; // samples a channel

    static Source of_pairs(const Any &x)
    {
        const sense_type type = type_of(x);
        const auto *data = static_cast<const char *>(x.data());
        return {type, data, data + size_of(type), 2, x.size() / 2};
    }
    static Source of_channels(const Any &v, const Any &i)
    {
        const sense_type type = type_of(v);
        if (type_of(i) != type || v.size() != i.size()) {
            throw std::invalid_argument("both channels need one type and one length");
        }
        return {type, static_cast<const char *>(v.data()), static_cast<const char *>(i.data()), 1,
                v.size()};
    }
    const void *voltage(size_t sample) const { return v + sample * stride * size_of(type); }
    const void *current(size_t sample) const { return i + sample * stride * size_of(type); }
};

// A plan with its memory.
class Plan {
  public:
    Plan(size_t samples, Doubles cosine, Doubles sine, Doubles table, Doubles turn, Doubles local,
         Doubles whitening, nb::object choices, double period_s, double omega_rad_s,
         double full_scale, double current_limit, int vectors)
        : cosine_(cosine.data(), cosine.data() + cosine.size()),
          sine_(sine.data(), sine.data() + sine.size())
    {
        const Records<const sense_choice> given(choices);
        plan_.sum = sum_segments_by(vectors);
        plan_.samples = samples;
        plan_.segment = cosine_.size();
        if (samples == 0 || plan_.segment < 8 || plan_.segment > 65535 || plan_.segment > samples ||
            sine_.size() != plan_.segment || given.size() == 0) {
            throw std::invalid_argument("tables do not fit the block");
        }
        plan_.segments = samples / plan_.segment;
        if (plan_.segments > SENSE_SEGMENTS) {
            throw std::invalid_argument("too many segments in a block");
        }
        plan_.padded = (plan_.segments + 8) / 8 * 8;
        plan_.cosine = cosine_.data();
        plan_.sine = sine_.data();
        for (size_t k = 0; k < cosine_.size(); ++k) { // of three times the angle
            const double c = cosine.data()[k], s = sine.data()[k];
            cosine3_.push_back(static_cast<float>((4.0 * c * c - 3.0) * c));
            sine3_.push_back(static_cast<float>((3.0 - 4.0 * s * s) * s));
        }
        plan_.cosine3 = cosine3_.data();
        plan_.sine3 = sine3_.data();
        copy(table, &plan_.table[0][0], 4, "table");
        if (turn.size() != 2 * SENSE_ALL) {
            throw std::invalid_argument("turn has the wrong size");
        }
        std::memcpy(plan_.turn_cos, turn.data(), sizeof plan_.turn_cos);
        std::memcpy(plan_.turn_sin, turn.data() + SENSE_ALL, sizeof plan_.turn_sin);
        copy(local, &plan_.local_inverse[0][0], 16, "local");
        copy(whitening, &plan_.local_whitening[0][0], 4, "whitening");
        plan_.period_s = period_s;
        plan_.omega_rad_s = omega_rad_s;
        plan_.full_scale = static_cast<float>(full_scale);
        plan_.current_limit = static_cast<float>(current_limit);
        choices_.assign(given.data(), given.data() + given.size());
        plan_.choices = choices_.data();
        plan_.choice_count = choices_.size();
        plan_.start = 0;
        while (plan_.start + 1 < plan_.segments && choices_[0].used[plan_.start] == 0.0) {
            ++plan_.start;
        }
    }
    Plan(const Plan &) = delete;
    Plan &operator=(const Plan &) = delete;

    const sense_plan &get() const { return plan_; }

  private:
    std::vector<float> cosine_, sine_, cosine3_, sine3_;
    std::vector<sense_choice> choices_;
    sense_plan plan_;
};

void run_blocks(const Plan &plan, const Source &x, const Records<sense_result> &out,
                size_t at_most)
{
    const size_t n = plan.get().samples, blocks = out.size();
    if (x.samples != blocks * n) {
        throw std::invalid_argument("the output does not fit the blocks");
    }
    nb::gil_scoped_release free_gil;
    const auto run = [&](size_t from, size_t to) {
        std::vector<float> room(sense_room(&plan.get()));
        for (size_t b = from; b < to; ++b) {
            sense_block(&plan.get(), x.type, x.voltage(b * n), x.current(b * n), x.stride,
                        to - b > 8 ? ahead_bytes : 0, 1, room.data(), out.data() + b);
        }
    };
    // A thread costs some ten microseconds to start; blocks do not depend on one another.
    static const size_t most =
        std::clamp<size_t>(std::thread::hardware_concurrency(), 1, 8);
    const size_t threads = std::clamp<size_t>(blocks * n / samples_a_thread, 1,
                                              at_most > 0 ? at_most : most);
    std::vector<std::thread> others;
    for (size_t k = 1; k < threads; ++k) {
        others.emplace_back(run, blocks * k / threads, blocks * (k + 1) / threads);
    }
    run(0, blocks / threads);
    for (auto &other : others) {
        other.join();
    }
}

// Capacitance, resistance and reason of one block, in the arithmetic of the microcontroller.
class Impedance {
  public:
    Impedance(float scale_re, float scale_im, float stray_re, float stray_im, float omega_rad_s,
              float min_amplitude, double quadrature)
        : config_{scale_re, scale_im, stray_re, stray_im, omega_rad_s, min_amplitude},
          clear_(25.0 * quadrature)
    {
    }
    std::tuple<float, float, unsigned> operator()(const Plan &plan, Any codes)
    {
        const Source x = Source::of_pairs(codes);
        if (x.samples != plan.get().samples) {
            throw std::invalid_argument("a step needs one whole block, voltage and current");
        }
        room_.resize(sense_room(&plan.get()));
        sense_result r;
        sense_block(&plan.get(), x.type, x.v, x.i, x.stride, 0, 0, room_.data(), &r);
        const hs_phasor v = {static_cast<float>(r.v_re), static_cast<float>(r.v_im)};
        const hs_phasor i = {static_cast<float>(r.i_re), static_cast<float>(r.i_im)};
        const hs_impedance z = hs_impedance_of(&config_, &v, &i);
        unsigned reason = z.reason | r.reason;
        if (!(r.v_re * r.v_re + r.v_im * r.v_im > clear_ * r.v_noise &&
              r.i_re * r.i_re + r.i_im * r.i_im > clear_ * r.i_noise)) {
            reason |= HS_AMPLITUDE_LOST;
        }
        return {z.capacitance_f, z.resistance_ohm, reason};
    }

  private:
    hs_impedance_config config_;
    double clear_; // five standard deviations of a quadrature, squared, a variance of the readings
    std::vector<float> room_; // grows with the first block
};

class Paper {
  public:
    // sections: two rows b0 b1 b2 1 a1 a2; rest: delays of the filter at rest at 1.
    Paper(Doubles sections, Doubles rest, Doubles wave)
        : wave_(wave.data(), wave.data() + wave.size()), state_{}
    {
        if (sections.size() != 12 || wave_.size() < 2) {
            throw std::invalid_argument("the low-pass needs two sections of second order");
        }
        copy(rest, rest_, 4, "rest");
        for (size_t k = 0; k < 2; ++k) {
            const double *row = sections.data() + 6 * k;
            std::memcpy(filter_.b[k], row, sizeof filter_.b[k]);
            std::memcpy(filter_.a[k], row + 4, sizeof filter_.a[k]);
        }
    }
    // Results of the voltage and of the current, a block a row. The filter starts at rest at the
    // first readings, and anew behind what is no number.
    void step(PaperBlocks x, nb::object results)
    {
        const Records<paper_result> out(results);
        const size_t blocks = x.shape(0), n = x.shape(1), period = wave_.size() / 2;
        if (out.shape(0) != blocks || out.shape(1) != 2 || n % period != 0 || n < 2 * period) {
            throw std::invalid_argument("the output does not fit the blocks");
        }
        nb::gil_scoped_release free_gil;
        std::vector<double> mean(2 * period), fundamentals(4 * (n / period));
        for (size_t b = 0; b < blocks; ++b) {
            const double *block = x.data() + 2 * n * b;
            paper_result *both = out.data() + 2 * b;
            if (!started_) {
                start(block);
            }
            paper_block(&filter_, &state_, block, n, period, wave_.data(), mean.data(),
                        fundamentals.data(), both);
            started_ = std::isfinite(both[0].re) && std::isfinite(both[1].re);
        }
    }

  private:
    void start(const double *first)
    {
        for (size_t k = 0; k < 2; ++k) {
            for (size_t d = 0; d < 2; ++d) {
                for (size_t j = 0; j < 2; ++j) {
                    state_.z[k][d][j] = first[j] * rest_[2 * k + d];
                }
            }
        }
    }

    std::vector<double> wave_;
    paper_filter filter_;
    paper_state state_;
    double rest_[4];
    bool started_ = false;
};

// Cuts of many blocks. y: (blocks, 2, 2 segments); each table: 2 rows a segment for runs of 1, 2 ...
// segments; limits: least and most columns of each table, then gap and spare; prices: of a parameter,
// of a cut, of a segment left out. parts: PART (blocks, segments), results: PARTS_RESULT (blocks,).
void run_parts(Drives y, const std::vector<Tables> &tables, const std::vector<size_t> &limits,
               const std::vector<double> &prices, nb::object parts_out, nb::object results)
{
    const Records<parts_part> parts(parts_out);
    const Records<parts_result> result(results);
    const size_t blocks = y.shape(0), segments = y.shape(2) / 2, kinds = tables.size();
    if (segments == 0 || segments > PARTS_SEGMENTS || y.shape(2) != 2 * segments || kinds == 0 ||
        kinds > PARTS_KINDS || limits.size() != 2 * kinds + 2 || prices.size() != 3 ||
        parts.shape(0) != blocks || parts.shape(1) != segments || result.size() != blocks) {
        throw std::invalid_argument("the tables or the output do not fit the blocks");
    }
    parts_plan plan{};
    plan.segments = segments;
    plan.kinds = kinds;
    for (size_t k = 0; k < kinds; ++k) {
        if (tables[k].shape(0) != segments * (segments + 1) || limits[2 * k] == 0 ||
            limits[2 * k + 1] > PARTS_SIZE) {
            throw std::invalid_argument("a table does not fit the segments");
        }
        plan.tables[k] = {tables[k].data(), limits[2 * k], limits[2 * k + 1]};
    }
    plan.gap = limits[2 * kinds];
    plan.spare = limits[2 * kinds + 1];
    plan.price = prices[0];
    plan.cut_price = prices[1];
    plan.left_out = prices[2];
    nb::gil_scoped_release free_gil;
    for (size_t b = 0; b < blocks; ++b) {
        parts_cut(&plan, y.data() + 4 * segments * b, parts.data() + segments * b, result.data() + b);
    }
}

} // namespace

NB_MODULE(_sense, m)
{
    nb::set_leak_warnings(false); // objects that exist until the interpreter ends are not leaks
    m.doc() = "Sensing on the desktop: the core's sums, what follows from them, and the paper's chain";
    m.attr("SEGMENTS") = SENSE_SEGMENTS;
    m.attr("ROOM") = SENSE_ALL;
    m.attr("RESULT") = dtype_of<sense_result>(
        {FIELD(sense_result, v_re), FIELD(sense_result, v_im), FIELD(sense_result, i_re),
         FIELD(sense_result, i_im), FIELD(sense_result, v_noise), FIELD(sense_result, i_noise),
         FIELD(sense_result, v_level), FIELD(sense_result, i_level), FIELD(sense_result, v_slope),
         FIELD(sense_result, i_slope), FIELD(sense_result, excess),
         FIELD(sense_result, offset_rad_s), FIELD(sense_result, v3_re), FIELD(sense_result, v3_im),
         FIELD(sense_result, i3_re), FIELD(sense_result, i3_im), FIELD(sense_result, choice),
         FIELD(sense_result, reason), FIELD(sense_result, suspicion)});
    m.attr("CHOICE") = dtype_of<sense_choice>(
        {FIELD(sense_choice, used), FIELD(sense_choice, after), FIELD(sense_choice, inverse),
         FIELD(sense_choice, samples), FIELD(sense_choice, full),
         FIELD(sense_choice, after_share)});
    m.attr("SUMS") = dtype_of<hs_sums>({FIELD(hs_sums, first), FIELD(hs_sums, cosine),
                                        FIELD(hs_sums, sine), FIELD(hs_sums, level),
                                        FIELD(hs_sums, ramp), FIELD(hs_sums, square)});
    m.attr("PART") = dtype_of<parts_part>({FIELD(parts_part, first), FIELD(parts_part, count),
                                           FIELD(parts_part, size), FIELD(parts_part, kind)});
    m.attr("PARTS_RESULT") =
        dtype_of<parts_result>({FIELD(parts_result, score), FIELD(parts_result, misfit),
                                FIELD(parts_result, parts)});
    m.attr("PAPER_RESULT") = dtype_of<paper_result>(
        {FIELD(paper_result, peak_to_peak), FIELD(paper_result, re), FIELD(paper_result, im),
         FIELD(paper_result, scatter), FIELD(paper_result, most)});
    // Sums of every segment: which vectors add them changes no bit.
    m.def("sum_segments", [](Floats x, Floats cosine, Floats sine, int bits, nb::object sums) {
        const Records<hs_sums> out(sums);
        const size_t segment = cosine.size();
        if (x.size() == 0 || segment == 0 || segment > 65535 || sine.size() != segment ||
            out.size() != (x.size() + segment - 1) / segment) {
            throw std::invalid_argument("the output does not fit the segments");
        }
        sum_segments_by(bits)(x.data(), x.size(), cosine.data(), sine.data(), segment, 0,
                            out.data());
    });
    nb::class_<Plan>(m, "Plan").def(
        nb::init<size_t, Doubles, Doubles, Doubles, Doubles, Doubles, Doubles, nb::object, double,
                 double, double, double, int>(),
        nb::kw_only(), nb::arg("samples"), nb::arg("cosine"), nb::arg("sine"), nb::arg("table"),
        nb::arg("turn"), nb::arg("local"), nb::arg("whitening"), nb::arg("choices"),
        nb::arg("period_s"), nb::arg("omega_rad_s"), nb::arg("full_scale"),
        nb::arg("current_limit"), nb::arg("vectors") = 512);
    m.def("vectors", [] { return sum_segments_bits(512); });
    m.def(
        "blocks",
        [](const Plan &plan, Any x, nb::object out, size_t threads) {
            run_blocks(plan, Source::of_pairs(x), Records<sense_result>(out), threads);
        },
        nb::arg("plan"), nb::arg("readings"), nb::arg("out"), nb::arg("threads") = 0);
    m.def(
        "channels",
        [](const Plan &plan, Any v, Any i, nb::object out, size_t threads) {
            run_blocks(plan, Source::of_channels(v, i), Records<sense_result>(out), threads);
        },
        nb::arg("plan"), nb::arg("voltage"), nb::arg("current"), nb::arg("out"),
        nb::arg("threads") = 0);
    m.def("parts", &run_parts);
    m.attr("PART_COLUMNS") = PARTS_SIZE;
    nb::class_<Impedance>(m, "Impedance")
        .def(nb::init<float, float, float, float, float, float, double>())
        .def("__call__", &Impedance::operator());
    nb::class_<Paper>(m, "Paper")
        .def(nb::init<Doubles, Doubles, Doubles>())
        .def("step", &Paper::step);
}
