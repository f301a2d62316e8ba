// A leaky-ReLU network over points and times; see src/evsplat/deform/mlp.py for the meaning.
//
// All matrices are kept in panels: (columns / lanes, rows, lanes), zero-padded, so that a vector holds
// neighbouring columns of one row and every product is the same small kernel.
#pragma once

#include <vector>

#include "buffer.h"
#include "kernels.h"
#include "tile_mlp_kernels.h"

namespace evsplat {

struct MlpInputs {
    size_t points, times;
    int per_point, per_both, width, out;
    float slope;
    const float* point;         // (points, per_point)
    const float* both;          // (times, points, per_both) or null
    const float* bias;          // (times, width) of the first layer
    const float* point_weight;  // (width, per_point)
    const float* both_weight;   // (width, per_both)
    std::vector<const float*> weights, biases;  // later layers: (out, in) and (out,)
};

// Written, not added to; `point` and `both` may be null.
struct MlpGrads {
    float *point, *both, *bias, *point_weight, *both_weight;
    std::vector<float*> weights, biases;
};

// One evaluation. Sums are in an order that does not depend on the number of threads.
class Mlp {
  public:
    // `keep` stores what `backward` needs. On AMX nothing is stored, `backward` makes it anew.
    Mlp(const MlpInputs& inputs, bool keep, int threads);
    void forward(float* output);
    void backward(const float* output_grad, const MlpGrads& grads);

  private:
    MlpInputs in_;
    int threads_;
    const Kernels& kernels_;
    MlpShape shape_;
    Buffer<float> packed_, activations_;
    MlpForward job_ = {};  // points into the buffers
    Buffer<uint16_t> tiles_;
    TileJob tile_job_ = {};  // the same on AMX
};

}  // namespace evsplat
