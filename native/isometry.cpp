#include "isometry.h"

#include <algorithm>
#include <cmath>
#include <vector>

#include "buffer.h"
#include "thread_pool.h"

namespace evsplat {
namespace {

// Rotation matrix of a quaternion, and the gradient of the quaternion.
struct Rotation {
    float q[4], inverse_length, r[9];

    explicit Rotation(const float* quat) {
        const float length = std::sqrt(quat[0] * quat[0] + quat[1] * quat[1] + quat[2] * quat[2] + quat[3] * quat[3]);
        inverse_length = 1.f / std::fmax(length, 1e-12f);
        for (int i = 0; i < 4; ++i) q[i] = quat[i] * inverse_length;
        const float w = q[0], x = q[1], y = q[2], z = q[3];
        r[0] = 1 - 2 * (y * y + z * z), r[1] = 2 * (x * y - w * z), r[2] = 2 * (x * z + w * y);
        r[3] = 2 * (x * y + w * z), r[4] = 1 - 2 * (x * x + z * z), r[5] = 2 * (y * z - w * x);
        r[6] = 2 * (x * z - w * y), r[7] = 2 * (y * z + w * x), r[8] = 1 - 2 * (x * x + y * y);
    }

    void add_gradient(const float* d, float* grad) const {
        const float w = q[0], x = q[1], y = q[2], z = q[3];
        const float g[4] = {
            2 * (x * (d[7] - d[5]) + y * (d[2] - d[6]) + z * (d[3] - d[1])),
            2 * (w * (d[7] - d[5]) + y * (d[1] + d[3]) + z * (d[2] + d[6]) - 2 * x * (d[4] + d[8])),
            2 * (w * (d[2] - d[6]) + x * (d[1] + d[3]) + z * (d[5] + d[7]) - 2 * y * (d[0] + d[8])),
            2 * (w * (d[3] - d[1]) + x * (d[2] + d[6]) + y * (d[5] + d[7]) - 2 * z * (d[0] + d[4])),
        };
        const float along = g[0] * w + g[1] * x + g[2] * y + g[3] * z;
        for (int i = 0; i < 4; ++i) grad[i] += (g[i] - along * q[i]) * inverse_length;
    }
};

// Covariance M M^T of M = A R diag(s), upper triangle; A is null for the identity.
struct Covariance {
    Rotation rotation;
    float scales[3], inner[9], m[9], upper[6];  // inner = R diag(s)
    const float* linear;                        // (4, 4) row-major

    Covariance(const float* quat, const float* given_scales, const float* transform)
        : rotation(quat), linear(transform) {
        for (int c = 0; c < 3; ++c) scales[c] = given_scales[c];
        for (int i = 0; i < 9; ++i) inner[i] = rotation.r[i] * scales[i % 3];
        for (int r = 0; r < 3; ++r)
            for (int c = 0; c < 3; ++c)
                m[3 * r + c] = linear ? linear[4 * r] * inner[c] + linear[4 * r + 1] * inner[3 + c] +
                                            linear[4 * r + 2] * inner[6 + c]
                                      : inner[3 * r + c];
        int k = 0;
        for (int a = 0; a < 3; ++a)
            for (int b = a; b < 3; ++b, ++k)
                upper[k] = m[3 * a] * m[3 * b] + m[3 * a + 1] * m[3 * b + 1] + m[3 * a + 2] * m[3 * b + 2];
    }

    // `g`: gradient of `upper`. `by_scales` is that of the scales.
    void add_gradient(const float (&g)[6], float* quat_grad, float (&by_scales)[3], float* transform_grad) const {
        const float symmetric[9] = {2 * g[0], g[1], g[2], g[1], 2 * g[3], g[4], g[2], g[4], 2 * g[5]};
        float by_m[9], by_inner[9], by_rotation[9];
        for (int r = 0; r < 3; ++r)
            for (int c = 0; c < 3; ++c)
                by_m[3 * r + c] = symmetric[3 * r] * m[c] + symmetric[3 * r + 1] * m[3 + c] + symmetric[3 * r + 2] * m[6 + c];
        for (int r = 0; r < 3; ++r)
            for (int c = 0; c < 3; ++c) {
                by_inner[3 * r + c] = linear ? linear[r] * by_m[c] + linear[4 + r] * by_m[3 + c] + linear[8 + r] * by_m[6 + c]
                                             : by_m[3 * r + c];
                if (linear)
                    transform_grad[4 * r + c] += by_m[3 * r] * inner[3 * c] + by_m[3 * r + 1] * inner[3 * c + 1] +
                                                 by_m[3 * r + 2] * inner[3 * c + 2];
            }
        for (int c = 0; c < 3; ++c) {
            by_scales[c] = by_inner[c] * rotation.r[c] + by_inner[3 + c] * rotation.r[3 + c] + by_inner[6 + c] * rotation.r[6 + c];
            for (int r = 0; r < 3; ++r) by_rotation[3 * r + c] = by_inner[3 * r + c] * scales[c];
        }
        rotation.add_gradient(by_rotation, quat_grad);
    }
};

// Length of a - b, and a - b over it (zero where they are equal).
template <int n>
float distance(const float* a, const float* b, float (&direction)[n]) {
    float square = 0.f;
    for (int i = 0; i < n; ++i) direction[i] = a[i] - b[i], square += direction[i] * direction[i];
    const float length = std::sqrt(square);
    for (int i = 0; i < n; ++i) direction[i] = length > 0.f ? direction[i] / length : 0.f;
    return length;
}

float sign(float v) { return v > 0.f ? 1.f : v < 0.f ? -1.f : 0.f; }

constexpr int kRows = 1 + kNeighbours;

// Sum over neighbours of the absolute change of distance between the n-vectors of one place (the first)
// and its neighbours; adds the gradients times `share`.
template <int n>
float change(const float (&before)[kRows][n], const float (&after)[kRows][n], float share, float (&by_before)[kRows][n],
             float (&by_after)[kRows][n]) {
    float total = 0.f;
    for (int k = 1; k < kRows; ++k) {
        float direction_before[n], direction_after[n];
        const float difference =
            distance(after[0], after[k], direction_after) - distance(before[0], before[k], direction_before);
        total += std::fabs(difference);
        const float slope = share * sign(difference);
        for (int i = 0; i < n; ++i) {
            by_after[0][i] += slope * direction_after[i], by_after[k][i] -= slope * direction_after[i];
            by_before[0][i] -= slope * direction_before[i], by_before[k][i] += slope * direction_before[i];
        }
    }
    return total;
}

struct Sample {
    const IsometryInputs& in;
    const IsometryGrads& grads;
    const int64_t* rows;
    float share;

    double centers() const {
        double total = 0.0;
        float before[kRows][3], by_before[kRows][3] = {};
        for (int k = 0; k < kRows; ++k)
            for (int i = 0; i < 3; ++i) before[k][i] = in.means[rows[k] * 3 + i];
        for (size_t t = 0; t < in.times; ++t) {
            float after[kRows][3], by_after[kRows][3] = {};
            for (int k = 0; k < kRows; ++k)
                for (int i = 0; i < 3; ++i) after[k][i] = in.posed_means[(t * in.points + rows[k]) * 3 + i];
            total += change(before, after, share, by_before, by_after);
            for (int k = 0; k < kRows; ++k)
                for (int i = 0; i < 3; ++i) grads.posed_means[(t * in.points + rows[k]) * 3 + i] += by_after[k][i];
        }
        for (int k = 0; k < kRows; ++k)
            for (int i = 0; i < 3; ++i) grads.means[rows[k] * 3 + i] += by_before[k][i];
        return total;
    }

    double covariances() const {
        double total = 0.0;
        float before[kRows][6], by_before[kRows][6] = {};
        const Covariance at_rest[kRows] = {canonical(0), canonical(1), canonical(2), canonical(3), canonical(4)};
        for (int k = 0; k < kRows; ++k) copy(at_rest[k], before[k]);
        for (size_t t = 0; t < in.times; ++t) {
            float after[kRows][6], by_after[kRows][6] = {};
            const Covariance now[kRows] = {posed(t, 0), posed(t, 1), posed(t, 2), posed(t, 3), posed(t, 4)};
            for (int k = 0; k < kRows; ++k) copy(now[k], after[k]);
            total += change(before, after, share, by_before, by_after);
            for (int k = 0; k < kRows; ++k) {
                const size_t row = t * in.points + rows[k];
                float by_scales[3];
                now[k].add_gradient(by_after[k], grads.posed_quaternions + row * 4, by_scales, grads.transforms + row * 16);
                for (int i = 0; i < 3; ++i) grads.posed_scales[row * 3 + i] += by_scales[i];
            }
        }
        for (int k = 0; k < kRows; ++k) {
            float by_scales[3];
            at_rest[k].add_gradient(by_before[k], grads.quaternions + rows[k] * 4, by_scales, nullptr);
            for (int i = 0; i < 3; ++i) grads.scales_log[rows[k] * 3 + i] += by_scales[i] * at_rest[k].scales[i];
        }
        return total;
    }

  private:
    static void copy(const Covariance& from, float (&to)[6]) {
        for (int i = 0; i < 6; ++i) to[i] = from.upper[i];
    }
    Covariance canonical(int k) const {
        const size_t row = rows[k];
        const float* log = in.scales_log + row * 3;
        const float scales[3] = {std::exp(log[0]), std::exp(log[1]), std::exp(log[2])};
        return {in.quaternions + row * 4, scales, nullptr};
    }
    Covariance posed(size_t time, int k) const {
        const size_t row = time * in.points + rows[k];
        return {in.posed_quaternions + row * 4, in.posed_scales + row * 3, in.transforms + row * 16};
    }
};

// Places of the seven arrays of one sample in its own copy, and how many of each there are.
struct Layout {
    static constexpr size_t kWidth[7] = {3, 4, 3, 3, 4, 3, 16};
    size_t begin[8];

    explicit Layout(size_t times) {
        begin[0] = 0;
        for (int a = 0; a < 7; ++a) begin[a + 1] = begin[a] + kWidth[a] * kRows * (a < 3 ? 1 : times);
    }

    // work(floats of an array, at which row, place in the copy) for all rows of a sample.
    template <class Work>
    void rows(const int64_t* rows, size_t times, size_t points, const Work& work) const {
        for (int a = 0; a < 7; ++a)
            for (size_t t = 0; t < (a < 3 ? 1 : times); ++t)
                for (int k = 0; k < kRows; ++k)
                    work(a, (t * points + rows[k]) * kWidth[a], begin[a] + (t * kRows + k) * kWidth[a]);
    }
};

}  // namespace

size_t isometry_floats(size_t times) { return Layout(times).begin[7]; }

IsometryMeans isometry(const IsometryInputs& in, int threads, float* gradients) {
    const Layout layout(in.times);
    const size_t floats = layout.begin[7];
    const float share = float(1.0 / (double(in.samples) * kNeighbours * in.times));
    const float* arrays[7] = {in.means,       in.quaternions,        in.scales_log, in.posed_means,
                              in.posed_quaternions, in.posed_scales, in.transforms};
    std::vector<IsometryMeans> sums(in.samples);
    in_pieces(threads, in.samples, 32, [&](size_t begin, size_t end) {
        Buffer<float> copy(floats);
        float* c = copy.data();
        const int64_t own[kRows] = {0, 1, 2, 3, 4};
        for (size_t s = begin; s < end; ++s) {
            layout.rows(in.rows + s * kRows, in.times, in.points, [&](int a, size_t from, size_t to) {
                std::copy_n(arrays[a] + from, Layout::kWidth[a], c + to);
            });
            float* g = gradients + s * floats;
            std::fill_n(g, floats, 0.f);
            const size_t* at = layout.begin;
            const IsometryInputs one = {1,         in.times,  kRows,     own,       c + at[0], c + at[1],
                                        c + at[2], c + at[3], c + at[4], c + at[5], c + at[6]};
            const IsometryGrads grads = {kRows, g + at[0], g + at[1], g + at[2], g + at[3], g + at[4], g + at[5], g + at[6]};
            const Sample sample = {one, grads, own, share};
            sums[s] = {sample.centers(), sample.covariances()};
        }
    });
    IsometryMeans means = {};
    for (const IsometryMeans& sum : sums) means.centers += sum.centers, means.covariances += sum.covariances;
    return {means.centers * share, means.covariances * share};
}

void isometry_write(const IsometryInputs& in, const float* gradients, float by_centers, float by_covariances, int threads,
                    const IsometryGrads& grads) {
    const Layout layout(in.times);
    float* arrays[7] = {grads.means,       grads.quaternions,        grads.scales_log, grads.posed_means,
                        grads.posed_quaternions, grads.posed_scales, grads.transforms};
    // An array at one time belongs to one thread, which takes the samples in order. The widest come first.
    const size_t pieces = 3 + 4 * in.times;
    parallel_for(threads, pieces, [&](size_t piece) {
        const size_t place = pieces - 1 - piece;
        const int a = int(place < 3 ? place : 3 + (place - 3) / in.times);
        const size_t t = place < 3 ? 0 : (place - 3) % in.times, width = Layout::kWidth[a];
        const size_t points = place < 3 ? grads.canonical_points : in.points;
        float* to = arrays[a] + t * points * width;
        std::fill_n(to, points * width, 0.f);
        const float by = a % 3 == 0 && a < 6 ? by_centers : by_covariances;
        const float* from = gradients + layout.begin[a] + t * kRows * width;
        for (size_t s = 0; s < in.samples; ++s, from += layout.begin[7])
            for (int k = 0; k < kRows; ++k) {
                float* row = to + in.rows[s * kRows + k] * width;
                for (size_t i = 0; i < width; ++i) row[i] += by * from[k * width + i];
            }
    });
}

}  // namespace evsplat
