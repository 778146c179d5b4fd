// Python face of track.h: arrays of all points in, poses and results written in place.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

#include <stdexcept>
#include <vector>

extern "C" {
#include "track.h"
}

namespace nb = nanobind;
using Frame = nb::ndarray<nb::ro, nb::ndim<2>, nb::device::cpu>;
using Floats2 = nb::ndarray<const float, nb::ndim<2>, nb::c_contig, nb::device::cpu>;
using Floats3 = nb::ndarray<const float, nb::ndim<3>, nb::c_contig, nb::device::cpu>;
using Poses = nb::ndarray<double, nb::ndim<2>, nb::c_contig, nb::device::cpu>;
using Results = nb::ndarray<float, nb::ndim<2>, nb::c_contig, nb::device::cpu>;
using Which = nb::ndarray<const int, nb::ndim<1>, nb::c_contig, nb::device::cpu>;

namespace {

track_frame view(const Frame &frame) {
    const bool byte = frame.dtype() == nb::dtype<unsigned char>();
    if (!byte && frame.dtype() != nb::dtype<unsigned short>())
        throw std::invalid_argument("frames are uint8 or uint16");
    if (frame.stride(1) != 1) throw std::invalid_argument("pixels of a row must be adjacent");
    return {frame.data(), static_cast<int>(frame.shape(1)), static_cast<int>(frame.shape(0)),
            static_cast<ptrdiff_t>(frame.stride(0)), byte ? 1 : 2};
}

// The templates of all points, one block per part.
class Templates {
  public:
    Templates(Floats2 shape, Floats3 gradient, Floats2 weight, Floats3 inverse, int side)
        : shape_(shape), gradient_(gradient), weight_(weight), inverse_(inverse), side_(side) {
        const size_t count = shape.shape(0), stride = shape.shape(1), m = gradient.shape(1);
        const bool fits = gradient.shape(0) == count && gradient.shape(2) == stride &&
                          weight.shape(0) == count && weight.shape(1) == stride &&
                          inverse.shape(0) == count && inverse.shape(1) == m &&
                          inverse.shape(2) == m;
        if (!fits || (m != 2 && m != 6) || stride % 8 != 0 || side % 2 == 0 || side < 5 ||
            side > TRACK_MAX_SIDE || stride < static_cast<size_t>(side) * static_cast<size_t>(side))
            throw std::invalid_argument("template arrays do not fit together");
    }
    int count() const { return static_cast<int>(shape_.shape(0)); }
    size_t scratch_size() const {
        return track_scratch_size(side_, static_cast<int>(shape_.shape(1)));
    }
    track_template at(int i) const {
        const auto n = static_cast<size_t>(i);
        const size_t stride = shape_.shape(1), m = gradient_.shape(1);
        return {shape_.data() + n * stride, gradient_.data() + n * m * stride,
                weight_.data() + n * stride, inverse_.data() + n * m * m, side_,
                static_cast<int>(stride), static_cast<int>(m)};
    }

  private:
    Floats2 shape_;
    Floats3 gradient_;
    Floats2 weight_;
    Floats3 inverse_;
    int side_;
};

void check(const Templates &templates, const Poses &poses, const Results &results,
           const Which &which) {
    const auto count = static_cast<size_t>(templates.count());
    if (poses.shape(0) != count || poses.shape(1) != 6 || results.shape(0) != count ||
        results.shape(1) != TRACK_RESULTS)
        throw std::invalid_argument("poses and results have one row of six for each point");
    for (size_t k = 0; k < which.shape(0); ++k)
        if (which.data()[k] < 0 || which.data()[k] >= templates.count())
            throw std::out_of_range("point index");
}

track_pose get(const double *p) { return {p[0], p[1], {p[2], p[3], p[4], p[5]}}; }

void put(const track_pose &pose, double *p) {
    p[0] = pose.x;
    p[1] = pose.y;
    for (int k = 0; k < 4; ++k) p[2 + k] = pose.f[k];
}

void refine(const Templates &templates, Frame frame, Poses poses, Results results, Which which,
            int max_iterations, float tolerance_px) {
    check(templates, poses, results, which);
    const track_frame pixels = view(frame);
    const track_settings settings{max_iterations, tolerance_px};
    nb::gil_scoped_release release;
    std::vector<float> scratch(templates.scratch_size());
    for (size_t k = 0; k < which.shape(0); ++k) {
        const int i = which.data()[k];
        const track_template t = templates.at(i);
        track_pose pose = get(poses.data() + 6 * i);
        track_result r;
        track_refine(&pixels, &t, &settings, &pose, &r, scratch.data());
        put(pose, poses.data() + 6 * i);
        float *out = results.data() + TRACK_RESULTS * i;
        out[0] = r.quality, out[1] = r.amplitude, out[2] = r.level;
        out[3] = r.residual, out[4] = r.iterations, out[5] = r.status;
    }
}

void search(const Templates &templates, Frame frame, Poses poses, Results results, Which which,
            int radius) {
    check(templates, poses, results, which);
    if (radius < 0) throw std::invalid_argument("radius must not be negative");
    const track_frame pixels = view(frame);
    nb::gil_scoped_release release;
    std::vector<float> scratch(templates.scratch_size());
    for (size_t k = 0; k < which.shape(0); ++k) {
        const int i = which.data()[k];
        const track_template t = templates.at(i);
        track_pose pose = get(poses.data() + 6 * i);
        results.data()[TRACK_RESULTS * i] =
            track_search(&pixels, &t, radius, &pose, scratch.data());
        put(pose, poses.data() + 6 * i);
    }
}

}  // namespace

NB_MODULE(_track, m) {
    m.doc() = "Subset tracking kernels; the manual is native/track.h.";
    nb::class_<Templates>(m, "Templates", "Templates of all points.")
        .def(nb::init<Floats2, Floats3, Floats2, Floats3, int>(), nb::arg("shape"),
             nb::arg("gradient"), nb::arg("weight"), nb::arg("inverse"), nb::arg("side"));
    m.def("refine", &refine, nb::arg("templates"), nb::arg("frame"), nb::arg("poses").noconvert(),
          nb::arg("results").noconvert(), nb::arg("which"), nb::arg("max_iterations"),
          nb::arg("tolerance_px"), "Gauss-Newton at the points `which`.");
    m.def("search", &search, nb::arg("templates"), nb::arg("frame"), nb::arg("poses").noconvert(),
          nb::arg("results").noconvert(), nb::arg("which"), nb::arg("radius"),
          "Whole-pixel search at the points `which`.");
}
