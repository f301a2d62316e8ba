// One level of the hash grid, compiled once per SIMD level.

#include "kernels.h"

namespace evsplat {
namespace EVSPLAT_LEVEL {
namespace {

#define INLINE static inline __attribute__((always_inline))
constexpr int W = 16;  // points taken together

// The cells of W points: table entries of the corners (bit 2: x, 1: y, 0: z) and the places inside.
struct Cells {
    uint32_t entry[8][W];
    float high[3][W], low[3][W];  // share of the upper and of the lower neighbour along an axis
};

INLINE void find_cells(const HashLevel& job, const float (&position)[3][W], Cells& c) {
    uint32_t at[3][2][W];
    const uint32_t side = uint32_t(job.cells) + 1;
    const uint32_t stride[3] = {1u, job.dense ? side : 2654435761u, job.dense ? side * side : 805459861u};
    for (int axis = 0; axis < 3; ++axis)
        for (int l = 0; l < W; ++l) {
            const float scaled = position[axis][l] * float(job.cells);
            const int32_t whole = int32_t(scaled), last = job.cells - 1;
            const int32_t cell = whole < 0 ? 0 : whole < last ? whole : last;  // 0 for NaN too
            c.high[axis][l] = scaled - float(cell);
            c.low[axis][l] = 1.f - c.high[axis][l];
            at[axis][0][l] = uint32_t(cell) * stride[axis];
            at[axis][1][l] = uint32_t(cell + 1) * stride[axis];
        }
    for (int k = 0; k < 8; ++k) {
        const uint32_t *x = at[0][k >> 2], *y = at[1][k >> 1 & 1], *z = at[2][k & 1];
        if (job.dense) {
            for (int l = 0; l < W; ++l) c.entry[k][l] = x[l] + y[l] + z[l];
        } else {
            for (int l = 0; l < W; ++l) c.entry[k][l] = (x[l] ^ y[l] ^ z[l]) & job.mask;
        }
    }
}

INLINE void corner_shares(const Cells& c, float (&share)[8][W]) {
    for (int k = 0; k < 8; ++k) {
        const float *x = (k & 4 ? c.high : c.low)[0], *y = (k & 2 ? c.high : c.low)[1], *z = (k & 1 ? c.high : c.low)[2];
        for (int l = 0; l < W; ++l) share[k][l] = x[l] * (y[l] * z[l]);
    }
}

// Points [first, first + n); missing ones repeat the last.
INLINE uint32_t load_points(const HashLevel& job, size_t first, float (&position)[3][W]) {
    const uint32_t n = job.points - first < size_t(W) ? uint32_t(job.points - first) : uint32_t(W);
    for (uint32_t l = 0; l < uint32_t(W); ++l)
        for (int axis = 0; axis < 3; ++axis)
            position[axis][l] = job.positions[3 * (first + (l < n ? l : n - 1)) + axis];
    return n;
}

// Calls f(first, n, cells, shares of their corners) for every W points.
template <class F>
INLINE void for_cells(const HashLevel& job, F f) {
    for (size_t first = 0; first < job.points; first += W) {
        float position[3][W], share[8][W];
        const uint32_t n = load_points(job, first, position);
        Cells c;
        find_cells(job, position, c);
        corner_shares(c, share);
        f(first, n, c, share);
    }
}

template <int features>
void forward_of(const HashLevel& job) {
    const int count = features ? features : job.features;
    for_cells(job, [&](size_t first, uint32_t n, const Cells& c, const float (&share)[8][W]) {
        for (int f = 0; f < count; ++f) {
            float total[W] = {};
            for (int k = 0; k < 8; ++k)
                for (int l = 0; l < W; ++l) total[l] += share[k][l] * job.table[size_t(c.entry[k][l]) * count + f];
            for (uint32_t l = 0; l < n; ++l) job.encoded[f * job.points + first + l] = total[l];
        }
    });
}

template <int features>
void backward_of(const HashLevel& job) {
    const int count = features ? features : job.features;
    for_cells(job, [&](size_t first, uint32_t n, const Cells& c, const float (&share)[8][W]) {
        const float* grad = job.encoded_grad + first;
        if (job.table_grad) {
            for (uint32_t l = 0; l < n; ++l)
                for (int k = 0; k < 8; ++k) {
                    float* entry = job.table_grad + size_t(c.entry[k][l]) * count;
                    for (int f = 0; f < count; ++f) entry[f] += share[k][l] * grad[f * job.points + l];
                }
        }
        if (!job.position_grad) return;
        float pull[8][W] = {};
        for (int f = 0; f < count; ++f) {
            float g[W] = {};
            for (uint32_t l = 0; l < n; ++l) g[l] = grad[f * job.points + l];
            for (int k = 0; k < 8; ++k)
                for (int l = 0; l < W; ++l) pull[k][l] += g[l] * job.table[size_t(c.entry[k][l]) * count + f];
        }
        const float scale = float(job.cells);
        for (uint32_t l = 0; l < n; ++l) {
            const float x = c.high[0][l], y = c.high[1][l], z = c.high[2][l];
            float along_z[4], at_z[4];
            for (int k = 0; k < 4; ++k) along_z[k] = pull[2 * k + 1][l] - pull[2 * k][l], at_z[k] = pull[2 * k][l] + z * along_z[k];
            const float low_x = at_z[0] + y * (at_z[1] - at_z[0]), high_x = at_z[2] + y * (at_z[3] - at_z[2]);
            const float along_y = (at_z[1] - at_z[0]) * (1.f - x) + (at_z[3] - at_z[2]) * x;
            const float z_low = along_z[0] + y * (along_z[1] - along_z[0]), z_high = along_z[2] + y * (along_z[3] - along_z[2]);
            float* out = job.position_grad + first + l;
            out[0] = scale * (high_x - low_x);
            out[job.points] = scale * along_y;
            out[2 * job.points] = scale * (z_low + x * (z_high - z_low));
        }
    });
}

}  // namespace

void hash_forward(const HashLevel& job) {
    if (job.features == 2) forward_of<2>(job);
    else forward_of<0>(job);
}

void hash_backward(const HashLevel& job) {
    if (job.features == 2) backward_of<2>(job);
    else backward_of<0>(job);
}

}  // namespace EVSPLAT_LEVEL
}  // namespace evsplat
