#include "picture.h"

#include <algorithm>

#include "levels.h"
#include "thread_pool.h"

namespace evsplat {
namespace {

constexpr size_t kPiece = 16384;  // values of one piece of work; a multiple of every level's lanes

template <class Work>
void in_pieces(size_t count, int threads, const Work& work) {
    parallel_for(threads, (count + kPiece - 1) / kPiece, [&](size_t piece) {
        work(piece * kPiece, std::min(count, (piece + 1) * kPiece));
    });
}

}  // namespace

void log_brightness(const LogBrightness& job, size_t count, int threads) {
    const auto kernel = select_kernels().log_brightness;
    in_pieces(count, threads, [&](size_t begin, size_t end) { kernel(job, begin, end); });
}

void power(const Power& job, size_t count, int threads) {
    const auto kernel = select_kernels().power;
    in_pieces(count, threads, [&](size_t begin, size_t end) { kernel(job, begin, end); });
}

void add_sign(const float* image, const float* reference, float by_difference, float scale, size_t count,
              int threads, float* grad) {
    const auto kernel = select_kernels().add_sign;
    in_pieces(count, threads, [&](size_t begin, size_t end) {
        kernel(image + begin, reference + begin, by_difference, scale, end - begin, grad + begin);
    });
}

}  // namespace evsplat
