// The plain data that mlp.cpp and the kernels of one SIMD level exchange.
#pragma once

#include <stddef.h>
#include <stdint.h>

namespace evsplat {

constexpr int kMlpRows = 96;    // points per block; a multiple of every level's tile height
constexpr int kMlpLayers = 16;  // most layers behind the first

// Numbers of columns, each padded to full panels where it counts panels.
struct MlpShape {
    size_t points, times, blocks;
    int lanes, layers;          // layers behind the first, the last one among them
    int per_point, per_both, width, out;
    int point_panels, both_panels, width_panels, out_panels;
    float slope;
    bool keep;

    int columns(int layer) const { return layer + 1 < layers ? width : out; }
    int panels(int layer) const { return layer + 1 < layers ? width_panels : out_panels; }
    size_t panel() const { return size_t(kMlpRows) * lanes; }
    // Activations of one block at one time: `layers` matrices of `width` columns.
    size_t kept() const { return layers * width_panels * panel(); }
};

// A weight (out, in) twice: ready for x W^T and for y W. Biases are padded with zeros.
struct MlpWeight {
    const float *forward;   // (out panels, in, lanes)
    const float *backward;  // (in panels, out, lanes)
    const float *bias;      // (out panels, lanes)
};

struct MlpForward {
    const float *point, *both;
    MlpWeight point_weight, both_weight, layer[kMlpLayers];
    const float* bias;      // (times, width panels, lanes)
    float* activations;     // (blocks, times, kept) or, without keep, unused
    float* output;          // (times, points, out)
};

// Sums of a group of blocks, in panels: weights (in panels, out rows, lanes), biases (out panels, lanes).
struct MlpSums {
    float *point_weight, *both_weight, *bias;  // bias: (times, width panels, lanes)
    float *weight[kMlpLayers], *layer_bias[kMlpLayers];
};

struct MlpBackward {
    MlpForward forward;
    const float* output_grad;           // (times, points, out)
    float *point_grad, *both_grad;      // may be null
};

// Floats of scratch that a block needs.
inline size_t mlp_scratch(const MlpShape& s) {
    const size_t widest = s.point_panels + s.both_panels + s.out_panels + 4 * s.width_panels;
    return widest * s.panel();
}

}  // namespace evsplat
