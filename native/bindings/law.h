// The table of an actuator law, from arrays.
#ifndef HASELAB_LAW_H
#define HASELAB_LAW_H

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

#include <cstring>
#include <stdexcept>

extern "C" {
#include "motion/motion.h"
}

using Values = nanobind::ndarray<nanobind::numpy, const double, nanobind::ndim<1>,
                                 nanobind::c_contig, nanobind::device::cpu>;
using Rows = nanobind::ndarray<nanobind::numpy, const double, nanobind::ndim<2>,
                               nanobind::c_contig, nanobind::device::cpu>;

// Rows are voltages, columns lengths.
inline void fill_law(motion_law &law, double low_m, double step_m, double step_v, Values elastic_n,
                     Values gap_m, Rows capacitance_f, Rows pull_n_v2)
{
    const size_t n = elastic_n.size(), rows = capacitance_f.shape(0);
    if (n < 4 || n > MOTION_LENGTHS || gap_m.size() != n || capacitance_f.shape(1) != n ||
        pull_n_v2.shape(1) != n || pull_n_v2.shape(0) != rows || rows > MOTION_VOLTAGES ||
        (rows != 1 && rows < 4) || !(step_m > 0.0) || !(step_v > 0.0)) {
        throw std::invalid_argument("4 to 1024 lengths, 1 or 4 to 129 voltages, one grid");
    }
    law.lengths = static_cast<int32_t>(n);
    law.voltages = static_cast<int32_t>(rows);
    law.low_m = low_m;
    law.step_m = step_m;
    law.step_v = step_v;
    law.per_step_m = 1.0 / step_m;
    law.per_step_v = 1.0 / step_v;
    std::memcpy(law.elastic_n, elastic_n.data(), n * sizeof(double));
    std::memcpy(law.gap_m, gap_m.data(), n * sizeof(double));
    for (size_t k = 0; k < rows; ++k) {
        std::memcpy(law.capacitance_f[k], capacitance_f.data() + k * n, n * sizeof(double));
        std::memcpy(law.pull_n_v2[k], pull_n_v2.data() + k * n, n * sizeof(double));
    }
}

#endif
