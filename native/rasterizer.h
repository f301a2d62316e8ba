// One render of T times and its gradient: splits the work into pieces for the kernels.
#pragma once

#include <memory>
#include <vector>

#include "buffer.h"
#include "kernels.h"

namespace evsplat {

// A field with a leading axis of times; `step` = 0 where one value serves all.
struct Field {
    const float* data = nullptr;
    size_t step = 0;
};

struct GradField {
    float* data = nullptr;
    size_t step = 0;
};

struct Scene {
    View view;
    int times, channels;
    uint32_t count;
    Field means, quats, scales, opacities, values, linear, offset;
    Field background;  // step is per channel: (C,) or, with background_is_image, (H, W, C)
    bool background_is_image;
};

// What the backward pass of one time needs; grows with what is drawn.
struct Drawn {
    Buffer<Projected> projected;
    Buffer<uint32_t> first_slot;   // (N + 1)
    Buffer<Entry> entries;
    Buffer<uint32_t> tile_begin;   // (tiles + 1)
    Buffer<uint32_t> patch_end;
    Buffer<float> final_t;
    Buffer<int32_t> last;
};

struct Record {
    const Kernels* kernels;
    std::vector<Drawn> times;
    size_t bytes() const;
};

// image (T, C, H, W), alpha (T, H, W), radii (T, N) are written.
std::unique_ptr<Record> render_forward(const Scene&, int threads, float* image, float* alpha, int32_t* radii);

struct OutputGrads {
    const float *image_data = nullptr, *alpha_data = nullptr;  // null: zero
    ptrdiff_t image[4] = {};  // strides of t, y, x, c
    ptrdiff_t alpha[3] = {};  // strides of t, y, x
};

struct InputGrads {
    GradField means, quats, scales, opacities, values, linear, offset;  // added to; may be null
    float* view = nullptr;        // (12)
    float* background = nullptr;  // (C) or (H, W, C)
};

void render_backward(const Scene&, const Record&, int threads, const OutputGrads&, const InputGrads&);

}  // namespace evsplat
