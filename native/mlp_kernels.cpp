// Products of panel matrices for one block of points, compiled once per SIMD level.

#include "mlp_kernels.h"

#include "kernels.h"
#if defined(__x86_64__)
#include <immintrin.h>
#endif

namespace evsplat {
namespace EVSPLAT_LEVEL {
namespace {

#include "simd.h"

#include "mlp_panels.h"

void forward(const MlpShape& s, const MlpForward& job, size_t block, float* scratch) {
    const size_t first = block * R;
    const F slope = splat(s.slope);
    float* point = scratch;
    float* both = point + s.point_panels * kPanel;
    float* shared = both + s.both_panels * kPanel;
    float* result = shared + s.width_panels * kPanel;
    float* turns = result + s.out_panels * kPanel;  // two matrices, used in turn without keep

    pack(job.point, first, s.points, s.per_point, s.point_panels, point);
    const auto zero = [](int, int) { return F{}; };
    rows_times<Single>(point, s.per_point, job.point_weight.forward, s.width_panels, zero, to_panels(shared));
    for (size_t t = 0; t < s.times; ++t) {
        float* kept = s.keep ? job.activations + (block * s.times + t) * s.kept() : turns;
        const float* bias = job.bias + t * s.width_panels * W;
        const auto start = [&](int p, int r) { return load(shared + p * kPanel + r * W) + load(bias + p * W); };
        const auto into = [&](float* to) {
            return [to, slope](int p, int r, F a, F b) { to_panels(to)(p, r, leaky(a, slope), leaky(b, slope)); };
        };
        if (job.both) {
            pack(job.both + t * s.points * s.per_both, first, s.points, s.per_both, s.both_panels, both);
            rows_times<Single>(both, s.per_both, job.both_weight.forward, s.width_panels, start, into(kept));
        } else {
            for (int p = 0; p < s.width_panels; ++p)
                for (int r = 0; r < R; r += 2) into(kept)(p, r, start(p, r), start(p, r + 1));
        }
        const float* x = kept;
        for (int l = 0; l < s.layers; ++l) {
            const MlpWeight& w = job.layer[l];
            const auto from_bias = [&](int p, int) { return load(w.bias + p * W); };
            if (l + 1 == s.layers) {
                rows_times<Single>(x, s.width, w.forward, s.out_panels, from_bias, to_panels(result));
            } else {
                const size_t next = s.keep ? l + 1 : (l + 1) % 2;
                float* y = kept + next * s.width_panels * kPanel;
                rows_times<Single>(x, s.width, w.forward, s.width_panels, from_bias, into(y));
                x = y;
            }
        }
        unpack(result, first, s.points, s.out, job.output + t * s.points * s.out);
    }
}

void backward(const MlpShape& s, const MlpBackward& job, size_t block, const MlpSums& sums, float* scratch) {
    const MlpForward& f = job.forward;
    const size_t first = block * R, matrix = s.width_panels * kPanel;
    const F slope = splat(s.slope);
    float* point = scratch;
    float* both = point + s.point_panels * kPanel;
    float* above = both + s.both_panels * kPanel;
    float* flow = above + s.out_panels * kPanel;
    float* next = flow + matrix;
    float* over_times = next + matrix;

    const auto zero = [](int, int) { return F{}; };
    pack(f.point, first, s.points, s.per_point, s.point_panels, point);
    for (size_t t = 0; t < s.times; ++t) {
        const float* kept = f.activations + (block * s.times + t) * s.kept();
        pack(job.output_grad + t * s.points * s.out, first, s.points, s.out, s.out_panels, above);
        const float* y = above;
        for (int l = s.layers - 1; l >= 0; --l) {
            const float* x = kept + l * matrix;
            add_outer<Single>(y, s.panels(l), x, s.width_panels, sums.weight[l]);
            add_column_sums(y, s.panels(l), sums.layer_bias[l]);
            float* to = y == flow ? next : flow;
            rows_times<Single>(y, s.columns(l), f.layer[l].backward, s.width_panels, zero, [&](int p, int r, F a, F b) {
                const float* seen = x + p * kPanel + r * W;
                to_panels(to)(p, r, leaky_slope(load(seen), a, slope), leaky_slope(load(seen + W), b, slope));
            });
            y = to;
        }
        to_first_layer(s, job, first, t, y, both, sums);
        for (size_t i = 0; i < matrix; i += W)
            store(over_times + i, t ? load(over_times + i) + load(y + i) : load(y + i));
    }
    to_points(s, job, first, over_times, point, sums);
}

}  // namespace

const MlpKernels mlp_kernels = {W, 1, forward, backward};

}  // namespace EVSPLAT_LEVEL
}  // namespace evsplat
