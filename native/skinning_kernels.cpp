// Blend skinning of a range of points, compiled once per SIMD level.

#include "kernels.h"

namespace evsplat {
namespace EVSPLAT_LEVEL {
namespace {

#include "simd.h"

constexpr int V = 16 / W;  // vectors of a matrix

// to[v] += a b[v]
INLINE void add_matrix(F (&to)[V], float a, const float* b) {
#pragma GCC unroll 4
    for (int v = 0; v < V; ++v) to[v] += a * load(b + v * W);
}

// Calls f(joint) for the joints that a point hangs on: of a surface they are few.
template <class Function>
INLINE void for_joints(const float* weight, size_t joints, Function f) {
    for (size_t j = 0; j < joints; j += W) {
        const uint64_t nothing = bits(load_some(weight + j, joints - j) == 0.f);
        for (uint64_t left = ~nothing & ((uint64_t(1) << W) - 1); left; left &= left - 1) f(j + __builtin_ctzll(left));
    }
}

// Calls f(n, hangs, hangs_end) for points [begin, end) with the joints of `hangs` that each hangs on.
template <class Function>
INLINE void for_points(size_t begin, size_t end, const Hangs* hangs, const uint32_t* ends, Function f) {
    const Hangs* at = hangs;
    for (size_t n = begin; n < end; at = hangs + ends[n++ - begin]) f(n, at, hangs + ends[n - begin]);
}

}  // namespace

void skin(const Skinning& s, size_t begin, size_t end, Hangs* hangs, float* moved, float* blended, float* linear) {
    const size_t alike = s.weight_step ? 1 : s.times;  // times with the same weights
    uint32_t ends[kLookedUp];
    for (size_t first = 0; first < s.times; first += alike)
        for (size_t from = begin, to; from < end; from = to) {
            to = end - from < kLookedUp ? end : from + kLookedUp;
            uint32_t count = 0;
            for (size_t n = from; n < to; ++n) {
                const float* weight = s.weight + first * s.weight_step + n * s.joints;
                for_joints(weight, s.joints, [&](size_t j) { hangs[count++] = {uint32_t(j), weight[j]}; });
                ends[n - from] = count;
            }
            for (size_t t = first; t < first + alike; ++t) {
                const float* bones = s.bones + t * s.joints * 16;
                for_points(from, to, hangs, ends, [&](size_t n, const Hangs* at, const Hangs* last) {
                    F sum[V] = {};
                    for (; at < last; ++at) add_matrix(sum, at->weight, bones + 16 * at->joint);
                    float b[16];
                    __builtin_memcpy(b, sum, sizeof b);
                    __builtin_memcpy(blended + (t * s.points + n) * 16, b, sizeof b);
                    for (int r = 0; linear && r < 3; ++r)
                        __builtin_memcpy(linear + (t * s.points + n) * 9 + 3 * r, b + 4 * r, 3 * sizeof *b);
                    const float* p = s.position + t * s.position_step + n * 3;
                    for (int r = 0; r < 3; ++r)
                        moved[(t * s.points + n) * 3 + r] =
                            b[4 * r] * p[0] + b[4 * r + 1] * p[1] + b[4 * r + 2] * p[2] + b[4 * r + 3];
                });
            }
        }
}

void skin_backward(const Skinning& s, const SkinningGrads& g, const float* blended, size_t begin, size_t end) {
    const bool by_rows = g.weight || g.bones;  // who reads the blended matrix's gradient
    for (size_t t = 0; t < s.times; ++t)
        for (size_t n = begin; n < end; ++n) {
            const float* p = s.position + t * s.position_step + n * 3;
            const float* b = blended + (t * s.points + n) * 16;
            // Rows of the blended matrix's gradient; narrow vectors, which are read back as they were written.
            F4 by_row[4] = {}, by_position = {};
            if (by_rows && g.blended) __builtin_memcpy(by_row, g.blended + (t * s.points + n) * 16, sizeof by_row);
            if (by_rows && g.linear) {
                const float* v = g.linear + (t * s.points + n) * 9;
                for (int r = 0; r < 3; ++r) by_row[r] += F4{v[3 * r], v[3 * r + 1], v[3 * r + 2], 0.f};
            }
            if (g.moved) {
                const float* v = g.moved + (t * s.points + n) * 3;
                const F4 at = {p[0], p[1], p[2], 1.f};
                for (int r = 0; r < 3; ++r) {
                    F4 row;
                    __builtin_memcpy(&row, b + 4 * r, sizeof row);
                    by_row[r] += v[r] * at;
                    by_position += v[r] * row;
                }
            }
            if (g.position) {
                float* out = g.position + t * s.position_step + n * 3;
                for (int c = 0; c < 3; ++c) out[c] = by_position[c] + (t && !s.position_step ? out[c] : 0.f);
            }
            if (g.weight) {
                float by_blended[16];
                __builtin_memcpy(by_blended, by_row, sizeof by_blended);
                const float* columns = g.bones_columns + t * 16 * g.padded_joints;
                float* out = g.weight + t * s.weight_step + n * s.joints;
                for (size_t j = 0; j < s.joints; j += 16) {
                    F sum[V] = {};
#pragma GCC unroll 4
                    for (int i = 0; i < 16; ++i) add_matrix(sum, by_blended[i], columns + i * g.padded_joints + j);
                    float by_weight[16];
                    __builtin_memcpy(by_weight, sum, sizeof by_weight);
                    const size_t count = s.joints - j < 16 ? s.joints - j : 16;
                    for (size_t l = 0; l < count; ++l) out[j + l] = by_weight[l] + (t && !s.weight_step ? out[j + l] : 0.f);
                }
            }
            if (g.bones) {
                const float* weight = s.weight + t * s.weight_step + n * s.joints;
                float* out = g.bones + t * s.joints * 16;
                for_joints(weight, s.joints, [&](size_t j) {
                    for (int r = 0; r < 4; ++r) {
                        F4 row;
                        __builtin_memcpy(&row, out + 16 * j + 4 * r, sizeof row);
                        row += weight[j] * by_row[r];
                        __builtin_memcpy(out + 16 * j + 4 * r, &row, sizeof row);
                    }
                });
            }
        }
}

}  // namespace EVSPLAT_LEVEL
}  // namespace evsplat
