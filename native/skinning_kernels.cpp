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

}  // namespace

void skin(const Skinning& s, size_t begin, size_t end, float* moved, float* blended) {
    for (size_t t = 0; t < s.times; ++t) {
        const float* bones = s.bones + t * s.joints * 16;
        for (size_t n = begin; n < end; ++n) {
            const float* weight = s.weight + t * s.weight_step + n * s.joints;
            F sum[V] = {};
            for (size_t j = 0; j < s.joints; ++j) add_matrix(sum, weight[j], bones + 16 * j);
            float b[16];
            __builtin_memcpy(b, sum, sizeof b);
            __builtin_memcpy(blended + (t * s.points + n) * 16, b, sizeof b);
            const float* p = s.position + t * s.position_step + n * 3;
            for (int r = 0; r < 3; ++r)
                moved[(t * s.points + n) * 3 + r] = b[4 * r] * p[0] + b[4 * r + 1] * p[1] + b[4 * r + 2] * p[2] + b[4 * r + 3];
        }
    }
}

void skin_backward(const Skinning& s, const SkinningGrads& g, const float* blended, size_t begin, size_t end) {
    for (size_t n = begin; n < end; ++n)
        for (size_t t = 0; t < s.times; ++t) {
            const float* p = s.position + t * s.position_step + n * 3;
            const float* b = blended + (t * s.points + n) * 16;
            float by_blended[16] = {}, by_position[3] = {};
            if (g.blended) __builtin_memcpy(by_blended, g.blended + (t * s.points + n) * 16, sizeof by_blended);
            if (g.moved) {
                const float* v = g.moved + (t * s.points + n) * 3;
                for (int r = 0; r < 3; ++r) {
                    for (int c = 0; c < 3; ++c) {
                        by_blended[4 * r + c] += v[r] * p[c];
                        by_position[c] += v[r] * b[4 * r + c];
                    }
                    by_blended[4 * r + 3] += v[r];
                }
            }
            if (g.position) {
                float* out = g.position + t * s.position_step + n * 3;
                for (int c = 0; c < 3; ++c) out[c] = by_position[c] + (t && !s.position_step ? out[c] : 0.f);
            }
            if (g.weight) {
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
                for (size_t j = 0; j < s.joints; ++j)
#pragma GCC ivdep
                    for (int i = 0; i < 16; ++i) out[16 * j + i] += weight[j] * by_blended[i];
            }
        }
}

}  // namespace EVSPLAT_LEVEL
}  // namespace evsplat
