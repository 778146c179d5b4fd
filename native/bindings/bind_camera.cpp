// Python face of native/twin/camera.c: one immutable scene, rendered with the GIL released.
#include <nanobind/nanobind.h>    // module, class
#include <nanobind/ndarray.h>     // numpy arrays without a copy

#include <cstdint>
#include <stdexcept>
#include <vector>

extern "C" {
#include "twin/camera.h"
}

namespace nb = nanobind;
using Doubles = nb::ndarray<const double, nb::ndim<1>, nb::c_contig, nb::device::cpu>;
using Floats = nb::ndarray<const float, nb::ndim<1>, nb::c_contig, nb::device::cpu>;
using Table = nb::ndarray<const double, nb::ndim<2>, nb::c_contig, nb::device::cpu>;
using Levels = nb::ndarray<float, nb::ndim<3>, nb::c_contig, nb::device::cpu>;
using Frames = nb::ndarray<std::uint8_t, nb::ndim<3>, nb::c_contig, nb::device::cpu>;

namespace {

std::vector<float> copied(const Floats &values, std::size_t size, const char *what) {
    if (values.shape(0) != size) throw std::invalid_argument(what);
    return {values.data(), values.data() + size};
}

class Scene {
public:
    Scene(Doubles geometry, Floats illumination_x, Floats illumination_y, Floats clamp_x, Table blobs,
          Floats noise, Floats normal_table, std::uint64_t seed)
        : light_x_(copied(illumination_x, illumination_x.shape(0), "illumination_x")),
          light_y_(copied(illumination_y, illumination_y.shape(0), "illumination_y")),
          clamp_x_(copied(clamp_x, light_x_.size(), "clamp_x: one value a column")),
          table_(copied(normal_table, CAMERA_TABLE_SIZE, "normal_table: 4096 values")) {
        if (geometry.shape(0) != 11) throw std::invalid_argument("geometry: 11 values");
        if (noise.shape(0) != 2) throw std::invalid_argument("noise: gain and read noise");
        if (blobs.shape(1) != 5) throw std::invalid_argument("blobs: 5 columns");
        for (std::size_t i = 0; i < blobs.shape(0); i++) {
            const double *b = blobs.data() + 5 * i;
            if (!(b[3] > 0.0 && b[3] <= CAMERA_SIGMA_MAX_PX))
                throw std::invalid_argument("blobs: sigma in (0, 6] px");
            blobs_.push_back({b[0], b[1], b[2], b[3], b[4]});
        }
        const double *g = geometry.data();
        if (!(g[5] > 0.0 && g[5] <= CAMERA_EDGE_MAX_PX))
            throw std::invalid_argument("geometry: edge in (0, 2] px");
        scene_ = {static_cast<int>(light_x_.size()), static_cast<int>(light_y_.size()),
                  g[0], g[1], g[2], g[3], g[4], g[5], g[6], g[7],
                  static_cast<float>(g[8]), static_cast<float>(g[9]), static_cast<float>(g[10]),
                  light_x_.data(), light_y_.data(), clamp_x_.data(), blobs_.data(), blobs_.size()};
        noise_ = {noise.data()[0], noise.data()[1], seed, table_.data()};
    }
    Scene(const Scene &) = delete;
    Scene &operator=(const Scene &) = delete;

    void expect(Table lengths_px, Levels out) const {
        check(lengths_px, out.shape(0), out.shape(1), out.shape(2));
        const nb::gil_scoped_release release;
        std::vector<float> scratch(camera_scratch_size(&scene_, lengths_px.shape(1)));
        for (std::size_t f = 0; f < lengths_px.shape(0); f++)
            camera_expect(&scene_, lengths_px.data() + f * lengths_px.shape(1), lengths_px.shape(1),
                          scratch.data(), out.data() + f * pixels());
    }

    void render(Table lengths_px, std::uint64_t first_index, Frames out) const {
        check(lengths_px, out.shape(0), out.shape(1), out.shape(2));
        const nb::gil_scoped_release release;
        std::vector<float> scratch(camera_scratch_size(&scene_, lengths_px.shape(1)));
        std::vector<float> level(pixels());
        for (std::size_t f = 0; f < lengths_px.shape(0); f++) {
            camera_expect(&scene_, lengths_px.data() + f * lengths_px.shape(1), lengths_px.shape(1),
                          scratch.data(), level.data());
            camera_expose(level.data(), pixels(), &noise_, first_index + f, out.data() + f * pixels());
        }
    }

private:
    std::size_t pixels() const { return light_x_.size() * light_y_.size(); }

    void check(const Table &lengths_px, std::size_t frames, std::size_t height, std::size_t width) const {
        if (lengths_px.shape(1) == 0) throw std::invalid_argument("lengths_px: no sub-sample");
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
    nb::class_<Scene>(m, "Scene", "A speckled sheet between two clamps, as a camera sees it.")
        .def(nb::init<Doubles, Floats, Floats, Floats, Table, Floats, Floats, std::uint64_t>(),
             nb::kw_only(), nb::arg("geometry"), nb::arg("illumination_x"), nb::arg("illumination_y"),
             nb::arg("clamp_x"), nb::arg("blobs"), nb::arg("noise"), nb::arg("normal_table"),
             nb::arg("seed"),
             "geometry: top, mid, half width, free length (px), neck, edge, clamp inside, clamp outside "
             "(px), background, sheet, clamp (grey). blobs: rows S, X, X|X|^p, sigma, depth.")
        .def("expect", &Scene::expect, nb::arg("lengths_px"), nb::arg("out").noconvert(),
             "Expected levels of each row of lengths, into out (frames, height, width) float32.")
        .def("render", &Scene::render, nb::arg("lengths_px"), nb::arg("first_index"),
             nb::arg("out").noconvert(),
             "Noisy 8-bit frames of each row of lengths, into out (frames, height, width) uint8.");
}
