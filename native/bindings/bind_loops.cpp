// Python face of native/loops/loops.c: haselab._loops.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

#include <algorithm>
#include <cstdlib>
#include <cstring>
#include <memory>
#include <new>
#include <numeric>
#include <stdexcept>
#include <thread>
#include <vector>

#include "loops/loops.h"

#ifdef __SSE__
#include <immintrin.h>
#endif

namespace nb = nanobind;
template <class T, size_t N>
using Array = nb::ndarray<nb::numpy, T, nb::ndim<N>, nb::c_contig, nb::device::cpu>;

namespace {

constexpr size_t lanes = LOOPS_LANES;
constexpr size_t samples_a_thread = 50'000;
constexpr size_t together = 4; // groups in step: enough to hide latency, few enough for the cache
constexpr size_t chunk = 1024; // samples of noise and traces at a time: a page of each trace

// A row of the table: 4 + 2 + 1 + 3 + 3 of the plant, 5 where it starts, then these.
enum Column : size_t { KP = 18, KI, KD, FILTER_S, U_LOW, U_HIGH, U, REST, DELAY, NOISE_STD, COLUMNS };

static_assert(sizeof(loops_plant) + sizeof(loops_state) == KP * sizeof(double), "a row of numbers");
static_assert(sizeof(loops_summary) == LOOPS_KEPT * sizeof(float), "a row of numbers");
static_assert(sizeof(loops_group) % 64 == 0, "rows of registers");

struct Free {
    void operator()(void *p) const { std::free(p); }
};

template <class T> std::unique_ptr<T[], Free> aligned(size_t count)
{
    void *p = std::aligned_alloc(64, (count * sizeof(T) + 63) / 64 * 64);
    if (p == nullptr) {
        throw std::bad_alloc();
    }
    return std::unique_ptr<T[], Free>(static_cast<T *>(p));
}

loops_loop loop_of(const double *row, float period_s)
{
    loops_loop loop;
    std::memcpy(&loop.plant, row, sizeof loop.plant);
    std::memcpy(&loop.start, row + sizeof loop.plant / sizeof(double), sizeof loop.start);
    const auto number = [row](Column column) { return static_cast<float>(row[column]); };
    loop.pid = {number(KP), number(KI), number(KD), period_s,
                period_s / (period_s + number(FILTER_S)), number(U_LOW), number(U_HIGH)};
    loop.u = number(U);
    loop.rest = number(REST);
    loop.delay = static_cast<uint32_t>(row[DELAY]);
    loop.noise_std = number(NOISE_STD);
    loop.noise_key = 0;
    return loop;
}

// Everything that a run takes and gives, row by row of the caller's loops.
struct Job {
    std::vector<loops_loop> loops;
    loops_task task;
    const float *noise; // (B, N) or null
    float *measured, *u; // (B, N) or null
    loops_summary *summaries; // (B, stretches) or null
    size_t samples;
    bool noisy() const { return noise != nullptr || task.generated != 0; }

    loops_traces traces(size_t loop) const
    {
        return u ? loops_traces{measured + loop * samples, u + loop * samples}
                 : loops_traces{nullptr, nullptr};
    }
};

void run_singly(const Job &job, size_t from, size_t to)
{
    std::vector<float> line;
    for (size_t b = from; b < to; ++b) {
        line.resize(loops_line_size(job.loops[b].delay));
        loops_one(&job.loops[b], &job.task, job.noise ? job.noise + b * job.samples : nullptr,
                  line.data(), job.traces(b),
                  job.summaries ? job.summaries + b * job.task.stretches : nullptr);
    }
}

// Four lanes of rows into four traces, four samples at a time; gives how many samples it moved.
size_t turn(const float *rows, size_t samples, float *const to[4])
{
    size_t k = 0;
#ifdef __SSE__
    for (; k + 4 <= samples; k += 4) {
        __m128 x[4];
        for (size_t j = 0; j < 4; ++j) {
            x[j] = _mm_loadu_ps(rows + (k + j) * lanes);
        }
        _MM_TRANSPOSE4_PS(x[0], x[1], x[2], x[3]);
        for (size_t j = 0; j < 4; ++j) {
            _mm_storeu_ps(to[j] + k, x[j]);
        }
    }
#endif
    return k;
}

// A few groups in step, with their memory.
class Bunch {
  public:
    Bunch(const Job &job, size_t longest)
        : job_(job), line_size_(lanes * loops_line_size(static_cast<uint32_t>(longest))),
          groups_(aligned<loops_group>(together)),
          lines_(aligned<float>(together * line_size_)),
          rows_(aligned<float>(job.noisy() || job.u ? 3 * together * chunk * lanes : 1))
    {
    }

    // The loops of `order`, at most `together` groups of them; the last lanes repeat the last loop.
    void run(const loops_kernel &kernel, const size_t *order, size_t count)
    {
        order_ = order;
        count_ = count;
        const size_t groups = (count + lanes - 1) / lanes;
        loops_loop loops[lanes];
        for (size_t g = 0; g < groups; ++g) {
            for (size_t j = 0; j < lanes; ++j) {
                loops[j] = job_.loops[order[std::min(g * lanes + j, count - 1)]];
            }
            loops_pack(&groups_[g], loops, lines_.get() + g * line_size_);
            if (job_.noisy()) {
                groups_[g].noise = rows(g, 0);
            }
            if (job_.u) {
                groups_[g].measured = rows(g, 1);
                groups_[g].u = rows(g, 2);
            }
        }
        const bool turned = job_.noisy() || job_.u;
        loops_span span = {job_.task.reference, 0, 0, 0, job_.task.slow, job_.task.band};
        for (size_t s = 0; s < job_.task.stretches; ++s) {
            span.first = span.from;
            for (const size_t end = job_.task.ends[s]; span.from < end; span.from = span.to) {
                span.to = turned ? std::min(span.from + chunk, end) : end;
                if (job_.noise) {
                    take_noise(span);
                }
                for (size_t g = 0; job_.task.generated && g < groups; ++g) {
                    kernel.noise(&groups_[g], job_.task.noise_seed, span.from, span.to,
                                 rows(g, 0));
                }
                kernel.run(groups_.get(), groups, &span);
                if (job_.u) {
                    give(job_.measured, 1, span);
                    give(job_.u, 2, span);
                }
            }
            if (job_.summaries) {
                sum_up(s);
            }
        }
    }

  private:
    float *rows(size_t group, size_t which) const
    {
        return rows_.get() + (which * together + group) * chunk * lanes;
    }

    void take_noise(const loops_span &span)
    {
        for (size_t i = 0; i < count_; ++i) {
            const float *from = job_.noise + order_[i] * job_.samples + span.from;
            float *to = rows(i / lanes, 0) + i % lanes;
            for (size_t k = 0; k < span.to - span.from; ++k) {
                to[k * lanes] = from[k];
            }
        }
        for (size_t i = count_; i % lanes != 0; ++i) { // lanes that nobody reads
            float *to = rows(i / lanes, 0) + i % lanes;
            for (size_t k = 0; k < chunk; ++k) {
                to[k * lanes] = 0.0f;
            }
        }
    }

    void give(float *traces, size_t which, const loops_span &span) const
    {
        const size_t samples = span.to - span.from;
        float *to[4];
        for (size_t i = 0; i < count_; i += 4) {
            const size_t some = std::min<size_t>(count_ - i, 4);
            const float *from = rows(i / lanes, which) + i % lanes;
            for (size_t j = 0; j < some; ++j) {
                to[j] = traces + order_[i + j] * job_.samples + span.from;
            }
            for (size_t k = some == 4 ? turn(from, samples, to) : 0; k < samples; ++k) {
                for (size_t j = 0; j < some; ++j) {
                    to[j][k] = from[k * lanes + j];
                }
            }
        }
    }

    void sum_up(size_t stretch)
    {
        for (size_t i = 0; i < count_; ++i) {
            const loops_group &group = groups_[i / lanes];
            float kept[LOOPS_KEPT];
            for (size_t n = 0; n < LOOPS_KEPT; ++n) {
                kept[n] = group.kept[n][i % lanes];
            }
            std::memcpy(job_.summaries + order_[i] * job_.task.stretches + stretch, kept,
                        sizeof kept);
        }
        for (size_t g = 0; g * lanes < count_; ++g) {
            loops_clear(&groups_[g]);
        }
    }

    const Job &job_;
    size_t line_size_;
    std::unique_ptr<loops_group[], Free> groups_;
    std::unique_ptr<float[], Free> lines_, rows_;
    const size_t *order_ = nullptr;
    size_t count_ = 0;
};

void run_groups(const Job &job, const loops_kernel &kernel, const std::vector<size_t> &order,
                size_t from, size_t to)
{
    if (from == to) {
        return;
    }
    Bunch bunch(job, job.loops[order[to - 1]].delay);
    for (; from < to; from += together * lanes) {
        bunch.run(kernel, order.data() + from, std::min(together * lanes, to - from));
    }
}

void run(const Job &job, int bits, size_t at_most)
{
    const size_t count = job.loops.size();
    const loops_kernel *kernel = loops_select(bits);
    std::vector<size_t> order(count); // by delay: groups of one delay read their line in one piece
    std::iota(order.begin(), order.end(), 0);
    std::stable_sort(order.begin(), order.end(), [&job](size_t a, size_t b) {
        return job.loops[a].delay < job.loops[b].delay;
    });
    const size_t bunches = (count + together * lanes - 1) / (together * lanes);
    // A thread costs some ten microseconds to start; loops do not depend on one another.
    static const size_t most = std::clamp<size_t>(std::thread::hardware_concurrency(), 1, 8);
    const size_t useful = std::min(bunches, count * job.samples / samples_a_thread);
    const size_t threads = std::clamp<size_t>(useful, 1, at_most > 0 ? at_most : most);
    const auto part = [&](size_t k) {
        const auto border = [&](size_t n) {
            return std::min(bunches * n / threads * together * lanes, count);
        };
        if (kernel) {
            run_groups(job, *kernel, order, border(k), border(k + 1));
        } else {
            run_singly(job, border(k), border(k + 1));
        }
    };
    std::vector<std::thread> others;
    for (size_t k = 1; k < threads; ++k) {
        others.emplace_back(part, k);
    }
    part(0);
    for (auto &other : others) {
        other.join();
    }
}

using Doubles = Array<double, 1>;

// One loop in double. `plant`: a11, a12, a21, a22, b1, b2, feed; `state` and `line` are used up.
void run_exact(Doubles plant, Doubles decay, Doubles push, Doubles state, Doubles pid,
               double u_before, Doubles line, Doubles reference, Doubles noise, Doubles measured,
               Doubles u)
{
    const size_t samples = reference.shape(0), slow = decay.shape(0);
    if (plant.shape(0) != 7 || pid.shape(0) != 7 || push.shape(0) != slow ||
        state.shape(0) != 2 + slow || line.shape(0) == 0 || samples == 0 ||
        noise.shape(0) != samples || measured.shape(0) != samples || u.shape(0) != samples) {
        throw std::invalid_argument("shapes of the loop do not belong together");
    }
    const double *p = plant.data(), *law = pid.data();
    loops_exact loop = {p[0], p[1], p[2], p[3], p[4], p[5], p[6], decay.data(), push.data(),
                        state.data(), slow, {}, u_before, line.data(), line.shape(0)};
    std::copy(law, law + 7, loop.pid);
    loops_run_exact(&loop, reference.data(), noise.data(), samples, measured.data(), u.data());
}

using Row = Array<const float, 1>;
using Noise = Array<const float, 2>;
using Seeds = Array<const uint32_t, 1>;

// Loops that are ready to run. `noise`: (B, N) or empty. `seeds`: of the samples and of the loops
// for noise that is generated, or empty. `bits`: of the vectors at most, 0 for one loop after the
// other; changes no bit of the result.
class Loops {
  public:
    Loops(Array<const double, 2> table, float period_s, size_t branches)
        : branches_(static_cast<unsigned>(branches))
    {
        if (table.shape(1) != COLUMNS || table.shape(0) == 0 || branches > LOOPS_SLOW) {
            throw std::invalid_argument("the table does not fit the loops");
        }
        for (size_t b = 0; b < table.shape(0); ++b) {
            const double *row = table.data() + b * COLUMNS;
            if (!(row[DELAY] >= 1.0 && row[DELAY] < 1u << 20)) {
                throw std::invalid_argument("a delay is outside [1, 2^20) samples");
            }
            loops_.push_back(loop_of(row, period_s));
        }
    }

    void summaries(Row reference, Noise noise, Seeds seeds, float band,
                   Array<const uint64_t, 1> ends, Array<float, 3> out, int bits, size_t threads)
    {
        Job job = job_of(reference, noise, seeds);
        const std::vector<size_t> stretches(ends.data(), ends.data() + ends.shape(0));
        if (stretches.empty() || stretches.back() != job.samples ||
            !std::is_sorted(stretches.begin(), stretches.end()) ||
            out.shape(0) != loops_.size() || out.shape(1) != stretches.size() ||
            out.shape(2) != LOOPS_KEPT) {
            throw std::invalid_argument("the stretches do not fit the reference or the output");
        }
        job.task.ends = stretches.data();
        job.task.stretches = stretches.size();
        job.task.band = band;
        job.summaries = reinterpret_cast<loops_summary *>(out.data());
        nb::gil_scoped_release free_gil;
        run(job, bits, threads);
    }

    void traces(Row reference, Noise noise, Seeds seeds, Array<float, 2> measured,
                Array<float, 2> u, int bits, size_t threads)
    {
        Job job = job_of(reference, noise, seeds);
        for (const auto &out : {measured, u}) {
            if (out.shape(0) != loops_.size() || out.shape(1) != job.samples) {
                throw std::invalid_argument("the traces do not fit the loops");
            }
        }
        job.task.ends = &job.samples;
        job.task.stretches = 1;
        job.measured = measured.data();
        job.u = u.data();
        nb::gil_scoped_release free_gil;
        run(job, bits, threads);
    }

  private:
    Job job_of(const Row &reference, const Noise &noise, const Seeds &seeds) const
    {
        Job job{};
        job.loops = loops_;
        job.samples = reference.shape(0);
        if (job.samples == 0) {
            throw std::invalid_argument("the reference is empty");
        }
        if (noise.size() != 0) {
            if (noise.shape(0) != loops_.size() || noise.shape(1) != job.samples) {
                throw std::invalid_argument("the noise does not fit the loops");
            }
            job.noise = noise.data();
        }
        if (seeds.size() != 0) {
            if (seeds.size() != 2 || job.noise) {
                throw std::invalid_argument("two seeds and no other noise, or none");
            }
            job.task.generated = 1;
            job.task.noise_seed = seeds.data()[0];
            for (size_t b = 0; b < loops_.size(); ++b) {
                job.loops[b].noise_key = loops_noise_key(static_cast<uint32_t>(b), seeds.data()[1]);
            }
        }
        job.task.reference = reference.data();
        job.task.slow = branches_;
        return job;
    }

    std::vector<loops_loop> loops_;
    unsigned branches_;
};

} // namespace

NB_MODULE(_loops, m)
{
    nb::set_leak_warnings(false); // objects that live to the end of the interpreter are no fault
    m.doc() = "Closed loops with the core's controller, many at a time";
    m.attr("COLUMNS") = static_cast<size_t>(COLUMNS);
    m.attr("KEPT") = static_cast<size_t>(LOOPS_KEPT);
    m.attr("SLOW") = static_cast<size_t>(LOOPS_SLOW);
    nb::class_<Loops>(m, "Loops")
        .def(nb::init<Array<const double, 2>, float, size_t>(), nb::arg("table"),
             nb::arg("period_s"), nb::arg("branches"))
        .def("summaries", &Loops::summaries, nb::arg("reference"), nb::arg("noise"),
             nb::arg("seeds"), nb::arg("band"), nb::arg("ends"), nb::arg("out"),
             nb::arg("bits") = 512, nb::arg("threads") = 0)
        .def("traces", &Loops::traces, nb::arg("reference"), nb::arg("noise"), nb::arg("seeds"),
             nb::arg("measured"), nb::arg("u"), nb::arg("bits") = 512, nb::arg("threads") = 0);
    m.def("run_exact", &run_exact, nb::arg("plant"), nb::arg("decay"), nb::arg("push"),
          nb::arg("state"), nb::arg("pid"), nb::arg("u_before"), nb::arg("line"),
          nb::arg("reference"), nb::arg("noise"), nb::arg("measured"), nb::arg("u"));
    // Widest vectors of this machine, in bits; 0 without a kernel for it.
    m.def("widest", [] {
        return loops_select(512) == nullptr          ? 0
               : loops_select(512) == loops_select(256) ? 256
                                                        : 512;
    });
}
