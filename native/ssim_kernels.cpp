// Structural similarity of one plane, compiled once per SIMD level.
//
// Windows are separable: rows are blurred first, then columns. The map S is a function of the blurred
// x, x^2 and x y; its three partial derivatives, blurred back, give the gradient of the sum of S.

#include "kernels.h"

namespace evsplat {
namespace EVSPLAT_LEVEL {
namespace {

constexpr int K = kSsimWindow;
#define INLINE static inline __attribute__((always_inline))

// to[i] = sum over k of w[k] from[i + k * step]
INLINE void blur(const float* from, size_t step, const float* w, int count, float* to) {
    for (int i = 0; i < count; ++i) {
        float sum = 0.f;
#pragma GCC unroll 11
        for (int k = 0; k < K; ++k) sum += w[k] * from[i + k * step];
        to[i] = sum;
    }
}

}  // namespace

double ssim_plane(const SsimPlane& job) {
    const int h = job.height, w = job.width, rows = h - K + 1, columns = w - K + 1;
    const size_t plane = size_t(h) * w;
    float window[K];
    for (int k = 0; k < K; ++k) window[k] = job.window[k];
    // Rows of x, y, xx, yy, xy after the horizontal blur; later the derivatives take their places.
    float* blurred[5];
    for (int m = 0; m < 5; ++m) blurred[m] = job.scratch + m * plane;
    float* slopes[3];
    for (int m = 0; m < 3; ++m) slopes[m] = job.scratch + (5 + m) * plane;
    float* line[5];
    for (int m = 0; m < 5; ++m) line[m] = job.scratch + 8 * plane + size_t(m) * w;

    for (int r = 0; r < h; ++r) {
        const float *x = job.image + size_t(r) * w, *y = job.reference + size_t(r) * w;
        for (int i = 0; i < w; ++i) line[2][i] = x[i] * x[i], line[3][i] = y[i] * y[i], line[4][i] = x[i] * y[i];
        const float* sources[5] = {x, y, line[2], line[3], line[4]};
        for (int m = 0; m < 5; ++m) blur(sources[m], 1, window, columns, blurred[m] + size_t(r) * w);
    }
    double total = 0.0;
    for (int r = 0; r < rows; ++r) {
        for (int m = 0; m < 5; ++m) blur(blurred[m] + size_t(r) * w, w, window, columns, line[m]);
        float *d_mean = slopes[0] + size_t(r) * w, *d_square = slopes[1] + size_t(r) * w,
              *d_product = slopes[2] + size_t(r) * w;
        float sum = 0.f;
        for (int i = 0; i < columns; ++i) {
            const float mx = line[0][i], my = line[1][i];
            const float a1 = 2.f * mx * my + job.c1, b1 = mx * mx + my * my + job.c1;
            const float a2 = 2.f * (line[4][i] - mx * my) + job.c2;
            const float b2 = (line[2][i] - mx * mx) + (line[3][i] - my * my) + job.c2;
            const float inverse = 1.f / (b1 * b2), s = a1 * a2 * inverse;
            d_square[i] = -s * b1 * inverse;
            d_product[i] = 2.f * a1 * inverse;
            // Through both factors: the luminance one directly, the other as variance and covariance.
            d_mean[i] = 2.f * my * a2 * inverse - 2.f * mx * s * b2 * inverse - 2.f * mx * d_square[i] - my * d_product[i];
            sum += s;
        }
        total += sum;
    }
    if (!job.grad) return total;

    // The transposed blur is the same blur of the map with K - 1 zeros around it (the window is symmetric).
    for (int m = 0; m < 3; ++m) {
        for (int r = 0; r < h; ++r) {
            float* out = blurred[m] + size_t(r) * w;
            for (int i = 0; i < columns; ++i) out[i] = 0.f;
            const int first = r - K + 1 > 0 ? r - K + 1 : 0, last = r < rows - 1 ? r : rows - 1;
            for (int q = first; q <= last; ++q) {
                const float weight = window[r - q];
                const float* source = slopes[m] + size_t(q) * w;
                for (int i = 0; i < columns; ++i) out[i] += weight * source[i];
            }
        }
    }
    float* padded = slopes[0];  // w + K - 1 floats of a row with zeros around it
    for (int i = 0; i < K - 1; ++i) padded[i] = padded[columns + K - 1 + i] = 0.f;
    for (int r = 0; r < h; ++r) {
        for (int m = 0; m < 3; ++m) {
            const float* source = blurred[m] + size_t(r) * w;
            for (int i = 0; i < columns; ++i) padded[K - 1 + i] = source[i];
            blur(padded, 1, window, w, line[m]);
        }
        const float *x = job.image + size_t(r) * w, *y = job.reference + size_t(r) * w;
        float* out = job.grad + size_t(r) * w;
        for (int i = 0; i < w; ++i) out[i] = line[0][i] + 2.f * x[i] * line[1][i] + y[i] * line[2][i];
    }
    return total;
}

}  // namespace EVSPLAT_LEVEL
}  // namespace evsplat
