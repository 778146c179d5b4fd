// Python face of transfer.h, oscillator.h and noise.h: records once, then any number of searches on them.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/tuple.h>
#include <nanobind/stl/vector.h>

#include <algorithm>
#include <cmath>
#include <cstring>
#include <memory>
#include <stdexcept>
#include <vector>

#include "identification/noise.h"
#include "identification/oscillator.h"
#include "identification/transfer.h"

namespace nb = nanobind;
using Vector = nb::ndarray<const double, nb::ndim<1>, nb::c_contig, nb::device::cpu>;
using OutVector = nb::ndarray<nb::numpy, double, nb::ndim<1>>;
using OutMatrix = nb::ndarray<nb::numpy, double, nb::ndim<2>>;
using Numbers = std::vector<double>;

namespace {

constexpr double kSame = 1e-9;  // of a period: outputs this close lie on one phase
constexpr size_t kMostPhases = 64;

OutVector given(const Numbers &values) {
    double *copy = new double[std::max<size_t>(values.size(), 1)];
    std::copy(values.begin(), values.end(), copy);
    nb::capsule owner(copy, [](void *p) noexcept { delete[] static_cast<double *>(p); });
    return OutVector(copy, {values.size()}, owner);
}

// One experiment, with the place of each output among the edges of the input.
class Record {
  public:
    Record(Vector u, double input_rate_hz, double before, bool first_order, Vector y, Vector time_s,
           double margin_s)
        : y_(y.data(), y.data() + y.size()), period_s_(1.0 / input_rate_hz), before_(before),
          first_order_(first_order) {
        if (u.size() == 0 || y.size() == 0 || y.size() != time_s.size())
            throw std::invalid_argument("u, y and time_s");
        place(time_s, input_rate_hz);
        const double last = *std::max_element(edge_.begin(), edge_.end());
        const double wanted = std::max(last, 0.0) + std::ceil(margin_s * input_rate_hz) + 3.0;
        if (!(wanted < 1e8)) throw std::invalid_argument("time_s is too long for the input's rate");
        u_.resize(static_cast<size_t>(wanted));
        for (size_t k = 0; k < u_.size(); ++k) u_[k] = u(std::min(k, u.size() - 1)) - before;
    }

    held_record view() const {
        held_record r;
        r.u = u_.data();
        r.n_edges = static_cast<int32_t>(u_.size());
        r.first_order = first_order_;
        r.period_s = period_s_;
        r.before = before_;
        r.y = y_.data();
        r.n = static_cast<int32_t>(y_.size());
        r.edge = edge_.data();
        r.group = group_.data();
        r.phase = phase_.data();
        r.n_groups = static_cast<int32_t>(phase_.size());
        r.in_step = in_step_;
        return r;
    }

    size_t size() const { return y_.size(); }

  private:
    void place(const Vector &time_s, double rate_hz) {
        const size_t n = time_s.size();
        edge_.resize(n);
        group_.resize(n);
        std::vector<double> phases(n);
        for (size_t m = 0; m < n; ++m) {
            const double at = time_s(m) * rate_hz, whole = std::floor(at + kSame);
            edge_[m] = static_cast<int32_t>(whole);
            phases[m] = std::max(at - whole, 0.0);
        }
        in_step_ = 1;
        size_t g = 0;
        for (size_t m = 0; m < n && phase_.size() <= kMostPhases; ++m) {
            for (size_t k = 0; k <= phase_.size(); ++k, ++g) {  // the last group is tried first
                if (g >= phase_.size()) g = 0;
                if (k == phase_.size()) {
                    g = k;
                    phase_.push_back(phases[m]);
                    break;
                }
                if (std::fabs(phase_[g] - phases[m]) < kSame) break;
            }
            group_[m] = static_cast<int32_t>(g);
            in_step_ &= g == 0 && edge_[m] == edge_[0] + static_cast<int32_t>(m);
        }
        if (phase_.size() > kMostPhases) {
            phase_ = phases;
            for (size_t m = 0; m < n; ++m) group_[m] = static_cast<int32_t>(m);
            in_step_ = 0;
        }
    }

    Numbers u_, y_, phase_;
    std::vector<int32_t> edge_, group_;
    double period_s_, before_;
    int32_t first_order_, in_step_ = 0;
};

using Found = std::tuple<OutVector, OutVector, std::vector<OutVector>, double, bool>;

class Transfer {
  public:
    Transfer(int pairs, int reals, int zeros, int slow, bool initial_state, bool offset,
             Numbers numbers, Numbers factors, const std::vector<const Record *> &records) {
        std::memset(&structure_, 0, sizeof structure_);
        structure_.pairs = pairs;
        structure_.reals = reals;
        structure_.zeros = zeros;
        structure_.slow = slow;
        structure_.initial_state = initial_state;
        structure_.offset = offset;
        const int poles = 2 * pairs + reals + slow;
        if (poles < 1 || poles > TRANSFER_POLES || slow > 3 || zeros < 0 || zeros > 5 ||
            numbers.size() != static_cast<size_t>(poles) + 1 ||
            factors.size() != static_cast<size_t>(zeros + 1 + slow) || records.empty() ||
            records.size() > TRANSFER_RECORDS)
            throw std::invalid_argument("structure or records");
        std::copy(numbers.begin(), numbers.end(), structure_.numbers);
        std::copy(factors.begin(), factors.end(), structure_.factors);
        for (const Record *record : records) {
            records_.push_back(record->view());
            total_ += record->size();
        }
        const auto count = static_cast<int32_t>(records_.size());
        work_.reset(new double[transfer_work(&structure_, records_.data(), count)]);
        problem_ = {&structure_, records_.data(), count, work_.get()};
    }

    Found project(const Numbers &search) {
        transfer_solution solution = from(search);
        {
            nb::gil_scoped_release released;
            transfer_project(&problem_, &solution);
        }
        solution.settled = 1;
        return found(solution);
    }

    Found minimise(const Numbers &search, const Numbers &low, const Numbers &high, int iterations,
                   double gain) {
        transfer_solution solution = from(search);
        if (low.size() != search.size() || high.size() != search.size())
            throw std::invalid_argument("bounds");
        {
            nb::gil_scoped_release released;
            transfer_minimise(&problem_, low.data(), high.data(), iterations, gain, &solution);
        }
        return found(solution);
    }

    std::tuple<OutVector, OutMatrix> columns(const Numbers &search) {
        const transfer_solution solution = from(search);
        const size_t n = static_cast<size_t>(transfer_searched(&structure_) +
                                             transfer_shared(&structure_) +
                                             transfer_own(&structure_));
        double *out = new double[std::max<size_t>(n * total_, 1)];
        nb::capsule owner(out, [](void *p) noexcept { delete[] static_cast<double *>(p); });
        Numbers residuals(total_);
        {
            nb::gil_scoped_release released;
            transfer_columns(&problem_, &solution, residuals.data(), out);
        }
        return {given(residuals), OutMatrix(out, {n, total_}, owner)};
    }

    OutVector predict(const Numbers &search, const Numbers &shared, const std::vector<Numbers> &own) {
        transfer_solution solution = from(search);
        if (shared.size() != static_cast<size_t>(transfer_shared(&structure_)) ||
            own.size() != records_.size())
            throw std::invalid_argument("factors");
        std::copy(shared.begin(), shared.end(), solution.shared);
        for (size_t r = 0; r < own.size(); ++r) {
            if (own[r].size() != static_cast<size_t>(transfer_own(&structure_)))
                throw std::invalid_argument("factors of a record");
            std::copy(own[r].begin(), own[r].end(), solution.own[r]);
        }
        Numbers output(total_);
        transfer_predict(&problem_, &solution, output.data());
        return given(output);
    }

  private:
    transfer_solution from(const Numbers &search) const {
        if (search.size() != static_cast<size_t>(transfer_searched(&structure_)))
            throw std::invalid_argument("searched numbers");
        transfer_solution solution;
        std::memset(&solution, 0, sizeof solution);
        std::copy(search.begin(), search.end(), solution.search);
        return solution;
    }

    Found found(const transfer_solution &s) const {
        const auto vector = [](const double *values, int32_t n) {
            return given(Numbers(values, values + n));
        };
        std::vector<OutVector> own;
        for (int32_t r = 0; r < problem_.n_records; ++r)
            own.push_back(vector(s.own[r], transfer_own(&structure_)));
        return {vector(s.search, transfer_searched(&structure_)),
                vector(s.shared, transfer_shared(&structure_)), own, s.cost, s.settled != 0};
    }

    transfer_structure structure_;
    std::vector<held_record> records_;
    size_t total_ = 0;
    std::unique_ptr<double[]> work_;
    transfer_problem problem_;
};

OutVector autocovariance(const std::vector<Vector> &residuals, int lags) {
    Numbers total(static_cast<size_t>(lags) + 1, 0.0);
    size_t count = 0;
    for (const Vector &e : residuals) {
        noise_autocovariance(e.data(), static_cast<int64_t>(e.size()), lags, total.data());
        count += e.size();
    }
    for (double &value : total) value /= static_cast<double>(std::max<size_t>(count, 1));
    return given(total);
}

// `before` and a signal that follows `wanted` from there, by at most `most` in each step.
OutVector follow_slowly(Vector wanted, double before, double most) {
    Numbers out(wanted.size() + 1);
    double now = out[0] = before;
    for (size_t k = 0; k < wanted.size(); ++k) {
        now += std::min(std::max(wanted(k) - now, -most), most);
        out[k + 1] = now;
    }
    return given(out);
}

std::tuple<OutVector, double> autoregression(const Numbers &covariance, int64_t count) {
    if (covariance.empty() || covariance.size() > 65) throw std::invalid_argument("lags");
    Numbers polynomial(covariance.size());
    double variance = 0.0;
    const int32_t order =
        noise_autoregression(covariance.data(), static_cast<int32_t>(covariance.size()) - 1, count,
                             polynomial.data(), &variance);
    polynomial.resize(static_cast<size_t>(order) + 1);
    return {given(polynomial), variance};
}

std::tuple<OutVector, OutMatrix, bool> oscillate(Vector u, double input_rate_hz, double before,
                                                 bool first_order, Vector time_s,
                                                 const Numbers &numbers, double largest) {
    if (u.size() == 0 || time_s.size() == 0 || numbers.size() != OSCILLATOR_NUMBERS ||
        !(input_rate_hz > 0.0) || !(time_s(0) >= 0.0))
        throw std::invalid_argument("u, time_s or numbers");
    oscillator_record record;
    record.u = u.data();
    record.n_edges = static_cast<int32_t>(u.size());
    record.first_order = first_order;
    record.period_s = 1.0 / input_rate_hz;
    record.before = before;
    record.time_s = time_s.data();
    record.n = static_cast<int32_t>(time_s.size());
    Numbers x(time_s.size(), 0.0);
    double *out = new double[OSCILLATOR_NUMBERS * time_s.size()]();
    nb::capsule owner(out, [](void *p) noexcept { delete[] static_cast<double *>(p); });
    bool finite = false;
    {
        nb::gil_scoped_release released;
        finite = oscillator_simulate(&record, numbers.data(), largest, x.data(), out) != 0;
    }
    return {given(x), OutMatrix(out, {OSCILLATOR_NUMBERS, time_s.size()}, owner), finite};
}

}  // namespace

NB_MODULE(_identify, m) {
    nb::set_leak_warnings(false);  // objects that exist until the interpreter ends are not leaks
    m.doc() = "Fits that are too slow in Python";
    nb::class_<Record>(m, "Record")
        .def(nb::init<Vector, double, double, bool, Vector, Vector, double>(), nb::arg("u"),
             nb::arg("input_rate_hz"), nb::arg("before"), nb::arg("first_order"), nb::arg("y"),
             nb::arg("time_s"), nb::arg("margin_s"))
        .def("__len__", &Record::size);
    nb::class_<Transfer>(m, "Transfer")
        .def(nb::init<int, int, int, int, bool, bool, Numbers, Numbers,
                      const std::vector<const Record *> &>(),
             nb::kw_only(), nb::arg("pairs"), nb::arg("reals"), nb::arg("zeros"), nb::arg("slow"),
             nb::arg("initial_state"), nb::arg("offset"), nb::arg("numbers"), nb::arg("factors"),
             nb::arg("records"), nb::keep_alive<1, 10>())
        .def("project", &Transfer::project, nb::arg("search"))
        .def("minimise", &Transfer::minimise, nb::arg("search"), nb::arg("low"), nb::arg("high"),
             nb::arg("iterations"), nb::arg("gain"))
        .def("columns", &Transfer::columns, nb::arg("search"))
        .def("predict", &Transfer::predict, nb::arg("search"), nb::arg("shared"), nb::arg("own"));
    nb::dict places; // of the numbers of an oscillator
    places["log_omega"] = int(OSCILLATOR_LOG_OMEGA);
    places["log_zeta"] = int(OSCILLATOR_LOG_ZETA);
    places["gain"] = int(OSCILLATOR_GAIN);
    places["q2"] = int(OSCILLATOR_Q2);
    places["q3"] = int(OSCILLATOR_Q3);
    places["delay"] = int(OSCILLATOR_DELAY);
    places["start"] = int(OSCILLATOR_START);
    places["rate"] = int(OSCILLATOR_RATE);
    m.attr("OSCILLATOR") = places;
    m.def("oscillate", &oscillate, nb::arg("u"), nb::arg("input_rate_hz"), nb::arg("before"),
          nb::arg("first_order"), nb::arg("time_s"), nb::arg("numbers"), nb::arg("largest"));
    m.def("autocovariance", &autocovariance, nb::arg("residuals"), nb::arg("lags"));
    m.def("follow_slowly", &follow_slowly, nb::arg("wanted"), nb::arg("before"), nb::arg("most"));
    m.def("autoregression", &autoregression, nb::arg("covariance"), nb::arg("count"));
}
