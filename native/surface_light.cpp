#include "surface_light.h"

#include <algorithm>
#include <vector>

#include "buffer.h"
#include "levels.h"
#include "thread_pool.h"

namespace evsplat {

static constexpr size_t kPoints = 1024;  // of a piece; fixes the order of sums over points

void surface_light(const SurfaceLight& job, int threads, float* factors) {
    const auto kernel = select_kernels().surface_light;
    in_pieces(threads, job.points, kPoints, [&](size_t begin, size_t end) { kernel(job, begin, end, factors); });
}

void surface_light_backward(const SurfaceLight& job, const float* above, int threads, float* sums, float* lit) {
    const auto kernel = select_kernels().surface_light_backward;
    const size_t pieces = (job.points + kPoints - 1) / kPoints, width = light_sums(job.lamps);
    Buffer<float> parts(pieces * width);
    in_pieces(threads, job.points, kPoints, [&](size_t begin, size_t end) {
        kernel(job, begin, end, above, parts.data() + begin / kPoints * width, lit);
    });
    std::vector<double> totals(width);
    for (size_t piece = 0; piece < pieces; ++piece)
        for (size_t i = 0; i < width; ++i) totals[i] += parts[piece * width + i];
    std::copy(totals.begin(), totals.end(), sums);
}

}  // namespace evsplat
