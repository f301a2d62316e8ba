// The plain data that mlp.cpp and the kernels of AMX exchange, whose registers are tiles of 16 rows.
//
// AMX multiplies bfloat16, which has 8 binary digits. So each float is the sum of two of them, `high` and `low`
// together 16 digits, and a product of floats is three products: high high + high low + low high, summed in float32.
#pragma once

#include <stddef.h>
#include <stdint.h>

#include "mlp_kernels.h"

namespace evsplat {

constexpr int kTileSide = 16;                          // rows of a tile, and floats in each
constexpr int kTilePairs = 2 * kTileSide;              // bfloat16 values in a row of a tile
constexpr size_t kTileValues = kTileSide * kTilePairs; // bfloat16 values in a tile
constexpr int kTileStrip = 32;                         // points that go through all layers in the first cache
constexpr int kTileBlock = 192;                        // points per block
constexpr int kTileSlots = 6;                          // steps of 32 points that sums over points wait for
static_assert(kTileBlock % kTileStrip == 0 && kTileSlots * kTilePairs % kTileStrip == 0, "whole strips");

// Steps of 32 columns, in which products take them.
inline int tile_steps(int columns) { return (columns + kTilePairs - 1) / kTilePairs; }
// Panels of 16 columns, in which products leave them.
inline int tile_panels(int columns) { return (columns + kTileSide - 1) / kTileSide; }

// A weight (out, in) as the right side of x W^T and of y W: (panels, steps, high and low, a tile).
struct TileWeight {
    const uint16_t *forward, *backward;
    const float* bias;  // padded to whole panels
};

struct TileJob : MlpShape {
    const float *point, *both;
    TileWeight point_weight, both_weight, layer[kMlpLayers];
    const float* bias;  // (times, width panels, 16), of the first layer
};

// Bytes of scratch that a block needs.
inline size_t tile_scratch(const TileJob& j) {
    const auto wider = [](int a, int b) { return a > b ? a : b; };
    const int steps = tile_steps(wider(wider(j.width, j.out), wider(j.per_point, j.per_both)));
    // Two matrices of floats and six of two bfloat16, of a strip; both sides of each sum over points.
    const size_t strip = size_t(kTileStrip) * kTilePairs * sizeof(float) * 8;
    const size_t sides = size_t(j.layers + 2) * 2 * kTileSlots * 2 * 2 * kTileValues * sizeof(uint16_t);
    return steps * (strip + sides);
}

struct TileKernels {
    void (*forward)(const TileJob&, size_t block, uint8_t* scratch, float* output);
    // Of the second argument what is above and what is wanted beside the sums.
    void (*backward)(const TileJob&, const MlpBackward&, size_t block, const MlpSums&, uint8_t* scratch);
    // The right side of a product: row k, column n of it is weight[k * k_step + n * n_step].
    void (*pack_weight)(const float* weight, int rows, int columns, size_t k_step, size_t n_step, uint16_t* to);
};

namespace amx {
extern const TileKernels tile_kernels;
}

}  // namespace evsplat
