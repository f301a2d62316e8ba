#include "hash_grid.h"

#include <algorithm>

#include "buffer.h"
#include "levels.h"
#include "thread_pool.h"

namespace evsplat {
namespace {

HashLevel level_of(const HashGrid& g, size_t level) {
    HashLevel l = {};
    l.points = g.points, l.features = g.features, l.cells = int(g.cells[level]);
    const int64_t vertices = (g.cells[level] + 1) * (g.cells[level] + 1) * (g.cells[level] + 1);
    l.dense = g.begin[level + 1] - g.begin[level] == vertices, l.mask = g.mask;
    l.positions = g.positions, l.table = g.table + g.begin[level] * g.features;
    return l;
}

}  // namespace

void hash_grid_forward(const HashGrid& g, int threads, float* encoded) {
    const Kernels& kernels = select_kernels();
    parallel_for(threads, g.levels, [&](size_t level) {
        HashLevel l = level_of(g, level);
        l.encoded = encoded + level * g.features * g.points;
        kernels.hash_forward(l);
    });
}

void hash_grid_backward(const HashGrid& g, int threads, const float* encoded_grad, float* table_grad,
                        float* position_grad) {
    const Kernels& kernels = select_kernels();
    Buffer<float> parts(position_grad ? g.levels * 3 * g.points : 0);
    parallel_for(threads, g.levels, [&](size_t level) {
        HashLevel l = level_of(g, level);
        l.encoded_grad = encoded_grad + level * g.features * g.points;
        if (table_grad) l.table_grad = table_grad + g.begin[level] * g.features;
        if (position_grad) l.position_grad = parts.data() + level * 3 * g.points;
        kernels.hash_backward(l);
    });
    if (!position_grad) return;
    constexpr size_t kPiece = 4096;
    parallel_for(threads, (g.points + kPiece - 1) / kPiece, [&](size_t piece) {
        for (size_t i = piece * kPiece; i < std::min(g.points, (piece + 1) * kPiece); ++i)
            for (int axis = 0; axis < 3; ++axis) {
                float total = 0.f;
                for (size_t level = 0; level < g.levels; ++level) total += parts[(level * 3 + axis) * g.points + i];
                position_grad[3 * i + axis] = total;
            }
    });
}

}  // namespace evsplat
