// Linear blend skinning with its gradient: points moved by the weighted mean of bone transforms.
#pragma once

#include <stddef.h>
#include <stdint.h>

namespace evsplat {

// Steps are floats from one time to the next, zero where all times share one array.
struct Skinning {
    size_t times, points, joints;
    const float *position, *weight;         // (T or 1, N, 3), (T or 1, N, J)
    size_t position_step, weight_step;
    const float* bones;                     // (T, J, 16), row-major 4x4
};

// A joint that a point hangs on.
struct Hangs {
    uint32_t joint;
    float weight;
};

constexpr size_t kLookedUp = 64;  // points whose joints are looked up once for all times

// What a block of points does; `bones_columns` are the bones as (T, 12, padded J).
struct SkinningGrads {
    const float *moved, *blended, *linear;  // gradients of the results: (T, N, 3), (T, N, 16), (T, N, 9); may be null
    float *position, *weight;               // like the inputs, written; may be null
    float* bones;                           // (T, J, 16); a block adds to its own; may be null
    const float* bones_columns;
    size_t padded_joints;
};

// `linear` is null or takes the blended matrices' 3x3 parts.
void skin(const Skinning&, int threads, float* moved, float* blended, float* linear);

// `blended` as `skin` wrote it; `bones` of the gradients is the whole sum, written.
void skin_backward(const Skinning&, const float* blended, SkinningGrads, int threads);

}  // namespace evsplat
