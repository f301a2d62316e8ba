#include "ssim.h"

#include "buffer.h"
#include "levels.h"
#include "thread_pool.h"

namespace evsplat {

void ssim_planes(size_t planes, int height, int width, const float* image, const float* reference,
                 const float* window, float c1, float c2, int threads, double* sums, float* grad) {
    const size_t plane = size_t(height) * width;
    const auto kernel = select_kernels().ssim;
    parallel_for(threads, planes, [&](size_t p) {
        Buffer<float> scratch(ssim_scratch(height, width));
        sums[p] = kernel({height, width, image + p * plane, reference + p * plane, window, c1, c2,
                          grad ? grad + p * plane : nullptr, scratch.data()});
    });
}

}  // namespace evsplat
