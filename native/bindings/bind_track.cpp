// Python face of track_step.h: arrays of all points in, the next frame's arrays written in place.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/pair.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/vector.h>

#include <memory>
#include <stdexcept>
#include <string>
#include <vector>

#include "bindings/records.h"

extern "C" {
#include "tracking/track_step.h"
}

namespace nb = nanobind;
using Frame = nb::ndarray<nb::ro, nb::ndim<2>, nb::device::cpu>;
template <typename T, size_t N>
using Array = nb::ndarray<const T, nb::ndim<N>, nb::c_contig, nb::device::cpu>;
template <typename T, size_t N>
using Out = nb::ndarray<T, nb::ndim<N>, nb::c_contig, nb::device::cpu>;

namespace {

track_frame view(const Frame &frame, int bits) {
    const bool byte = frame.dtype() == nb::dtype<unsigned char>();
    if (!byte && frame.dtype() != nb::dtype<unsigned short>())
        throw std::invalid_argument("frames are uint8 or uint16");
    if (frame.stride(1) != 1) throw std::invalid_argument("pixels of a row must be adjacent");
    if (bits < 8 || bits > (byte ? 8 : 16)) throw std::invalid_argument("bits of a pixel");
    return {frame.data(), static_cast<int>(frame.shape(1)), static_cast<int>(frame.shape(0)),
            static_cast<ptrdiff_t>(frame.stride(0)), byte ? 1 : 2, bits};
}

const track_kernels *kernels_named(const std::string &name) {
    const track_kernels *kernels = track_select(name.c_str());
    if (!kernels) throw std::invalid_argument("this machine does not run the kernels " + name);
    return kernels;
}

std::vector<std::string> kernels() {
    std::vector<std::string> names;
    for (const char *name : {"avx512", "avx2", "portable"})
        if (track_select(name)) names.emplace_back(name);
    return names;
}

// Memory of one thread, kept from frame to frame.
void *scratch(size_t bytes) {
    thread_local std::unique_ptr<char[]> memory;
    thread_local size_t size = 0;
    if (bytes > size) {
        memory.reset(new char[bytes]);
        size = bytes;
    }
    return memory.get();
}

// The reference of all points: templates, places, noise, neighbours.
class Points {
  public:
    Points(Array<float, 2> shape, Array<float, 3> gradient, Array<float, 3> inverse,
           Array<float, 2> place, Array<double, 2> centre, Array<double, 2> offset,
           Array<double, 2> base, nb::object noise, Array<float, 1> white, Array<int, 2> near,
           Array<double, 3> lever, Array<double, 3> weights, Array<double, 2> smooth,
           Array<double, 3> rough, int side)
        : shape_(shape), gradient_(gradient), inverse_(inverse), place_(place), centre_(centre),
          offset_(offset), base_(base), white_(white), near_(near), lever_(lever),
          weights_(weights), smooth_(smooth),
          rough_(rough) {
        const Records<const track_noise> given(noise);
        noise_.assign(given.data(), given.data() + given.size());
        const size_t n = shape.shape(0), stride = shape.shape(1), m = inverse.shape(1);
        const size_t k = near.shape(1), pixels = static_cast<size_t>(side) * side;
        const bool templates = gradient.shape(0) == n && gradient.shape(1) == 2 &&
                               gradient.shape(2) == stride && inverse.shape(0) == n &&
                               inverse.shape(2) == m && place.shape(0) == 2 &&
                               place.shape(1) == stride && (m == 2 || m == 6);
        const bool places = centre.shape(0) == n && centre.shape(1) == 2 && offset.shape(0) == n &&
                            offset.shape(1) == 2 && base.shape(0) == n && base.shape(1) == 4 &&
                            noise_.size() == n &&
                            white.shape(0) == TRACK_WHITE_STEPS + 1;
        const bool around =
            k == 0 || (k <= 32 && near.shape(0) == n && lever.shape(0) == n &&
                       lever.shape(1) == k && lever.shape(2) == 2 && weights.shape(0) == n &&
                       weights.shape(1) == 2 && weights.shape(2) == k && smooth.shape(0) == n &&
                       smooth.shape(1) == k + 1 && rough.shape(0) == n && rough.shape(1) == 2 &&
                       rough.shape(2) == k + 1);
        if (!templates || !places || !around || stride % 16 != 0 || side % 2 == 0 || side < 5 ||
            side > TRACK_MAX_SIDE || stride < pixels || stride >= pixels + 16)
            throw std::invalid_argument("the arrays of the points do not fit together");
        for (size_t i = 0; i < near.size(); ++i)
            if (near.data()[i] < 0 || static_cast<size_t>(near.data()[i]) >= n)
                throw std::out_of_range("index of a neighbour");
        view_ = {static_cast<int>(n), side, static_cast<int>(stride), static_cast<int>(m),
                 shape_.data(), gradient_.data(), inverse_.data(), place_.data(), centre_.data(),
                 offset_.data(), base_.data(), noise_.data(), white_.data(), static_cast<int>(k),
                 near_.data(), lever_.data(), weights_.data(), smooth_.data(), rough_.data()};
    }
    const track_points &view() const { return view_; }

  private:
    Array<float, 2> shape_;
    Array<float, 3> gradient_, inverse_;
    Array<float, 2> place_;
    Array<double, 2> centre_, offset_, base_;
    std::vector<track_noise> noise_;
    Array<float, 1> white_;
    Array<int, 2> near_;
    Array<double, 3> lever_, weights_;
    Array<double, 2> smooth_;
    Array<double, 3> rough_;
    track_points view_{};
};

track_found found_in(double *position, double *std, double *quality, size_t n) {
    return {position, position + n, std, std + n, quality};
}

track_summary step(const Points &points, const track_rules &rules, Frame frame, int bits,
          nb::object poses_before, Array<double, 2> velocity, Array<unsigned char, 1> reasons,
          Array<double, 1> gain, nb::object poses_after, Out<double, 2> next_velocity,
          Out<unsigned char, 1> next_reasons, Out<double, 1> next_gain, Out<double, 2> position,
          Out<double, 2> std, Out<double, 1> quality, const std::string &kernels) {
    const Records<const track_pose> poses(poses_before);
    const Records<track_pose> next_poses(poses_after);
    const track_points &p = points.view();
    const auto n = static_cast<size_t>(p.count);
    const auto is = [](const auto &a, size_t rows, size_t columns) {
        return a.shape(0) == rows && a.shape(1) == columns;
    };
    if (poses.size() != n || !is(velocity, n, 2) || next_poses.size() != n ||
        !is(next_velocity, n, 2) || !is(position, 2, n) || !is(std, 2, n) || reasons.shape(0) != n ||
        next_reasons.shape(0) != n || quality.shape(0) != n || gain.shape(0) != 1 ||
        next_gain.shape(0) != 1 || poses.data() == next_poses.data())
        throw std::invalid_argument("the state does not fit the points");
    const track_frame pixels = view(frame, bits);
    const track_kernels *chosen = kernels_named(kernels);
    // the C side only reads what comes before
    const track_memory before{const_cast<track_pose *>(poses.data()),
                              const_cast<double *>(velocity.data()),
                              const_cast<unsigned char *>(reasons.data()),
                              const_cast<double *>(gain.data())};
    const track_memory after{next_poses.data(), next_velocity.data(), next_reasons.data(),
                             next_gain.data()};
    const track_found out = found_in(position.data(), std.data(), quality.data(), n);
    nb::gil_scoped_release release;
    return track_step(chosen, &p, &rules, &pixels, &before, &after, &out,
                      scratch(track_step_size(&p, &pixels, rules.search_px)));
}

void samples(const Points &points, Frame frame, int bits, nb::object at, Out<float, 2> out,
             const std::string &kernels) {
    const Records<const track_pose> poses(at);
    const track_points &p = points.view();
    const auto n = static_cast<size_t>(p.count);
    if (poses.size() != n || out.shape(0) != n ||
        out.shape(1) != static_cast<size_t>(p.stride))
        throw std::invalid_argument("the poses or the samples do not fit the points");
    const track_frame pixels = view(frame, bits);
    const track_kernels *chosen = kernels_named(kernels);
    nb::gil_scoped_release release;
    track_samples(chosen, &p, &pixels, poses.data(), out.data(), scratch(track_scratch_size(p.side)));
}

std::pair<float, int> audit(const Points &points, Array<double, 2> position, Array<double, 2> std) {
    const auto n = static_cast<size_t>(points.view().count);
    if (position.shape(0) != 2 || position.shape(1) != n || std.shape(0) != 2 || std.shape(1) != n)
        throw std::invalid_argument("the positions do not fit the points");
    auto *moves = static_cast<double *>(scratch(4 * sizeof(double) * n));
    // the audit only reads them
    const track_found found = found_in(const_cast<double *>(position.data()),
                                       const_cast<double *>(std.data()), nullptr, n);
    const track_audit made = track_audit_frame(&points.view(), &found, moves);
    return {made.ratio, made.numbers};
}

void coefficients(Frame frame, int bits, Out<short, 2> out, const std::string &kernels) {
    if (out.shape(0) != frame.shape(0) || out.shape(1) != frame.shape(1))
        throw std::invalid_argument("one coefficient for each pixel");
    const track_frame pixels = view(frame, bits);
    const track_kernels *chosen = kernels_named(kernels);
    track_patch patch;
    auto *memory =
        static_cast<int16_t *>(scratch(track_coefficients_size(pixels.width, pixels.height)));
    track_filter_frame(chosen, &pixels, memory, &patch);
    for (int y = 0; y < pixels.height; ++y)
        for (int x = 0; x < pixels.width; ++x)
            out(static_cast<size_t>(y), static_cast<size_t>(x)) =
                patch.values[static_cast<ptrdiff_t>(y - patch.top) * patch.pitch + x - patch.left];
}

}  // namespace

NB_MODULE(_track, m) {
    m.doc() = "Tracking of many points in a frame; the manuals are native/tracking/track.h, track_step.h.";
    nb::class_<track_rules>(m, "Rules", "struct track_rules.")
        .def("__init__",
             [](track_rules *self, int max_iterations, float tolerance_px, float minimum_quality,
                float jump_px, float most_residual, float most_gain, int search_px, bool noise_known,
                float noise_floor, float noise_slope) {
                 if (max_iterations < 1 || search_px < 0)
                     throw std::invalid_argument("max_iterations, search_px");
                 *self = {{max_iterations, tolerance_px}, minimum_quality, jump_px, most_residual,
                          most_gain, search_px, noise_known, noise_floor, noise_slope};
             },
             nb::kw_only(), nb::arg("max_iterations"), nb::arg("tolerance_px"),
             nb::arg("minimum_quality"), nb::arg("jump_px"), nb::arg("most_residual"), nb::arg("most_gain"),
             nb::arg("search_px"), nb::arg("noise_known"), nb::arg("noise_floor"),
             nb::arg("noise_slope"));
    nb::class_<Points>(m, "Points", "struct track_points.")
        .def(nb::init<Array<float, 2>, Array<float, 3>, Array<float, 3>, Array<float, 2>,
                      Array<double, 2>, Array<double, 2>, Array<double, 2>, nb::object,
                      Array<float, 1>, Array<int, 2>, Array<double, 3>, Array<double, 3>,
                      Array<double, 2>, Array<double, 3>, int>(),
             nb::kw_only(), nb::arg("shape"), nb::arg("gradient"), nb::arg("inverse"),
             nb::arg("place"), nb::arg("centre"), nb::arg("offset"), nb::arg("base"),
             nb::arg("noise"), nb::arg("white"), nb::arg("near"), nb::arg("lever"),
             nb::arg("weights"), nb::arg("smooth"), nb::arg("rough"),
             nb::arg("side"));
    nb::class_<track_summary>(m, "Summary", "struct track_summary.")
        .def_ro("due", &track_summary::due)
        .def_ro("believed", &track_summary::believed)
        .def_ro("strayed", &track_summary::strayed)
        .def_ro("newly_lost", &track_summary::newly_lost)
        .def_ro("believed_before", &track_summary::believed_before)
        .def_ro("ambiguous", &track_summary::ambiguous)
        .def_ro("surprise_px", &track_summary::surprise_px)
        .def_ro("most_surprise_px", &track_summary::most_surprise_px)
        .def_ro("unevenness", &track_summary::unevenness)
        .def_ro("largest_std_px", &track_summary::largest_std_px)
        .def_ro("reach_px", &track_summary::reach_px)
        .def_prop_ro("audit", [](const track_summary &s) {
            return std::pair<float, int>{s.audit.ratio, s.audit.numbers};
        });
    m.attr("POSE") = dtype_of<track_pose>({{"centre_px", "(2,)f8", offsetof(track_pose, x)},
                                           {"deformation", "(2,2)f8", offsetof(track_pose, f)}});
    m.attr("NOISE") = dtype_of<track_noise>(
        {FIELD(track_noise, even), FIELD(track_noise, shaped), FIELD(track_noise, reference),
         FIELD(track_noise, norm), FIELD(track_noise, level), FIELD(track_noise, residual_share),
         FIELD(track_noise, averaged)});
    m.def("audit", &audit, nb::arg("points"), nb::arg("position"), nb::arg("std"),
          "Mean square of the scatter about a smooth field over that stated, and of how many.");
    m.def("samples", &samples, nb::arg("points"), nb::arg("frame"), nb::arg("bits"),
          nb::arg("poses"), nb::arg("out").noconvert(), nb::arg("kernels") = "",
          "Grey levels at the samples of all subsets, less half the range; NaN over the edge.");
    m.def("step", &step, nb::arg("points"), nb::arg("rules"), nb::arg("frame"), nb::arg("bits"),
          nb::arg("poses"), nb::arg("velocity"), nb::arg("reasons"),
          nb::arg("gain"), nb::arg("next_poses"),
          nb::arg("next_velocity").noconvert(), nb::arg("next_reasons").noconvert(),
          nb::arg("next_gain").noconvert(), nb::arg("position").noconvert(),
          nb::arg("std").noconvert(), nb::arg("quality").noconvert(), nb::arg("kernels") = "",
          "All points in the next frame; writes the arrays from next_poses on.");
    m.def("coefficients", &coefficients, nb::arg("frame"), nb::arg("bits"),
          nb::arg("out").noconvert(), nb::arg("kernels") = "", "Spline coefficients of a frame.");
    m.def("kernels", &kernels, "The kernels that this machine runs, the fastest first.");
}
