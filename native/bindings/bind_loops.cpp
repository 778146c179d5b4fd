// Python face of native/loops/loops.c: haselab._loops.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

#include <algorithm>
#include <cstdlib>
#include <memory>
#include <new>
#include <numeric>
#include <stdexcept>
#include <thread>
#include <vector>

#include "bindings/records.h"
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

// A loop as Python gives it, every number a double; see struct loops_loop and plants/held.py.
struct Row {
    double free[4], push[2], feed, slow_decay[LOOPS_SLOW], slow_push[LOOPS_SLOW];
    double start[2], slow_start[LOOPS_SLOW];
    double kp, ki, kd, filter_s, u_low, u_high;
    double u, rest, delay, noise_std;
};

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

loops_loop loop_of(const Row &row, float period_s)
{
    const auto single = [](double number) { return static_cast<float>(number); };
    loops_loop loop;
    loop.plant = {row.free[0], row.free[1], row.free[2], row.free[3], row.push[0], row.push[1],
                  row.feed,    {},          {}};
    loop.start = {row.start[0], row.start[1], {}};
    std::copy_n(row.slow_decay, LOOPS_SLOW, loop.plant.decay);
    std::copy_n(row.slow_push, LOOPS_SLOW, loop.plant.push);
    std::copy_n(row.slow_start, LOOPS_SLOW, loop.start.slow);
    loop.pid = {single(row.kp),    single(row.ki),
                single(row.kd),    period_s,
                period_s / (period_s + single(row.filter_s)),
                single(row.u_low), single(row.u_high)};
    loop.u = single(row.u);
    loop.rest = single(row.rest);
    loop.delay = static_cast<uint32_t>(row.delay);
    loop.noise_std = single(row.noise_std);
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
        for (size_t i = count_; i % lanes != 0; ++i) { // unused lanes
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
            const size_t lane = i % lanes;
            job_.summaries[order_[i] * job_.task.stretches + stretch] = {
                group.error_sum[lane], group.top[lane], group.bottom[lane],
                group.last_outside[lane], group.limited[lane]};
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

// One loop in double; `state` and `line` are used up.
void run_exact(Doubles free, Doubles push, double feed, Doubles slow_decay, Doubles slow_push,
               Doubles state, const loops_exact_pid &pid, double u_before, Doubles line,
               Doubles reference, Doubles noise, Doubles measured, Doubles u)
{
    const size_t samples = reference.shape(0), slow = slow_decay.shape(0);
    if (free.shape(0) != 4 || push.shape(0) != 2 || slow_push.shape(0) != slow ||
        state.shape(0) != 2 + slow || line.shape(0) == 0 || samples == 0 ||
        noise.shape(0) != samples || measured.shape(0) != samples || u.shape(0) != samples) {
        throw std::invalid_argument("shapes of the loop do not belong together");
    }
    const loops_exact loop = {free(0), free(1), free(2), free(3), push(0), push(1), feed,
                              slow_decay.data(), slow_push.data(), state.data(), slow, pid,
                              u_before, line.data(), line.shape(0)};
    loops_run_exact(&loop, reference.data(), noise.data(), samples, measured.data(), u.data());
}

using Reference = Array<const float, 1>;
using Noise = Array<const float, 2>;
using Seeds = Array<const uint32_t, 1>;

// Loops that are ready to run. `noise`: (B, N) or empty. `seeds`: of the samples and of the loops
// for noise that is generated, or empty. `bits`: of the vectors at most, 0 for one loop after the
// other; changes no bit of the result.
class Loops {
  public:
    Loops(nb::object table, float period_s, size_t branches)
        : branches_(static_cast<unsigned>(branches))
    {
        const Records<const Row> rows(table);
        if (rows.size() == 0 || branches > LOOPS_SLOW) {
            throw std::invalid_argument("the table does not fit the loops");
        }
        for (size_t b = 0; b < rows.size(); ++b) {
            const Row &row = rows.data()[b];
            if (!(row.delay >= 1.0 && row.delay < 1u << 20)) {
                throw std::invalid_argument("a delay is outside [1, 2^20) samples");
            }
            loops_.push_back(loop_of(row, period_s));
        }
    }

    void summaries(Reference reference, Noise noise, Seeds seeds, float band,
                   Array<const uint64_t, 1> ends, nb::object summaries, int bits, size_t threads)
    {
        const Records<loops_summary> out(summaries);
        Job job = job_of(reference, noise, seeds);
        const std::vector<size_t> stretches(ends.data(), ends.data() + ends.shape(0));
        if (stretches.empty() || stretches.back() != job.samples ||
            !std::is_sorted(stretches.begin(), stretches.end()) ||
            out.shape(0) != loops_.size() || out.shape(1) != stretches.size()) {
            throw std::invalid_argument("the stretches do not fit the reference or the output");
        }
        job.task.ends = stretches.data();
        job.task.stretches = stretches.size();
        job.task.band = band;
        job.summaries = out.data();
        nb::gil_scoped_release free_gil;
        run(job, bits, threads);
    }

    void traces(Reference reference, Noise noise, Seeds seeds, Array<float, 2> measured,
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
    Job job_of(const Reference &reference, const Noise &noise, const Seeds &seeds) const
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
    nb::set_leak_warnings(false); // objects that exist until the interpreter ends are not leaks
    m.doc() = "Closed loops with the core's controller, many at a time";
    m.attr("LOOP") = dtype_of<Row>(
        {FIELD(Row, free), FIELD(Row, push), FIELD(Row, feed), FIELD(Row, slow_decay),
         FIELD(Row, slow_push), FIELD(Row, start), FIELD(Row, slow_start), FIELD(Row, kp),
         FIELD(Row, ki), FIELD(Row, kd), FIELD(Row, filter_s), FIELD(Row, u_low),
         FIELD(Row, u_high), FIELD(Row, u), FIELD(Row, rest), FIELD(Row, delay),
         FIELD(Row, noise_std)});
    m.attr("SUMMARY") = dtype_of<loops_summary>(
        {FIELD(loops_summary, error_sum), FIELD(loops_summary, top), FIELD(loops_summary, bottom),
         FIELD(loops_summary, last_outside), FIELD(loops_summary, limited)});
    m.attr("SLOW") = static_cast<size_t>(LOOPS_SLOW);
    nb::class_<Loops>(m, "Loops")
        .def(nb::init<nb::object, float, size_t>(), nb::arg("table"), nb::arg("period_s"),
             nb::arg("branches"))
        .def("summaries", &Loops::summaries, nb::arg("reference"), nb::arg("noise"),
             nb::arg("seeds"), nb::arg("band"), nb::arg("ends"), nb::arg("out"),
             nb::arg("bits") = 512, nb::arg("threads") = 0)
        .def("traces", &Loops::traces, nb::arg("reference"), nb::arg("noise"), nb::arg("seeds"),
             nb::arg("measured"), nb::arg("u"), nb::arg("bits") = 512, nb::arg("threads") = 0);
    nb::class_<loops_exact_pid>(m, "ExactPid")
        .def(
            "__init__",
            [](loops_exact_pid *self, double kp, double ki, double kd, double period_s,
               double filter_constant, double u_low, double u_high) {
                *self = {kp, ki, kd, period_s, filter_constant, u_low, u_high};
            },
            nb::kw_only(), nb::arg("kp"), nb::arg("ki"), nb::arg("kd"), nb::arg("period_s"),
            nb::arg("filter_constant"), nb::arg("u_low"), nb::arg("u_high"));
    m.def("run_exact", &run_exact, nb::kw_only(), nb::arg("free"), nb::arg("push"),
          nb::arg("feed"), nb::arg("slow_decay"), nb::arg("slow_push"), nb::arg("state"),
          nb::arg("pid"), nb::arg("u_before"), nb::arg("line"), nb::arg("reference"),
          nb::arg("noise"), nb::arg("measured"), nb::arg("u"));
    // Widest vectors of this machine, in bits; 0 without a kernel for it.
    m.def("widest", [] {
        return loops_select(512) == nullptr          ? 0
               : loops_select(512) == loops_select(256) ? 256
                                                        : 512;
    });
}
