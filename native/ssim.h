// Mean structural similarity of two planes and its gradient (Wang et al. 2004), valid windows only; and in float64,
// for any window, the means that it is made of.
#pragma once

#include <stddef.h>

namespace evsplat {

constexpr int kSsimWindow = 11;

// Rows [begin, end) of a plane: windows that start there, and the gradient there.
struct SsimBand {
    int height, width, begin, end;
    const float *image, *reference;   // (height, width)
    const float* window;              // kSsimWindow weights that sum to one
    float c1, c2;
    float* grad;                      // (height, width), written: gradient of the sum; may be null
    float* scratch;                   // ssim_scratch floats
};

struct SsimSums {
    double similarity;                // over the window positions
    double difference;                // absolute, over the pixels
};

inline size_t ssim_scratch(int width) { return size_t(7 * (kSsimWindow + 3) + 19) * (width + 48); }

// Sums over all planes; `planes` of (height, width) follow each other.
SsimSums ssim_planes(size_t planes, int height, int width, const float* image, const float* reference,
                 const float* window, float c1, float c2, int threads, float* grad);

// Weighted means in the windows of planes (height, width) with `pad` zeros around them. Sums are taken in the order
// of the weights, down the columns first.
struct WindowMeans {
    int height, width, size, pad;
    const double* planes;
    const double* window;             // size weights, of both axes
    double* means;                    // (rows, columns) of each plane

    int rows() const { return height + 2 * pad - size + 1; }
    int columns() const { return width + 2 * pad - size + 1; }
};

void window_means(const WindowMeans& job, size_t planes, int threads);

}  // namespace evsplat
