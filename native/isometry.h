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
    const float *means, *quaternions, *scales_log;
    const float *posed_means, *posed_quaternions, *posed_scales, *transforms;  // transforms: (T, N, 16)
};

// Gradients of the two means: `means` of the first, the others of the second.
struct IsometryGrads {
    size_t canonical_points;  // at least as many as posed ones
    float *means, *quaternions, *scales_log;
    float *posed_means, *posed_quaternions, *posed_scales, *transforms;
};

struct IsometryMeans {
    double centers, covariances;
};

// Floats of the gradients of one sample's rows.
size_t isometry_floats(size_t times);

// Means over samples, neighbours and times of the absolute change. Writes the gradients by the rows of each
// sample, (samples, isometry_floats).
IsometryMeans isometry(const IsometryInputs&, int threads, float* gradients);

// Writes them, times those of the two means, summed by the rows they belong to, with zeros elsewhere; of the inputs only
// `rows` are read.
void isometry_write(const IsometryInputs&, const float* gradients, float by_centers, float by_covariances, int threads,
                    const IsometryGrads&);

}  // namespace evsplat
