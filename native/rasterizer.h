// One render of T times and its gradient: splits the work into pieces for the kernels.
//
// Gaussians come in two layers: those that move, with a place per time, and those that stand still.
// The still ones are projected and sorted once; a tile that nothing moving touches is composited once
// for all the times at which that is so. Renders of one still layer by one view can share what is found
// of it (see Still).
#pragma once

#include <atomic>
#include <memory>
#include <vector>

#include "buffer.h"
#include "kernels.h"

namespace evsplat {

// A field with a leading axis of times; `step` = 0 where one value serves all.
template <class T>
struct FieldOf {
    T* data = nullptr;
    size_t step = 0;

    T* at(size_t time) const { return data ? data + time * step : nullptr; }
};

template <class T>
struct LayerOf {
    FieldOf<T> means, quaternions, scales, opacities, values, linear, offset;
};

struct Layer : LayerOf<const float> {
    uint32_t count = 0;
};

using LayerGrads = LayerOf<float>;  // added to; may be null

struct Scene {
    View view;
    int times, channels;
    Layer moving, still;
    const float* background;  // null, (C) or, with background_is_image, (H, W, C)
    bool background_is_image;
    const float* light;       // null or (T, H, W): factor on the first kLitChannels of the still layer and background
};

// A layer at one time: its Gaussians on the screen and their intersections, by tile.
struct Binned {
    Buffer<Projected> projected;
    Buffer<uint32_t> first_slot;   // (N + 1), from 0
    Buffer<uint32_t> tile_begin;   // (tiles + 1)
    Buffer<Entry> entries;         // in a tile that something moving touches: with the still ones
    size_t slots = 0, slot_base = 0;

    uint32_t in_tile(size_t tile) const { return tile_begin[tile + 1] - tile_begin[tile]; }
};

// The still layer on the screen and, if it is kept for renders that follow, its picture in the tiles that
// nothing moving has touched so far. One render at a time.
struct Still {
    Binned binned;
    Buffer<uint8_t> sorted, drawn;  // (tiles)
    Buffer<int32_t> radii;          // (N), if it is kept
    Buffer<float> image, alpha;     // (C, H, W) and (H, W), if it is kept
    bool kept = false;

    size_t bytes() const;
};

// What a render's time goes into.
enum Stage { kProject, kSort, kComposite, kCompositeBackward, kProjectBackward, kStages };

// What the backward pass needs; grows with what is drawn.
struct Record {
    const Kernels* kernels;
    std::shared_ptr<Still> still;  // a kept one has no backward pass
    std::vector<Binned> moving;    // (T)
    // Per picture of a tile (see TileWork); `picture` counts them, per tile.
    Buffer<uint32_t> picture;      // (tiles + 1)
    Buffer<float> final_t;
    Buffer<int32_t> last;
    Buffer<uint32_t> patch_end;
    Buffer<float> unlit;           // (kLitChannels, H, W), the still layer where nothing moves, before a light
    mutable std::atomic<int64_t> nanoseconds[kStages] = {};  // of work, summed over threads

    size_t bytes() const;
    size_t intersections() const;  // pairs of Gaussian and tile that are composited
    size_t patch_steps() const;    // the same with patches
};

// image (T, C, H, W), alpha (T, H, W), radii (T, moving) and still_radii are written. With `keep` the still
// layer is there for later renders; `earlier` is one of an earlier render of the same still layer, view,
// background and number of moving Gaussians, or null.
std::unique_ptr<Record> render_forward(const Scene&, int threads, bool keep, std::shared_ptr<Still> earlier,
                                       float* image, float* alpha, int32_t* radii, int32_t* still_radii);

struct OutputGrads {
    std::vector<PlaneGrad> image, alpha;  // (T, C) and (T); empty: zero
};

struct InputGrads {
    LayerGrads moving, still;
    float* view = nullptr;        // (12), written
    float* background = nullptr;  // (C), written, or (H, W, C), added to
    float* light = nullptr;       // (T, H, W), written; null: not wanted
};

void render_backward(const Scene&, const Record&, int threads, const OutputGrads&, const InputGrads&);

}  // namespace evsplat
