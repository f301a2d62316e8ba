#include "ssim.h"

#include <algorithm>
#include <numeric>
#include <vector>

#include "buffer.h"
#include "levels.h"
#include "thread_pool.h"

namespace evsplat {

void ssim_planes(size_t planes, int height, int width, const float* image, const float* reference,
                 const float* window, float c1, float c2, int threads, double* sums, float* grad) {
    constexpr int kBand = 64;  // fixes the order of sums
    const size_t plane = size_t(height) * width, bands = (height + kBand - 1) / kBand;
    std::vector<double> parts(planes * bands);
    const auto kernel = select_kernels().ssim;
    parallel_for(threads, parts.size(), [&](size_t i) {
        const size_t p = i / bands;
        const int begin = int(i % bands) * kBand;
        Buffer<float> scratch(ssim_scratch(width));
        parts[i] = kernel({height, width, begin, std::min(height, begin + kBand), image + p * plane,
                           reference + p * plane, window, c1, c2, grad ? grad + p * plane : nullptr, scratch.data()});
    });
    for (size_t p = 0; p < planes; ++p)
        sums[p] = std::accumulate(parts.begin() + p * bands, parts.begin() + (p + 1) * bands, 0.0);
}

}  // namespace evsplat
