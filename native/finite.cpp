#include "finite.h"

#include <algorithm>
#include <cmath>

#include "thread_pool.h"

namespace evsplat {

static constexpr size_t kPiece = 1 << 15;
static constexpr size_t kLanes = 16;  // sums apart, so that a compiler may take them as vectors

static double of_piece(const Values& values) {
    float lanes[kLanes] = {};
    size_t i = 0;
    for (; i + kLanes <= values.count; i += kLanes)
        for (size_t l = 0; l < kLanes; ++l) lanes[l] += std::fabs(values.first[i + l]);
    double sum = 0;
    for (; i < values.count; ++i) sum += std::fabs(values.first[i]);
    for (float lane : lanes) sum += lane;
    return sum;
}

double sum_of_magnitudes(const std::vector<Values>& arrays, int threads) {
    std::vector<Values> pieces;
    for (const Values& all : arrays)
        for (size_t at = 0; at < all.count; at += kPiece)
            pieces.push_back({all.first + at, std::min(kPiece, all.count - at)});
    std::vector<double> sums(pieces.size());
    parallel_for(threads, pieces.size(), [&](size_t piece) { sums[piece] = of_piece(pieces[piece]); });
    double total = 0;
    for (double sum : sums) total += sum;
    return total;
}

}  // namespace evsplat
