// How much neighbours' distances and covariances change between canonical space and posed, with gradients.
#pragma once

#include <stddef.h>
#include <stdint.h>

namespace evsplat {

constexpr int kNeighbours = 4;

// `rows`: (samples, 1 + kNeighbours), a Gaussian and its neighbours. Canonical arrays are (N, ...), posed
// ones (T, N, ...); quaternions (w, x, y, z) of any length.
struct IsometryInputs {
    size_t samples, times, points;
    const int64_t* rows;
    const float *means, *quats, *scales_log;
    const float *posed_means, *posed_quats, *posed_scales, *transforms;  // transforms: (T, N, 16)
};

// Gradients of the two means, added to: `means` of the first, the others of the second.
struct IsometryGrads {
    float *means, *quats, *scales_log;
    float *posed_means, *posed_quats, *posed_scales, *transforms;
};

struct IsometryMeans {
    double centers, covariances;
};

// Means over samples, neighbours and times of the absolute change. Serial: it is short.
IsometryMeans isometry(const IsometryInputs&, const IsometryGrads&);

}  // namespace evsplat
