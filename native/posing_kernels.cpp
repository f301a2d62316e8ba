// Where Gaussians are seen from, compiled once per SIMD level.

#include "kernels.h"

namespace evsplat {
namespace EVSPLAT_LEVEL {
namespace {

#include "simd.h"

// Hands out vectors of scratch.
struct Vectors {
    float* next;
    F* take(int count) { return (F*)(next += size_t(count) * W) - count; }
};

INLINE F exp(F v) { return exp2(min(v * 1.44269504f, splat(100.f))); }

// Columns of W rows, of which `count` are there, to vectors and back.
INLINE void load_columns(const float* rows, int columns, uint32_t count, F* to) {
    for (int k = 0; k < columns; ++k)
        for (uint32_t l = 0; l < uint32_t(W); ++l) ((float*)(to + k))[l] = l < count ? rows[l * columns + k] : 0.f;
}
INLINE void store_columns(const F* from, int columns, uint32_t count, float* rows) {
    for (uint32_t l = 0; l < count; ++l)
        for (int k = 0; k < columns; ++k) rows[l * columns + k] = ((const float*)(from + k))[l];
}

}  // namespace

void tree_softmax(const TreeSoftmax& job, size_t begin, size_t end, float* scratch) {
    Vectors vectors{scratch};
    const int joints = job.joints;
    F *logit = vectors.take(job.logits), *grad = vectors.take(job.logits);
    F *share = vectors.take(job.logits);    // of its parent's children, at the child's logit
    F *open = vectors.take(job.logits);     // sigmoid of gates
    F *mass = vectors.take(joints), *weight = vectors.take(joints), *above = vectors.take(joints);
    F *total = vectors.take(joints);        // of the children's exponentials, then of their gradients
    for (size_t at = begin; at < end; at += W) {
        const uint32_t count = uint32_t(end - at < W ? end - at : W);
        load_columns(job.given + at * job.logits, job.logits, count, logit);
        // Shares among children, from the largest logit so that no exponential overflows.
        for (int i = 0; i < joints; ++i) {
            const int j = job.order[i], p = job.parents[j];
            total[j] = F{}, above[j] = splat(-1e30f);
            if (p >= 0 && job.divides[p]) above[p] = max(above[p], logit[j]);
        }
        for (int i = 0; i < joints; ++i) {
            const int j = job.order[i], p = job.parents[j];
            if (p < 0 || !job.divides[p]) continue;
            share[j] = exp(logit[j] - above[p]);
            total[p] += share[j];
        }
        for (int i = 0; i < joints; ++i) {
            const int j = job.order[i], p = job.parents[j], g = job.gate[j];
            if (p < 0) {
                mass[j] = splat(1.f);
            } else {
                if (job.divides[p]) share[j] /= total[p];
                mass[j] = mass[p] * open[job.gate[p]];
                if (job.divides[p]) mass[j] *= share[j];
            }
            weight[j] = mass[j];
            if (g < 0) continue;
            const F small = exp(-max(logit[g], -logit[g])), larger = 1.f / (1.f + small), smaller = small * larger;
            const F nothing = logit[g] - logit[g];  // or no number, which the comparisons forget
            open[g] = select(logit[g] > 0.f, larger, smaller) + nothing;
            weight[j] *= select(logit[g] > 0.f, smaller, larger) + nothing;
        }
        if (job.weights) {
            store_columns(weight, joints, count, job.weights + at * joints);
            continue;
        }
        load_columns(job.above + at * joints, joints, count, above);
        for (int k = 0; k < job.logits; ++k) grad[k] = F{};
        for (int j = 0; j < joints; ++j) total[j] = F{};
        // Upwards: `above` times `weight`, and what the children say of what they were passed, `total`.
        for (int i = joints - 1; i >= 0; --i) {
            const int j = job.order[i], p = job.parents[j], g = job.gate[j];
            const F own = above[j] * weight[j], of_mass = own + total[j];
            if (g >= 0) grad[g] += total[j] * (1.f - open[g]) - own * open[g];
            if (p < 0) continue;
            if (job.divides[p]) grad[j] += of_mass;
            total[p] += of_mass;
        }
        for (int j = 0; j < joints; ++j) {
            const int p = job.parents[j];
            if (p >= 0 && job.divides[p]) grad[j] -= share[j] * total[p];
        }
        store_columns(grad, job.logits, count, job.grad + at * job.logits);
    }
}

void view_directions(const ViewDirections& job, size_t begin, size_t end) {
    for (size_t at = begin; at < end; at += W) {
        const uint32_t count = uint32_t(end - at < W ? end - at : W);
        const float* p = job.positions + at * 3;
        F v[3], u[3];
        for (int c = 0; c < 3; ++c) v[c] = gather<3>(p + c, count) - job.center[c];
        if (job.transforms) {
            const float* m = job.transforms + at * 16;
            for (int c = 0; c < 3; ++c)
                u[c] = gather<16>(m + c, count) * v[0] + gather<16>(m + 4 + c, count) * v[1] +
                       gather<16>(m + 8 + c, count) * v[2];
            for (int c = 0; c < 3; ++c) v[c] = u[c];
        }
        for (int c = 0; c < 3; ++c)
            u[c] = v[0] * job.turn[3 * c] + v[1] * job.turn[3 * c + 1] + v[2] * job.turn[3 * c + 2];
        const F length = sqrt(u[0] * u[0] + u[1] * u[1] + u[2] * u[2]), inverse = 1.f / max(splat(1e-12f), length);
        for (int c = 0; c < 3; ++c) {
            const F unit = u[c] * inverse;
            for (uint32_t l = 0; l < count; ++l) job.directions[(at + l) * 3 + c] = unit[l];
        }
    }
}

void sh_rows(const ShRows& job, size_t begin, size_t end) {
    const float c1 = 0.4886025119029199f, c2 = 1.0925484305920792f, c3 = 0.5900435899266435f;
    for (size_t at = begin; at < end; at += W) {
        const uint32_t count = uint32_t(end - at < W ? end - at : W);
        const float* p = job.directions + at * 3;
        const F x = gather<3>(p, count), y = gather<3>(p + 1, count), z = gather<3>(p + 2, count);
        const F xx = x * x, yy = y * y, zz = z * z, xy = x * y;
        const F around = 0.4570457994644658f * (4.f * zz - xx - yy);
        const F values[kShValues] = {
            -c1 * y,
            c1 * z,
            -c1 * x,
            c2 * xy,
            -c2 * (y * z),
            0.31539156525252005f * (2.f * zz - xx - yy),
            -c2 * (x * z),
            0.5462742152960396f * (xx - yy),
            -c3 * y * (3.f * xx - yy),
            2.890611442640554f * xy * z,
            -y * around,
            0.3731763325901154f * z * (2.f * zz - 3.f * xx - 3.f * yy),
            -x * around,
            1.445305721320277f * z * (xx - yy),
            -c3 * x * (xx - 3.f * yy),
        };
        float lanes[kShValues][W];
        for (int k = 0; k < kShValues; ++k) store(lanes[k], values[k]);
        for (uint32_t l = 0; l < count; ++l)
            for (int k = 0; k < kShValues; ++k) job.to[(at + l) * job.stride + k] = lanes[k][l];
    }
}

}  // namespace EVSPLAT_LEVEL
}  // namespace evsplat
