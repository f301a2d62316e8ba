#include "picture.h"

#include <algorithm>
#include <cmath>
#include <vector>

#include "levels.h"
#include "thread_pool.h"

namespace evsplat {
namespace {

constexpr size_t kPiece = 16384;  // values of one piece of work; a multiple of every level's lanes

// The sums of what `work` returns of each piece, in order.
template <class Work>
PairOfSums sum_of_pieces(size_t count, int threads, const Work& work) {
    std::vector<PairOfSums> parts((count + kPiece - 1) / kPiece);
    in_pieces(threads, count, kPiece, [&](size_t begin, size_t end) { parts[begin / kPiece] = work(begin, end); });
    PairOfSums total = {};
    for (const PairOfSums& part : parts) total.first += part.first, total.second += part.second;
    return total;
}

}  // namespace

void log_brightness(const LogBrightness& job, size_t count, int threads) {
    const auto kernel = select_kernels().log_brightness;
    in_pieces(threads, count, kPiece, [&](size_t begin, size_t end) { kernel(job, begin, end); });
}

void power(const Power& job, size_t count, int threads) {
    const auto kernel = select_kernels().power;
    in_pieces(threads, count, kPiece, [&](size_t begin, size_t end) { kernel(job, begin, end); });
}

void add_sign(const float* image, const float* reference, float by_difference, float scale, size_t count,
              int threads, float* grad) {
    const auto kernel = select_kernels().add_sign;
    in_pieces(threads, count, kPiece, [&](size_t begin, size_t end) {
        kernel(image + begin, reference + begin, by_difference, scale, end - begin, grad + begin);
    });
}

double membership(const Membership& job, size_t count, int threads) {
    const auto kernel = select_kernels().membership;
    const auto piece = [&](size_t begin, size_t end) { return PairOfSums{kernel(job, begin, end), 0.0}; };
    return sum_of_pieces(count, threads, piece).first;
}

MapDifference map_difference(const float* map, const float* reference, float floor, size_t count, int threads) {
    const Kernels& kernels = select_kernels();
    const PairOfSums squares = sum_of_pieces(count, threads, [&](size_t begin, size_t end) {
        return kernels.square_sums(map + begin, reference + begin, end - begin);
    });
    const double least = double(count) * floor * floor;
    const double scale[2] = {1.0 / std::sqrt(squares.first + least), 1.0 / std::sqrt(squares.second + least)};
    const PairOfSums sums = sum_of_pieces(count, threads, [&](size_t begin, size_t end) {
        return kernels.difference_sums(map + begin, reference + begin, float(scale[0]), float(scale[1]), end - begin);
    });
    return {{scale[0], scale[1]}, sums.first, sums.second};
}

void map_difference_backward(const float* map, const float* reference, const MapDifference& known, float weight,
                             size_t count, int threads, float* grad) {
    const auto kernel = select_kernels().difference_slope;
    const double* scale = known.scale;
    const float by_sign = float(weight * scale[0]), by_map = float(weight * known.along * scale[0] * scale[0] * scale[0]);
    in_pieces(threads, count, kPiece, [&](size_t begin, size_t end) {
        kernel(map + begin, reference + begin, float(scale[0]), float(scale[1]), by_sign, by_map, end - begin,
               grad + begin);
    });
}

}  // namespace evsplat
