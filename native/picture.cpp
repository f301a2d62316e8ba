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

void log_brightness(const LogBrightness& job, int threads, float* value) {
    const auto kernel = select_kernels().log_brightness;
    in_pieces(threads, job.count, kPiece / 4, [&](size_t begin, size_t end) { kernel(job, begin, end, value); });
}

void log_brightness_backward(const LogBrightness& job, const float* above, int threads, float* const* grads) {
    const auto kernel = select_kernels().log_brightness_backward;
    in_pieces(threads, job.count, kPiece / 4, [&](size_t begin, size_t end) { kernel(job, begin, end, above, grads); });
}

void power(const Power& job, size_t count, int threads) {
    const auto kernel = select_kernels().power;
    in_pieces(threads, count, kPiece, [&](size_t begin, size_t end) { kernel(job, begin, end); });
}

void power_mean(const PowerMean& job, int threads) {
    const auto kernel = select_kernels().power_mean;
    in_pieces(threads, 3 * job.count, kPiece, [&](size_t begin, size_t end) { kernel(job, begin, end); });
}

void power_mean_backward(const PowerMean& job, const float* above, int threads, float* const* grads) {
    const auto kernel = select_kernels().power_mean_backward;
    in_pieces(threads, 3 * job.count, kPiece, [&](size_t begin, size_t end) { kernel(job, begin, end, above, grads); });
}

namespace {

// Where each row or column of the large picture lies between two of the small one.
struct Between {
    int low, high;
    float share;  // of the higher
};

std::vector<Between> places(int small, int large, int factor) {
    std::vector<Between> at(large);
    for (int i = 0; i < large; ++i) {
        const float place = std::max(0.f, (float(i) + 0.5f) / float(factor) - 0.5f);
        const int low = std::min(int(place), small - 1);
        at[i] = {low, std::min(low + 1, small - 1), place - float(low)};
    }
    return at;
}

}  // namespace

void enlarge(const Enlarge& e, const float* from, int threads, float* to) {
    const std::vector<Between> rows = places(e.height, e.to_height, e.factor), columns = places(e.width, e.to_width, e.factor);
    parallel_for(threads, e.times, [&](size_t t) {
        const float* small = from + t * e.height * e.width;
        float* large = to + t * e.to_height * e.to_width;
        std::vector<float> row(e.width);
        for (int y = 0; y < e.to_height; ++y) {
            const float *a = small + size_t(rows[y].low) * e.width, *b = small + size_t(rows[y].high) * e.width;
            const float share = rows[y].share;
            for (int x = 0; x < e.width; ++x) row[x] = a[x] + share * (b[x] - a[x]);
            for (int x = 0; x < e.to_width; ++x) {
                const Between& c = columns[x];
                large[size_t(y) * e.to_width + x] = row[c.low] + c.share * (row[c.high] - row[c.low]);
            }
        }
    });
}

void enlarge_backward(const Enlarge& e, const float* above, int threads, float* grad) {
    const std::vector<Between> rows = places(e.height, e.to_height, e.factor), columns = places(e.width, e.to_width, e.factor);
    parallel_for(threads, e.times, [&](size_t t) {
        float* small = grad + t * e.height * e.width;
        const float* large = above + t * e.to_height * e.to_width;
        std::fill_n(small, size_t(e.height) * e.width, 0.f);
        std::vector<float> row(e.width);
        for (int y = 0; y < e.to_height; ++y) {
            std::fill(row.begin(), row.end(), 0.f);
            for (int x = 0; x < e.to_width; ++x) {
                const Between& c = columns[x];
                const float by = large[size_t(y) * e.to_width + x], high = by * c.share;
                row[c.low] += by - high, row[c.high] += high;
            }
            float *a = small + size_t(rows[y].low) * e.width, *b = small + size_t(rows[y].high) * e.width;
            for (int x = 0; x < e.width; ++x) {
                const float high = row[x] * rows[y].share;
                a[x] += row[x] - high, b[x] += high;
            }
        }
    });
}

void share_of_range(const uint8_t* levels, size_t count, int threads, float* shares) {
    const auto kernel = select_kernels().share_of_range;
    in_pieces(threads, count, kPiece, [&](size_t begin, size_t end) { kernel(levels + begin, end - begin, shares + begin); });
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

namespace {

// Calls work(p, begin, end) for each picture with the pixels that are looked at in it.
template <class Work>
void in_pictures(size_t pictures, const int64_t* ends, int threads, const Work& work) {
    parallel_for(threads, pictures, [&](size_t p) { work(p, size_t(p ? ends[p - 1] : 0), size_t(ends[p])); });
}

}  // namespace

void colours_before(const Before& job, int threads, float* colours) {
    const size_t area = job.looked.area;
    in_pictures(job.looked.pictures, job.looked.ends, threads, [&](size_t p, size_t begin, size_t end) {
        const float *drawn = job.drawn + 3 * p * area, *alpha = job.alpha + p * area;
        for (size_t i = begin; i < end; ++i) {
            const int32_t pixel = job.looked.pixel[i];
            const float through = 1 - alpha[pixel];
            for (int c = 0; c < 3; ++c) colours[3 * i + c] = drawn[c * area + pixel] + through * job.behind[3 * i + c];
        }
    });
}

void colours_before_backward(const Before& job, const float* above, int threads, float* by_drawn, float* by_alpha) {
    const size_t area = job.looked.area;
    in_pictures(job.looked.pictures, job.looked.ends, threads, [&](size_t p, size_t begin, size_t end) {
        float *drawn = by_drawn + 3 * p * area, *alpha = by_alpha + p * area;
        std::fill_n(drawn, 3 * area, 0.f);
        std::fill_n(alpha, area, 0.f);
        for (size_t i = begin; i < end; ++i) {
            const int32_t pixel = job.looked.pixel[i];
            const float *by = above + 3 * i, *behind = job.behind + 3 * i;
            for (int c = 0; c < 3; ++c) drawn[c * area + pixel] += by[c];
            alpha[pixel] -= by[0] * behind[0] + by[1] * behind[1] + by[2] * behind[2];
        }
    });
}

void misfit(const Misfit& job, int threads, float* sums) {
    const auto kernel = select_kernels().misfit;
    in_pictures(job.pictures, job.ends, threads, [&](size_t p, size_t begin, size_t end) { sums[p] = float(kernel(job, begin, end)); });
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
