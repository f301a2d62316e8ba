#include "posing.h"

#include <algorithm>
#include <cmath>

#include "buffer.h"
#include "levels.h"
#include "thread_pool.h"

namespace evsplat {
namespace {

constexpr size_t kPiece = 1024;  // points of one piece of work; a multiple of every level's lanes

// Where a coordinate lies among the bins: beyond [0, 1] on the nearest end, and with what is no number in the
// first bin as no number.
struct Bump {
    int bin, before, after;   // the bins it reaches
    float below, upto;        // ends of its own bin, from the bump's middle
    bool moves;               // whether it follows the coordinate

    Bump(float coordinate, int bins) {
        const float scaled = (coordinate < 0.f ? 0.f : coordinate > 1.f ? 1.f : coordinate) * float(bins);
        bin = scaled >= 0.f ? std::min(int(scaled), bins - 1) : 0;
        before = bin ? bin - 1 : bins - 1, after = bin + 1 < bins ? bin + 1 : 0;
        below = float(bin) - scaled, upto = float(bin + 1) - scaled;
        moves = coordinate >= 0.f && coordinate <= 1.f;
    }
    static float sum(float u) { return 0.5f + u * (0.9375f + u * u * (0.1875f * u * u - 0.625f)); }
    static float slope(float u) { return 0.9375f * (1.f - u * u) * (1.f - u * u); }
};

// A quaternion over its length.
struct Unit {
    float w, x, y, z, inverse_length;

    explicit Unit(const float* q) {
        const float length = std::sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]);
        inverse_length = 1.f / std::max(length, 1e-12f);
        w = q[0] * inverse_length, x = q[1] * inverse_length, y = q[2] * inverse_length, z = q[3] * inverse_length;
    }
};

}  // namespace

void view_directions(const ViewDirections& job, int threads) {
    const auto kernel = select_kernels().view_directions;
    in_pieces(threads, job.points, kPiece, [&](size_t begin, size_t end) { kernel(job, begin, end); });
}

size_t rows_in_view(const InView& job, int64_t* rows) {
    const float *r = job.pose, fx = job.k[0], fy = job.k[4], cx = job.k[2], cy = job.k[5];
    // An opacity of 1 falls below 1/255 at 3.33 deviations; radii are whole pixels, and rounding is not known.
    constexpr float kReach = 3.34f * 3.34f, kLowPass = 0.3f, kMargin = 2.f, kNear = 0.0099f;
    // The projection's slope is taken at most 0.15 of a picture beyond its sides.
    const auto widest = [](float side, float center, float focal) {
        const float low = (center + 0.15f * side) / focal, high = (1.15f * side - center) / focal;
        return std::max(low * low, high * high);
    };
    const float wide_x = widest(float(job.width), cx, fx), wide_y = widest(float(job.height), cy, fy);
    size_t count = 0;
    for (size_t i = 0; i < job.points; ++i) {
        const float *p = job.means + i * 3, *s = job.scales + i * 3;
        const float x = r[0] * p[0] + r[1] * p[1] + r[2] * p[2] + r[3];
        const float y = r[4] * p[0] + r[5] * p[1] + r[6] * p[2] + r[7];
        const float z = r[8] * p[0] + r[9] * p[1] + r[10] * p[2] + r[11];
        const float xn = x / z, yn = y / z;
        const float largest = std::max({s[0] * s[0], s[1] * s[1], s[2] * s[2]}) / (z * z);
        // A row of the slope is f / z sqrt(1 + (x / z)^2) long.
        const float reach_x = kReach * (fx * fx * largest * (1.f + wide_x) + kLowPass);
        const float reach_y = kReach * (fy * fy * largest * (1.f + wide_y) + kLowPass);
        const float px = fx * xn + cx, py = fy * yn + cy;
        const float beyond_x = std::max(-px, px - float(job.width)) - kMargin;
        const float beyond_y = std::max(-py, py - float(job.height)) - kMargin;
        const bool out = (beyond_x > 0.f && beyond_x * beyond_x > reach_x) ||
                         (beyond_y > 0.f && beyond_y * beyond_y > reach_y) || z < kNear;
        rows[count] = int64_t(i);
        count += !out;
    }
    return count;
}

void sh_rows(const ShRows& job, int threads) {
    const auto kernel = select_kernels().sh_rows;
    in_pieces(threads, job.points, kPiece, [&](size_t begin, size_t end) {
        kernel(job, begin, end);
        for (size_t i = begin; i < end; ++i)
            std::copy_n(job.values + i * job.columns, job.columns, job.beside + i * job.stride);
    });
}

void one_blob(const OneBlob& job, int threads, float* encoded) {
    in_pieces(threads, job.points, kPiece, [&](size_t begin, size_t end) {
        std::fill(encoded + begin * 3 * job.bins, encoded + end * 3 * job.bins, 0.f);
        for (size_t i = begin * 3; i < end * 3; ++i) {
            const Bump bump(job.positions[i], job.bins);
            const float below = Bump::sum(bump.below), upto = Bump::sum(bump.upto);
            float* to = encoded + i * job.bins;
            to[bump.before] = below, to[bump.bin] = upto - below, to[bump.after] = 1.f - upto;
        }
    });
}

void one_blob_backward(const OneBlob& job, const float* above, int threads, float* grad) {
    in_pieces(threads, job.points, kPiece, [&](size_t begin, size_t end) {
        for (size_t i = begin * 3; i < end * 3; ++i) {
            const Bump bump(job.positions[i], job.bins);
            const float* by = above + i * job.bins;
            const float slope = Bump::slope(bump.below) * (by[bump.bin] - by[bump.before]) +
                                Bump::slope(bump.upto) * (by[bump.after] - by[bump.bin]);
            grad[i] = bump.moves ? slope * float(job.bins) : 0.f;
        }
    });
}

void tree_softmax(const TreeSoftmax& job, int threads) {
    const auto kernel = select_kernels().tree_softmax;
    in_pieces(threads, job.points, kPiece, [&](size_t begin, size_t end) {
        Buffer<float> scratch(tree_softmax_floats(job.joints, job.logits));
        kernel(job, begin, end, scratch.data());
    });
}

void change_shape(const ShapeChange& job, int threads, float* moved, float* scales, float* rotations, float* feature) {
    const size_t rest = job.columns - kShapeChanges;
    in_pieces(threads, job.points, kPiece, [&](size_t begin, size_t end) {
        for (size_t t = 0; t < job.times; ++t)
            for (size_t i = begin; i < end; ++i) {
                const size_t row = t * job.points + i;
                const float* by = job.changes + row * job.columns;
                for (int c = 0; c < 3; ++c) {
                    moved[row * 3 + c] = job.means[i * 3 + c] + by[c];
                    scales[row * 3 + c] = std::exp(job.scales_log[i * 3 + c] + by[3 + c]);
                }
                const Unit q(job.quaternions + i * 4);
                const float x = by[6], y = by[7], z = by[8];
                float* r = rotations + row * 4;
                r[0] = q.w - x * q.x - y * q.y - z * q.z;
                r[1] = q.x + x * q.w + y * q.z - z * q.y;
                r[2] = q.y - x * q.z + y * q.w + z * q.x;
                r[3] = q.z + x * q.y - y * q.x + z * q.w;
                std::copy_n(by + kShapeChanges, rest, feature + row * rest);
            }
    });
}

void change_shape_backward(const ShapeChange& job, const float* scales, const ShapeGrad (&above)[4], int threads,
                           float* changes, float* means, float* scales_log, float* quaternions) {
    const size_t rest = job.columns - kShapeChanges;
    // Times are taken one after the other: many places in memory read from at once are slow.
    in_pieces(threads, job.points, kPiece, [&](size_t begin, size_t end) {
        std::fill(means + begin * 3, means + end * 3, 0.f);
        std::fill(scales_log + begin * 3, scales_log + end * 3, 0.f);
        std::fill(quaternions + begin * 4, quaternions + end * 4, 0.f);
        for (size_t t = 0; t < job.times; ++t)
            for (size_t i = begin; i < end; ++i) {
                const Unit q(job.quaternions + i * 4);
                const size_t row = t * job.points + i;
                const float* by = job.changes + row * job.columns;
                float *to = changes + row * job.columns, *mean = means + i * 3, *unit = quaternions + i * 4;
                const auto grad = [&](int which, int c) {
                    return above[which].data ? above[which].data[row * above[which].step + c] : 0.f;
                };
                for (int c = 0; c < 3; ++c) {
                    to[c] = grad(0, c), to[3 + c] = grad(1, c) * scales[row * 3 + c];
                    mean[c] += to[c], scales_log[i * 3 + c] += to[3 + c];
                }
                const float w = grad(2, 0), x = grad(2, 1), y = grad(2, 2), z = grad(2, 3);
                to[6] = -w * q.x + x * q.w - y * q.z + z * q.y;
                to[7] = -w * q.y + x * q.z + y * q.w - z * q.x;
                to[8] = -w * q.z - x * q.y + y * q.x + z * q.w;
                unit[0] += w + x * by[6] + y * by[7] + z * by[8];
                unit[1] += x - w * by[6] - z * by[7] + y * by[8];
                unit[2] += y - w * by[7] + z * by[6] - x * by[8];
                unit[3] += z - w * by[8] - y * by[6] + x * by[7];
                if (above[3].data)
                    std::copy_n(above[3].data + row * above[3].step, rest, to + kShapeChanges);
                else
                    std::fill_n(to + kShapeChanges, rest, 0.f);
            }
        for (size_t i = begin; i < end; ++i) {
            const Unit q(job.quaternions + i * 4);
            float* unit = quaternions + i * 4;
            const float along = unit[0] * q.w + unit[1] * q.x + unit[2] * q.y + unit[3] * q.z;
            const float direction[4] = {q.w, q.x, q.y, q.z};
            for (int c = 0; c < 4; ++c) unit[c] = (unit[c] - along * direction[c]) * q.inverse_length;
        }
    });
}

}  // namespace evsplat
