#include "skinning.h"

#include <algorithm>

#include "buffer.h"
#include "levels.h"
#include "thread_pool.h"

namespace evsplat {

static constexpr size_t kPoints = 512;  // of a block; fixes the order of sums over points
static constexpr size_t kLanes = 16;

void skin(const Skinning& s, int threads, float* moved, float* blended, float* linear) {
    const auto kernel = select_kernels().skin;
    in_pieces(threads, s.points, kPoints, [&](size_t begin, size_t end) {
        Buffer<Hangs> hangs(kLookedUp * s.joints);
        kernel(s, begin, end, hangs.data(), moved, blended, linear);
    });
}

void skin_backward(const Skinning& s, const float* blended, SkinningGrads g, int threads) {
    const size_t blocks = (s.points + kPoints - 1) / kPoints, bones = s.times * s.joints * 16;
    g.padded_joints = (s.joints + kLanes - 1) / kLanes * kLanes;
    Buffer<float> columns(s.times * 16 * g.padded_joints);
    for (size_t t = 0; t < s.times; ++t)
        for (size_t i = 0; i < 16; ++i)
            for (size_t j = 0; j < g.padded_joints; ++j)
                columns[(t * 16 + i) * g.padded_joints + j] = j < s.joints ? s.bones[(t * s.joints + j) * 16 + i] : 0.f;
    g.bones_columns = columns.data();
    float* total = g.bones;
    Buffer<float> sums(total ? blocks * bones : 0);
    const auto kernel = select_kernels().skin_backward;
    in_pieces(threads, s.points, kPoints, [&](size_t begin, size_t end) {
        SkinningGrads mine = g;
        if (total) {
            mine.bones = sums.data() + begin / kPoints * bones;
            std::fill_n(mine.bones, bones, 0.f);
        }
        kernel(s, mine, blended, begin, end);
    });
    if (!total) return;
    std::fill_n(total, bones, 0.f);
    for (size_t block = 0; block < blocks; ++block)
        for (size_t i = 0; i < bones; ++i) total[i] += sums[block * bones + i];
}

}  // namespace evsplat
