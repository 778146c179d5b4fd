// Python face of native/twin/camera.c: one immutable scene, rendered with the GIL released.
#include <nanobind/nanobind.h>    // module, class
#include <nanobind/ndarray.h>     // numpy arrays without a copy
#include <nanobind/stl/pair.h>
#include <nanobind/stl/vector.h>

#include <cstdint>
#include <memory>
#include <stdexcept>
#include <utility>
#include <vector>

#include "bindings/records.h"

extern "C" {
#include "twin/camera.h"
}

namespace nb = nanobind;
using Floats = nb::ndarray<const float, nb::ndim<1>, nb::c_contig, nb::device::cpu>;
using Table = nb::ndarray<const double, nb::ndim<2>, nb::c_contig, nb::device::cpu>;
using Levels = nb::ndarray<float, nb::ndim<3>, nb::c_contig, nb::device::cpu>;
using Span = std::pair<int, int>;
using Frames = nb::ndarray<std::uint8_t, nb::ndim<3>, nb::c_contig, nb::device::cpu>;

namespace {

std::vector<float> copied(const Floats &values, std::size_t size, const char *what) {
    if (values.shape(0) != size) throw std::invalid_argument(what);
    return {values.data(), values.data() + size};
}

camera_span inside(const Span &span, int size) {
    if (span.first < 0 || span.first > span.second || span.second > size)
        throw std::invalid_argument("rows and columns: first to stop, inside the frame");
    return {span.first, span.second};
}

class Scene {
public:
    Scene(const camera_scene &geometry, Floats illumination_x, Floats illumination_y,
          Floats clamp_x, nb::object blobs, float shot_gain_grey, float read_noise_grey,
          Floats normal_table, std::uint64_t seed)
        : light_x_(copied(illumination_x, illumination_x.shape(0), "illumination_x")),
          light_y_(copied(illumination_y, illumination_y.shape(0), "illumination_y")),
          clamp_x_(copied(clamp_x, light_x_.size(), "clamp_x: one value a column")),
          table_(copied(normal_table, CAMERA_TABLE_SIZE, "normal_table: 4096 values")) {
        const Records<const camera_blob> given(blobs);
        blobs_.assign(given.data(), given.data() + given.size());
        for (const camera_blob &blob : blobs_)
            if (!(blob.sigma_px > 0.0 && blob.sigma_px <= CAMERA_SIGMA_MAX_PX))
                throw std::invalid_argument("blobs: sigma in (0, 6] px");
        if (!(geometry.edge_px > 0.0 && geometry.edge_px <= CAMERA_EDGE_MAX_PX))
            throw std::invalid_argument("geometry: edge in (0, 2] px");
        scene_ = geometry;
        scene_.width = static_cast<int>(light_x_.size());
        scene_.height = static_cast<int>(light_y_.size());
        scene_.illumination_x = light_x_.data();
        scene_.illumination_y = light_y_.data();
        scene_.clamp_x = clamp_x_.data();
        scene_.blobs = blobs_.data();
        scene_.blob_count = blobs_.size();
        noise_ = {shot_gain_grey, read_noise_grey, seed, table_.data()};
    }
    Scene(const Scene &) = delete;
    Scene &operator=(const Scene &) = delete;

    void expect(Table lengths_px, Levels out) const {
        check(lengths_px, out.shape(0), out.shape(1), out.shape(2));
        const nb::gil_scoped_release release;
        std::vector<float> scratch(camera_scratch_size(&scene_, lengths_px.shape(1)));
        const camera_span columns = {0, scene_.width};
        const camera_part whole = {{0, scene_.height}, &columns, 1};
        for (std::size_t f = 0; f < lengths_px.shape(0); f++)
            camera_expect(&scene_, lengths_px.data() + f * lengths_px.shape(1), lengths_px.shape(1),
                          &whole, scratch.data(), out.data() + f * pixels());
    }

    void render(Table lengths_px, std::uint64_t first_index, Frames out,
                Span rows, const std::vector<Span> &columns) const {
        check(lengths_px, out.shape(0), out.shape(1), out.shape(2));
        std::vector<camera_span> spans;
        for (const Span &span : columns) spans.push_back(inside(span, scene_.width));
        const camera_part part = {inside(rows, scene_.height), spans.data(), spans.size()};
        const nb::gil_scoped_release release;
        std::vector<float> scratch(camera_scratch_size(&scene_, lengths_px.shape(1)));
        const std::unique_ptr<float[]> level(new float[pixels()]);  // most of it may stay untouched
        for (std::size_t f = 0; f < lengths_px.shape(0); f++) {
            camera_expect(&scene_, lengths_px.data() + f * lengths_px.shape(1), lengths_px.shape(1),
                          &part, scratch.data(), level.get());
            camera_expose(&scene_, level.get(), &part, &noise_, first_index + f,
                          out.data() + f * pixels());
        }
    }

private:
    std::size_t pixels() const { return light_x_.size() * light_y_.size(); }

    void check(const Table &lengths_px, std::size_t frames, std::size_t height, std::size_t width) const {
        if (lengths_px.shape(1) == 0 || lengths_px.shape(1) > CAMERA_SAMPLES_MAX)
            throw std::invalid_argument("lengths_px: 1 to 64 sub-samples");
        if (frames != lengths_px.shape(0) || height != light_y_.size() || width != light_x_.size())
            throw std::invalid_argument("out: shape (frames, height, width)");
    }

    std::vector<float> light_x_, light_y_, clamp_x_, table_;
    std::vector<camera_blob> blobs_;
    camera_scene scene_;
    camera_noise noise_;
};

}  // namespace

NB_MODULE(_camera, m) {
    m.doc() = "The twin's camera in C; see native/twin/camera.h.";
    m.attr("BLOB") = dtype_of<camera_blob>(
        {FIELD(camera_blob, along), FIELD(camera_blob, across), FIELD(camera_blob, across_necked),
         FIELD(camera_blob, sigma_px), FIELD(camera_blob, depth_grey)});
    nb::class_<camera_scene>(m, "Geometry", "The numbers of struct camera_scene.")
        .def("__init__",
             [](camera_scene *self, double top_px, double mid_px, double half_width_px,
                double free_length_px, double neck, double edge_px, double clamp_inside_px,
                double clamp_outside_px, float background_grey, float sheet_grey,
                float clamp_grey) {
                 *self = {0, 0, top_px, mid_px, half_width_px, free_length_px, neck, edge_px,
                          clamp_inside_px, clamp_outside_px, background_grey, sheet_grey,
                          clamp_grey, nullptr, nullptr, nullptr, nullptr, 0};
             },
             nb::kw_only(), nb::arg("top_px"), nb::arg("mid_px"), nb::arg("half_width_px"),
             nb::arg("free_length_px"), nb::arg("neck"), nb::arg("edge_px"),
             nb::arg("clamp_inside_px"), nb::arg("clamp_outside_px"), nb::arg("background_grey"),
             nb::arg("sheet_grey"), nb::arg("clamp_grey"));
    nb::class_<Scene>(m, "Scene", "A speckled sheet between two clamps, as a camera sees it.")
        .def(nb::init<const camera_scene &, Floats, Floats, Floats, nb::object, float, float, Floats,
                      std::uint64_t>(),
             nb::kw_only(), nb::arg("geometry"), nb::arg("illumination_x"), nb::arg("illumination_y"),
             nb::arg("clamp_x"), nb::arg("blobs"), nb::arg("shot_gain_grey"),
             nb::arg("read_noise_grey"), nb::arg("normal_table"), nb::arg("seed"))
        .def("expect", &Scene::expect, nb::arg("lengths_px"), nb::arg("out").noconvert(),
             "Expected levels of each row of lengths, into out (frames, height, width) float32.")
        .def("render", &Scene::render, nb::arg("lengths_px"), nb::arg("first_index"),
             nb::arg("out").noconvert(), nb::arg("rows"), nb::arg("columns"),
             "Some rows and columns of noisy 8-bit frames, one for each row of lengths, into out "
             "(frames, height, width) uint8. The other pixels stay.");
}
