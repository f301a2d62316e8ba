#include "ssim.h"

#include <algorithm>
#include <vector>

#include "buffer.h"
#include "levels.h"
#include "thread_pool.h"

namespace evsplat {

SsimSums ssim_planes(size_t planes, int height, int width, const float* image, const float* reference,
                 const float* window, float c1, float c2, int threads, float* grad) {
    constexpr int kBand = 128;  // fixes the order of sums
    const size_t plane = size_t(height) * width, bands = (height + kBand - 1) / kBand;
    std::vector<SsimSums> parts(planes * bands);
    const auto kernel = select_kernels().ssim_band;
    parallel_for(threads, parts.size(), [&](size_t i) {
        const size_t p = i / bands;
        const int begin = int(i % bands) * kBand;
        Buffer<float> scratch(ssim_scratch(width));
        parts[i] = kernel({height, width, begin, std::min(height, begin + kBand), image + p * plane,
                           reference + p * plane, window, c1, c2, grad ? grad + p * plane : nullptr, scratch.data()});
    });
    SsimSums total = {};
    for (const SsimSums& part : parts) total.similarity += part.similarity, total.difference += part.difference;
    return total;
}

void window_means(const WindowMeans& job, size_t planes, int threads) {
    constexpr int kBand = 64;
    const size_t bands = (job.rows() + kBand - 1) / kBand;
    const auto kernel = select_kernels().window_means;
    parallel_for(threads, planes * bands, [&](size_t i) {
        const int begin = int(i % bands) * kBand;
        Buffer<double> line(job.width + 2 * job.pad);
        kernel(job, i / bands, begin, std::min(job.rows(), begin + kBand), line.data());
    });
}

}  // namespace evsplat
