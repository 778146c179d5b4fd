// Python face of the models that run sample by sample: haselab._models.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

#include <stdexcept>

extern "C" {
#include "models/hysteresis.h"
}

namespace nb = nanobind;
using In = nb::ndarray<nb::numpy, const double, nb::ndim<1>, nb::c_contig, nb::device::cpu>;
using Out = nb::ndarray<nb::numpy, double, nb::ndim<1>, nb::c_contig, nb::device::cpu>;
using Table = nb::ndarray<nb::numpy, double, nb::ndim<2>, nb::c_contig, nb::device::cpu>;

namespace {

void expect(bool right, const char *what)
{
    if (!right) {
        throw std::invalid_argument(what);
    }
}

class Plays {
  public:
    Plays(In thresholds, In weights, double gain, double rate_dependence_s, double pull,
          double rate_hz)
        : thresholds_(thresholds), weights_(weights)
    {
        expect(thresholds.size() == weights.size(), "as many weights as thresholds");
        p_ = {thresholds.size(), thresholds_.data(), weights_.data(), gain, rate_dependence_s, pull,
              rate_hz};
    }

    void run(Out state, In u, Out y) const
    {
        check(state, u.size() == y.size());
        nb::gil_scoped_release free_gil;
        play_run(&p_, state.data(), u.size(), u.data(), y.data());
    }

    void invert(Out state, In y, Out u) const
    {
        check(state, u.size() == y.size());
        nb::gil_scoped_release free_gil;
        play_invert(&p_, state.data(), y.size(), y.data(), u.data());
    }

    void columns(Out state, In u, Table plays, Table by_threshold, Table by_rate) const
    {
        bool right = true;
        for (const Table *table : {&plays, &by_threshold, &by_rate}) {
            right = right && table->shape(0) == u.size() && table->shape(1) == p_.count;
        }
        check(state, right);
        nb::gil_scoped_release free_gil;
        play_columns(&p_, state.data(), u.size(), u.data(), plays.data(), by_threshold.data(),
                     by_rate.data());
    }

  private:
    void check(const Out &state, bool right) const
    {
        expect(state.size() == PLAY_STATE_SIZE(p_.count), "a state of operators + 2 numbers");
        expect(right, "inputs and outputs of one length");
    }

    In thresholds_;
    In weights_;
    play_parameters p_{};
};

void run_bouc_wen(double sharpness, double sigma, double exponent, Out state, In u, Out w)
{
    expect(state.size() == BOUC_WEN_STATE_SIZE && u.size() == w.size(), "two states, equal lengths");
    const bouc_wen_parameters p = {sharpness, sigma, exponent};
    nb::gil_scoped_release free_gil;
    bouc_wen_run(&p, state.data(), u.size(), u.data(), w.data());
}

void invert_bouc_wen(double sharpness, double sigma, double exponent, double gain, double weight,
                     Out state, In y, Out u)
{
    expect(state.size() == BOUC_WEN_STATE_SIZE && u.size() == y.size(), "two states, equal lengths");
    const bouc_wen_parameters p = {sharpness, sigma, exponent};
    nb::gil_scoped_release free_gil;
    bouc_wen_invert(&p, gain, weight, state.data(), y.size(), y.data(), u.data());
}

} // namespace

NB_MODULE(_models, m)
{
    nb::set_leak_warnings(false); // objects that exist until the interpreter ends are not leaks
    m.doc() = "Hysteresis operators, sample by sample";
    nb::class_<Plays>(m, "Plays")
        .def(nb::init<In, In, double, double, double, double>())
        .def("run", &Plays::run)
        .def("invert", &Plays::invert)
        .def("columns", &Plays::columns);
    m.def("run_bouc_wen", &run_bouc_wen);
    m.def("invert_bouc_wen", &invert_bouc_wen);
}
