// Multi-resolution hash grid (Mueller et al. 2022); see src/evsplat/deform/encodings.py for the meaning.
#pragma once

#include <stddef.h>
#include <stdint.h>

namespace evsplat {

// One level; it works alone, so that sums into its table need no atomics and keep their order.
struct HashLevel {
    size_t points;
    int features, cells;        // values per entry; cells per axis
    bool dense;                 // an entry per vertex; else hashed
    uint32_t mask;              // of hashed entries
    const float* positions;     // (N, 3) in [0, 1]
    const float* table;         // (entries, features)
    float* encoded;             // (features, N), written
    const float* encoded_grad;  // (features, N)
    float* table_grad;          // (entries, features), added to; may be null
    float* position_grad;       // (3, N), written; may be null
};

struct HashGrid {
    size_t points, levels;
    int features;
    const int64_t *cells, *begin;  // (levels), first entry of each level (levels + 1)
    uint32_t mask;
    const float *positions, *table;
};

// encoded: (levels * features, N).
void hash_grid_forward(const HashGrid&, int threads, float* encoded);
// table_grad like the table, added to; position_grad (N, 3), written; either may be null.
void hash_grid_backward(const HashGrid&, int threads, const float* encoded_grad, float* table_grad,
                        float* position_grad);

}  // namespace evsplat
