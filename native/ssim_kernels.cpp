// Structural similarity of a band of one plane, compiled once per SIMD level.
//
// Windows are separable: rows are blurred along x, then along y. The map S is a function of the blurred
// x, y, x^2 + y^2 and x y; its three partial derivatives, blurred back, give the gradient of the sum of S.
// Rows are taken some together, so that the blur along y reads each fewer times, and only as many are kept
// as the windows of those reach, so that all stays in the cache. Rows in the scratch memory are whole vectors long.

#include "kernels.h"

namespace evsplat {
namespace EVSPLAT_LEVEL {
namespace {

#include "simd.h"

constexpr int K = kSsimWindow;
constexpr int R = EVSPLAT_LANES == 16 ? 4 : 2;  // rows taken together, as many as the registers hold
constexpr int kRows = K + R - 1;  // kept of each map: what R rows of windows reach

// sum over k of w[k] from[k], for a window that is symmetric: a sum and a product run side by side.
template <class At>
INLINE F weighted(const float (&w)[K], At at) {
    F sum = w[K / 2] * at(K / 2);
#pragma GCC unroll 5
    for (int k = 0; k < K / 2; ++k) sum += w[k] * (at(k) + at(K - 1 - k));
    return sum;
}

// to[i] = sum over k of w[k] from[i + k]; `from` and `to` are at whole vectors, one more of `from` is there.
INLINE void blur(const float* from, const float (&w)[K], int count, float* to) {
#if EVSPLAT_LANES == 16
    // Out of two registers, as most loads would lie across two lines of the cache.
    __m512i lanes[K];
    for (int k = 0; k < K; ++k) {
        int32_t lane[W];
        for (int l = 0; l < W; ++l) lane[l] = l + k;
        __builtin_memcpy(&lanes[k], lane, sizeof lane);
    }
    F here = load(from);
    for (int i = 0; i < count; i += W) {
        const F next = load(from + i + W);
        store(to + i, weighted(w, [&](int k) {
                  return k ? (F)_mm512_permutex2var_ps((__m512)here, lanes[k], (__m512)next) : here;
              }));
        here = next;
    }
#else
    for (int i = 0; i < count; i += W) store(to + i, weighted(w, [&](int k) { return load(from + i + k); }));
#endif
}

// to[r][i] = sum over k of w[k] from[r + k][i]
INLINE void blur_rows(const float* const (&from)[kRows], const float (&w)[K], int count, float* const (&to)[R]) {
    for (int i = 0; i < count; i += W) {
        F row[kRows];
#pragma GCC unroll 16
        for (int k = 0; k < kRows; ++k) row[k] = load(from[k] + i);
#pragma GCC unroll 4
        for (int r = 0; r < R; ++r) store(to[r] + i, weighted(w, [&](int k) { return row[r + k]; }));
    }
}

INLINE double difference(const float* x, const float* y, int count) {
    F total = {};
    int i = 0;
    for (; i + W <= count; i += W) {
        const F d = load(x + i) - load(y + i);
        total += max(d, -d) + (d - d);  // max forgets what is no number
    }
    double rest = 0.0;
    for (; i < count; ++i) rest += __builtin_fabsf(x[i] - y[i]);
    return rest + sum(total);
}

// The similarity of `columns` windows, summed, from what is blurred; its derivatives by the blurred x, by
// x^2 and by x y.
INLINE double similarity(const SsimBand& job, const float* const (&blurred)[4], int columns, float* const (&slope)[3]) {
    F lane, sum = {};
    for (int l = 0; l < W; ++l) lane[l] = float(l);
    for (int i = 0; i < columns; i += W) {
        const F mx = load(blurred[0] + i), my = load(blurred[1] + i), squares = mx * mx + my * my, product = mx * my;
        const F a1 = 2.f * product + job.c1, b1 = squares + job.c1;
        const F a2 = 2.f * (load(blurred[3] + i) - product) + job.c2, b2 = load(blurred[2] + i) - squares + job.c2;
        const I there = lane < float(columns - i);
        const F inverse = 1.f / (b1 * b2), s = a1 * a2 * inverse;
        const F by_square = -s * b1 * inverse, by_product = 2.f * a1 * inverse;
        // Through both factors: the luminance one directly, the other as variance and covariance.
        const F by_mean =
            2.f * my * a2 * inverse - 2.f * mx * s * b2 * inverse - 2.f * mx * by_square - my * by_product;
        store(slope[0] + i, select(there, by_mean, F{}));
        store(slope[1] + i, select(there, by_square, F{}));
        store(slope[2] + i, select(there, by_product, F{}));
        sum += select(there, s, F{});
    }
    return evsplat::EVSPLAT_LEVEL::sum(sum);
}

}  // namespace

SsimSums ssim_band(const SsimBand& job) {
    const int h = job.height, w = job.width, rows = h - K + 1, columns = w - K + 1;
    // The way back reads K - 1 past the last column, and blur() one vector more.
    const int padded = (w + W - 1) / W * W, stride = (w + K - 1 + W - 1) / W * W + W;
    float window[K];
    for (int k = 0; k < K; ++k) window[k] = job.window[k];
    float* next = job.scratch;
    const auto take = [&] {
        for (int i = 0; i < stride; ++i) next[i] = 0.f;
        return (next += stride) - stride;
    };
    // The last rows of x, y, xx + yy, xy, blurred along x; of the derivatives, blurred back along x.
    float *blurred[4][kRows], *back[3][kRows], *line[4][R], *slope[3];
    for (auto& map : blurred)
        for (float*& row : map) row = take();
    for (auto& map : back)
        for (float*& row : map) row = take();
    for (auto& map : line)
        for (float*& row : map) row = take();
    for (float*& row : slope) row = take();

    const int first = job.begin > K - 1 ? job.begin - K + 1 : 0, last = job.end < rows ? job.end : rows;
    const int start = job.grad ? first : job.begin;
    SsimSums total = {};
    for (int q = job.begin; q < job.end; ++q)
        total.difference += difference(job.image + size_t(q) * w, job.reference + size_t(q) * w, w);
    int filled = start;  // rows up to here are blurred
    for (int q = start; q < job.end; q += R) {
        for (; q < last && filled < q + kRows && filled < h; ++filled) {
            const float *x = job.image + size_t(filled) * w, *y = job.reference + size_t(filled) * w;
            __builtin_memcpy(line[0][0], x, w * sizeof *x), __builtin_memcpy(line[1][0], y, w * sizeof *y);
            for (int i = 0; i < padded; i += W) {
                const F a = load(line[0][0] + i), b = load(line[1][0] + i);
                store(line[2][0] + i, a * a + b * b), store(line[3][0] + i, a * b);
            }
            for (int m = 0; m < 4; ++m) blur(line[m][0], window, columns, blurred[m][filled % kRows]);
        }
        if (q < last) {
            for (int m = 0; m < 4; ++m) {
                const float* row[kRows];
                for (int k = 0; k < kRows; ++k) row[k] = blurred[m][(q + k) % kRows];
                blur_rows(row, window, columns, line[m]);
            }
        }
        for (int r = 0; r < R; ++r) {
            // The window is symmetric: with K - 1 zeros on both sides it blurs back too.
            float* const inner[3] = {slope[0] + K - 1, slope[1] + K - 1, slope[2] + K - 1};
            if (q + r < last) {
                const double value = similarity(job, {line[0][r], line[1][r], line[2][r], line[3][r]}, columns, inner);
                if (q + r >= job.begin && q + r < job.end) total.similarity += value;
            }
            if (!job.grad) continue;
            for (int m = 0; m < 3; ++m) {
                float* to = back[m][(q + r) % kRows];
                if (q + r < last)
                    blur(slope[m], window, w, to);
                else
                    for (int i = 0; i < padded; ++i) to[i] = 0.f;  // below the last window
            }
        }
        if (!job.grad) continue;
        // Window q - k reaches row q with weight k; above the first window back is zero.
        for (int m = 0; m < 3; ++m) {
            const float* row[kRows];
            for (int k = 0; k < kRows; ++k) row[k] = back[m][(q + R - 1 - k + kRows) % kRows];
            float* to[R];
            for (int r = 0; r < R; ++r) to[r] = line[m][R - 1 - r];
            blur_rows(row, window, w, to);
        }
        for (int r = 0; r < R; ++r) {
            if (q + r < job.begin || q + r >= job.end) continue;
            const float *x = job.image + size_t(q + r) * w, *y = job.reference + size_t(q + r) * w;
            float* out = job.grad + size_t(q + r) * w;
            const float *mean = line[0][r], *square = line[1][r], *product = line[2][r];
#pragma GCC ivdep
            for (int i = 0; i < w; ++i) out[i] = mean[i] + 2.f * x[i] * square[i] + y[i] * product[i];
        }
    }
    return total;
}

void window_means(const WindowMeans& job, size_t plane, int begin, int end, double* line) {
    const int width = job.width, columns = job.columns();
    const double* from = job.planes + plane * job.height * width;
    double* to = job.means + (plane * job.rows() + begin) * columns;
    for (int i = 0; i < width + 2 * job.pad; ++i) line[i] = 0.0;
    double* const inner = line + job.pad;
    for (int q = begin; q < end; ++q, to += columns) {
        for (int i = 0; i < width; ++i) inner[i] = 0.0;
        for (int k = 0; k < job.size; ++k) {
            const int row = q + k - job.pad;
            if (row < 0 || row >= job.height) continue;
            const double weight = job.window[k], *values = from + size_t(row) * width;
#pragma GCC ivdep
            for (int i = 0; i < width; ++i) inner[i] += weight * values[i];
        }
        for (int i = 0; i < columns; ++i) to[i] = 0.0;
        for (int k = 0; k < job.size; ++k) {
            const double weight = job.window[k], *values = line + k;
#pragma GCC ivdep
            for (int i = 0; i < columns; ++i) to[i] += weight * values[i];
        }
    }
}

}  // namespace EVSPLAT_LEVEL
}  // namespace evsplat
