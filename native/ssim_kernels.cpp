// Structural similarity of a band of one plane, compiled once per SIMD level.
//
// Windows are separable: rows are blurred along x, then along y. The map S is a function of the blurred
// x, x^2 and x y; its three partial derivatives, blurred back, give the gradient of the sum of S. Rows
// are taken one by one, and only as many are kept as a window is high, so that all stays in the cache.

#include "kernels.h"

namespace evsplat {
namespace EVSPLAT_LEVEL {
namespace {

constexpr int K = kSsimWindow;
#define INLINE static inline __attribute__((always_inline))

// to[i] = sum over k of w[k] from[i + k * step]
INLINE void blur(const float* from, size_t step, const float* w, int count, float* to) {
#pragma GCC ivdep
    for (int i = 0; i < count; ++i) {
        float sum = 0.f;
#pragma GCC unroll 11
        for (int k = 0; k < K; ++k) sum += w[k] * from[i + k * step];
        to[i] = sum;
    }
}

// to[i] = sum over k of w[k] from[k][i]
INLINE void blur_rows(const float* const (&from)[K], const float (&w)[K], int count, float* to) {
#pragma GCC ivdep
    for (int i = 0; i < count; ++i) {
        float sum = 0.f;
#pragma GCC unroll 11
        for (int k = 0; k < K; ++k) sum += w[k] * from[k][i];
        to[i] = sum;
    }
}

}  // namespace

SsimSums ssim_band(const SsimBand& job) {
    const int h = job.height, w = job.width, rows = h - K + 1, columns = w - K + 1;
    float window[K];
    for (int k = 0; k < K; ++k) window[k] = job.window[k];
    float* next = job.scratch;
    const auto take = [&](int floats) { return (next += floats) - floats; };
    // The last K rows of x, y, xx, yy, xy, blurred along x; of the derivatives, blurred back along x.
    float *blurred[5][K], *back[3][K], *line[5], *slope[3];
    for (auto& map : blurred)
        for (float*& row : map) row = take(w);
    for (auto& map : back)
        for (float*& row : map) row = take(w);
    for (float*& row : line) row = take(w);
    for (float*& row : slope) {  // with K - 1 zeros on both sides: the window is symmetric
        row = take(w + K - 1);
        for (int i = 0; i < K - 1; ++i) row[i] = row[columns + K - 1 + i] = 0.f;
    }

    const int first = job.begin > K - 1 ? job.begin - K + 1 : 0, last = job.end < rows ? job.end : rows;
    const int start = job.grad ? first : job.begin;
    SsimSums total = {};
    int filled = start;  // rows up to here are blurred
    for (int q = job.begin; q < job.end; ++q) {
        const float *x = job.image + size_t(q) * w, *y = job.reference + size_t(q) * w;
        float sum = 0.f;
#pragma GCC ivdep
        for (int i = 0; i < w; ++i) sum += __builtin_fabsf(x[i] - y[i]);
        total.difference += sum;
    }
    for (int q = start; q < job.end; ++q) {
        for (; q < last && filled < q + K; ++filled) {
            const float *x = job.image + size_t(filled) * w, *y = job.reference + size_t(filled) * w;
#pragma GCC ivdep
            for (int i = 0; i < w; ++i) line[2][i] = x[i] * x[i], line[3][i] = y[i] * y[i], line[4][i] = x[i] * y[i];
            const float* sources[5] = {x, y, line[2], line[3], line[4]};
            for (int m = 0; m < 5; ++m) blur(sources[m], 1, window, columns, blurred[m][filled % K]);
        }
        if (q < last) {
            for (int m = 0; m < 5; ++m) {
                const float* row[K];
                for (int k = 0; k < K; ++k) row[k] = blurred[m][(q + k) % K];
                blur_rows(row, window, columns, line[m]);
            }
            float *d_mean = slope[0] + K - 1, *d_square = slope[1] + K - 1, *d_product = slope[2] + K - 1;
            float sum = 0.f;
#pragma GCC ivdep
            for (int i = 0; i < columns; ++i) {
                const float mx = line[0][i], my = line[1][i];
                const float a1 = 2.f * mx * my + job.c1, b1 = mx * mx + my * my + job.c1;
                const float a2 = 2.f * (line[4][i] - mx * my) + job.c2;
                const float b2 = (line[2][i] - mx * mx) + (line[3][i] - my * my) + job.c2;
                const float inverse = 1.f / (b1 * b2), s = a1 * a2 * inverse;
                d_square[i] = -s * b1 * inverse;
                d_product[i] = 2.f * a1 * inverse;
                // Through both factors: the luminance one directly, the other as variance and covariance.
                d_mean[i] =
                    2.f * my * a2 * inverse - 2.f * mx * s * b2 * inverse - 2.f * mx * d_square[i] - my * d_product[i];
                sum += s;
            }
            if (q >= job.begin) total.similarity += sum;
        }
        if (!job.grad) continue;
        for (int m = 0; m < 3; ++m) {
            if (q < last)
                blur(slope[m], 1, window, w, back[m][q % K]);
            else
                for (int i = 0; i < w; ++i) back[m][q % K][i] = 0.f;  // below the last window
        }
        if (q < job.begin) continue;
        for (int m = 0; m < 3; ++m) {
            // Window q - k reaches row q with weight k; above the first window there is none.
            const float* row[K];
            float weights[K];
            for (int k = 0; k < K; ++k) {
                const bool there = q - k >= start;
                row[k] = back[m][there ? (q - k) % K : q % K];
                weights[k] = there ? window[k] : 0.f;
            }
            blur_rows(row, weights, w, line[m]);
        }
        const float *x = job.image + size_t(q) * w, *y = job.reference + size_t(q) * w;
        float* out = job.grad + size_t(q) * w;
#pragma GCC ivdep
        for (int i = 0; i < w; ++i) out[i] = line[0][i] + 2.f * x[i] * line[1][i] + y[i] * line[2][i];
    }
    return total;
}

}  // namespace EVSPLAT_LEVEL
}  // namespace evsplat
