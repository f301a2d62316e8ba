// Losses on whole pictures, beside the similarity of ssim.h: passes over planes of pixels.
#pragma once

#include <stddef.h>

namespace evsplat {

// Natural logarithm of the luminance of `count` pixels whose coded channels are planes:
// log(sum_c weight_c max(coded_c, darkest)^gamma + eps). `slope` is null or takes its derivative by each
// channel, which is zero below `darkest`.
struct LogBrightness {
    const float* coded[3];
    float weight[3];
    float gamma, darkest, eps;
    float* value;
    float* slope[3];
};

void log_brightness(const LogBrightness&, size_t count, int threads);

// value = max(from, 0)^exponent for an exponent above 1, over `count` values; `slope` is null or takes the
// derivative. Both are zero below 1e-6.
struct Power {
    const float* from;
    float exponent;
    float *value, *slope;
};

void power(const Power&, size_t count, int threads);

// grad = by_difference * sign(image - reference) + scale * grad, over `count` values.
void add_sign(const float* image, const float* reference, float by_difference, float scale, size_t count,
              int threads, float* grad);

}  // namespace evsplat
