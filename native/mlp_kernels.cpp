// Networks on panel matrices, for one block of points; compiled once per SIMD level.

#include "kernels.h"

namespace evsplat {
namespace EVSPLAT_LEVEL {
namespace {

#include "simd.h"

constexpr int kTileRows = W == 16 ? 8 : 4;  // with two panels: half of the registers hold sums
constexpr int R = kMlpRows;
constexpr size_t kPanel = size_t(R) * W;
static_assert(R % kTileRows == 0, "a block is a whole number of tiles");

template <int n>
struct Count {
    static constexpr int value = n;
};

// sums[p][i] += sum over k of a(i, k) * b(k, panel p). Element a(i, k) is at
// a + (k / inner) * outer_step + (k % inner) * k_step + i * i_step.
template <int panels, int i_step, int k_step>
INLINE void multiply(F (&sums)[2][kTileRows], const float* a, size_t outer_step, int inner, int count, const float* b,
                     size_t b_step) {
    for (int done = 0; done < count; done += inner, a += outer_step) {
        const int n = count - done < inner ? count - done : inner;
        for (int k = 0; k < n; ++k, b += W) {
            const F b0 = load(b), b1 = load(panels == 2 ? b + b_step : b);
#pragma GCC unroll 8
            for (int i = 0; i < kTileRows; ++i) {
                const F x = splat(a[k * k_step + i * i_step]);
                sums[0][i] = sums[0][i] + x * b0;
                if (panels == 2) sums[1][i] = sums[1][i] + x * b1;
            }
        }
    }
}

// For every tile of a (rows, columns) result: start(p, row) -> F, then the product, then
// end(p, row, F, F) for two rows. `x` (R, count) in panels times `w` (panels of the result, count, lanes).
template <class Start, class End>
INLINE void rows_times(const float* x, int count, const float* w, int panels, Start start, End end) {
    const size_t step = size_t(count) * W;
    const auto tile = [&](auto together, int p, int row) {
        constexpr int n = decltype(together)::value;
        F sums[2][kTileRows];
        for (int q = 0; q < n; ++q)
#pragma GCC unroll 8
            for (int i = 0; i < kTileRows; ++i) sums[q][i] = start(p + q, row + i);
        multiply<n, W, 1>(sums, x + size_t(row) * W, kPanel, W, count, w + p * step, step);
        for (int q = 0; q < n; ++q)
#pragma GCC unroll 4
            for (int i = 0; i < kTileRows; i += 2) end(p + q, row + i, sums[q][i], sums[q][i + 1]);
    };
    int p = 0;
    for (; p + 2 <= panels; p += 2)
        for (int row = 0; row < R; row += kTileRows) tile(Count<2>{}, p, row);
    if (p < panels)
        for (int row = 0; row < R; row += kTileRows) tile(Count<1>{}, p, row);
}

// An end of rows_times: the result to panels.
INLINE auto to_panels(float* to) {
    return [to](int p, int row, F a, F b) {
        store(to + p * kPanel + row * W, a);
        store(to + p * kPanel + row * W + W, b);
    };
}

// sum (x panels, columns of y's panels, lanes) += y^T x over the rows of both; of y only `used` columns.
INLINE void add_outer(const float* y, int used, const float* x, int x_panels, float* sum) {
    const int columns = (used + W - 1) / W * W;
    const auto tile = [&](auto together, int p, int column) {
        constexpr int n = decltype(together)::value;
        F sums[2][kTileRows];
        float* c = sum + (size_t(p) * columns + column) * W;
        const size_t step = size_t(columns) * W;
        for (int q = 0; q < n; ++q)
#pragma GCC unroll 8
            for (int i = 0; i < kTileRows; ++i) sums[q][i] = load(c + q * step + i * W);
        multiply<n, 1, W>(sums, y + (column / W) * kPanel + column % W, 0, R, R, x + p * kPanel, kPanel);
        for (int q = 0; q < n; ++q)
#pragma GCC unroll 8
            for (int i = 0; i < kTileRows; ++i) store(c + q * step + i * W, sums[q][i]);
    };
    int p = 0;
    for (; p + 2 <= x_panels; p += 2)
        for (int column = 0; column < used; column += kTileRows) tile(Count<2>{}, p, column);
    if (p < x_panels)
        for (int column = 0; column < used; column += kTileRows) tile(Count<1>{}, p, column);
}

INLINE void add_column_sums(const float* x, int panels, float* sum) {
    // A sum waits for the one before it: several panels side by side wait together.
    const auto some = [&](auto together, int p) {
        constexpr int n = decltype(together)::value;
        F total[n];
        for (int q = 0; q < n; ++q) total[q] = load(sum + (p + q) * W);
        for (int r = 0; r < R; ++r)
#pragma GCC unroll 4
            for (int q = 0; q < n; ++q) total[q] = total[q] + load(x + (p + q) * kPanel + r * W);
        for (int q = 0; q < n; ++q) store(sum + (p + q) * W, total[q]);
    };
    int p = 0;
    for (; p + 4 <= panels; p += 4) some(Count<4>{}, p);
    for (; p < panels; ++p) some(Count<1>{}, p);
}

INLINE F leaky(F v, F slope) { return select(v > 0.f, v, v * slope); }

// Back through the leaky ReLU that gave `activation`, which has the sign of its input.
INLINE F leaky_slope(F activation, F v, F slope) { return select(activation > 0.f, v, v * slope); }

// Rows [first, first + R) of (rows, columns) to panels; rows and columns beyond the end are zero.
void pack(const float* from, size_t first, size_t rows, int columns, int panels, float* to) {
    const size_t have = rows - first < size_t(R) ? rows - first : R;
    for (int p = 0; p < panels; ++p) {
        const size_t n = columns - p * W;
        float* panel = to + p * kPanel;
        for (size_t r = 0; r < have; ++r)
            store(panel + r * W, load_some(from + (first + r) * columns + p * W, n));
        for (size_t r = have; r < size_t(R); ++r) store(panel + r * W, F{});
    }
}

void unpack(const float* from, size_t first, size_t rows, int columns, float* to) {
    const size_t have = rows - first < size_t(R) ? rows - first : R;
    for (int p = 0; p * W < columns; ++p) {
        const size_t n = columns - p * W;
        for (size_t r = 0; r < have; ++r)
            store_some(to + (first + r) * columns + p * W, load(from + p * kPanel + r * W), n);
    }
}

// The gradient `y` of the first layer at one time, to its bias and to what is given per point and time.
INLINE void to_first_layer(const MlpShape& s, const MlpBackward& job, size_t first, size_t t, const float* y,
                           float* both, const MlpSums& sums) {
    const MlpForward& f = job.forward;
    add_column_sums(y, s.width_panels, sums.bias + t * s.width_panels * W);
    if (!f.both) return;
    const size_t offset = t * s.points * s.per_both;
    pack(f.both + offset, first, s.points, s.per_both, s.both_panels, both);
    add_outer(y, s.width, both, s.both_panels, sums.both_weight);
    if (!job.both_grad) return;
    const auto zero = [](int, int) { return F{}; };
    rows_times(y, s.width, f.both_weight.backward, s.both_panels, zero, to_panels(both));
    unpack(both, first, s.points, s.per_both, job.both_grad + offset);
}

// The sum `y` of that gradient over the times, to what is given per point; `point` holds that.
INLINE void to_points(const MlpShape& s, const MlpBackward& job, size_t first, const float* y, float* point,
                      const MlpSums& sums) {
    add_outer(y, s.width, point, s.point_panels, sums.point_weight);
    if (!job.point_grad) return;
    const auto zero = [](int, int) { return F{}; };
    rows_times(y, s.width, job.forward.point_weight.backward, s.point_panels, zero, to_panels(point));
    unpack(point, first, s.points, s.per_point, job.point_grad);
}

}  // namespace

// One block of points through all layers.
void mlp_forward(const MlpShape& s, const MlpForward& job, size_t block, float* scratch) {
    const size_t first = block * R, matrix = s.width_panels * kPanel;
    const F slope = splat(s.slope);
    float* point = scratch;
    float* both = point + s.point_panels * kPanel;
    float* shared = both + s.both_panels * kPanel;
    float* result = shared + matrix;
    float* turns = result + s.out_panels * kPanel;  // two matrices, used in turn

    pack(job.point, first, s.points, s.per_point, s.point_panels, point);
    const auto zero = [](int, int) { return F{}; };
    rows_times(point, s.per_point, job.point_weight.forward, s.width_panels, zero, to_panels(shared));
    for (size_t t = 0; t < s.times; ++t) {
        float* kept = s.keep ? job.activations + (block * s.times + t) * s.kept() : nullptr;
        const auto input = [&](int layer) { return turns + layer % 2 * matrix; };
        const auto into = [&](int layer) {
            return [own = input(layer), copy = kept ? kept + layer * matrix : nullptr, slope](int p, int r, F a, F b) {
                const size_t at = p * kPanel + r * W;
                a = leaky(a, slope), b = leaky(b, slope);
                store(own + at, a), store(own + at + W, b);
                if (copy) stream(copy + at, a), stream(copy + at + W, b);
            };
        };
        const float* bias = job.bias + t * s.width_panels * W;
        const auto start = [&](int p, int r) { return load(shared + p * kPanel + r * W) + load(bias + p * W); };
        if (job.both) {
            pack(job.both + t * s.points * s.per_both, first, s.points, s.per_both, s.both_panels, both);
            rows_times(both, s.per_both, job.both_weight.forward, s.width_panels, start, into(0));
        } else {
            for (int p = 0; p < s.width_panels; ++p)
                for (int r = 0; r < R; r += 2) into(0)(p, r, start(p, r), start(p, r + 1));
        }
        for (int l = 0; l < s.layers; ++l) {
            const MlpWeight& w = job.layer[l];
            const auto from_bias = [&](int p, int) { return load(w.bias + p * W); };
            if (l + 1 == s.layers)
                rows_times(input(l), s.width, w.forward, s.out_panels, from_bias, to_panels(result));
            else
                rows_times(input(l), s.width, w.forward, s.width_panels, from_bias, into(l + 1));
        }
        unpack(result, first, s.points, s.out, job.output + t * s.points * s.out);
    }
}

// The gradient of one block.
void mlp_backward(const MlpShape& s, const MlpBackward& job, size_t block, const MlpSums& sums, float* scratch) {
    const MlpForward& f = job.forward;
    const size_t first = block * R, matrix = s.width_panels * kPanel;
    const F slope = splat(s.slope);
    float* point = scratch;
    float* both = point + s.point_panels * kPanel;
    float* above = both + s.both_panels * kPanel;
    float* over_times = above + s.out_panels * kPanel;  // at the first layer, summed
    float* of_time = over_times + matrix;
    float* turns = of_time + matrix;  // two matrices, used in turn

    const auto zero = [](int, int) { return F{}; };
    pack(f.point, first, s.points, s.per_point, s.point_panels, point);
    for (size_t t = 0; t < s.times; ++t) {
        const float* kept = f.activations + (block * s.times + t) * s.kept();
        const bool more = t + 1 < s.times || block + 1 < s.blocks;
        pack(job.output_grad + t * s.points * s.out, first, s.points, s.out, s.out_panels, above);
        const float* y = above;
        float* flow = t ? of_time : over_times;
        for (int l = s.layers - 1; l >= 0; --l) {
            const float* x = kept + l * matrix;
            // What the next product reads, of the layer before or of the next time's or block's last one.
            const float* soon = l ? x - matrix : more ? kept + s.kept() + (s.layers - 1) * matrix : x;
            float* next = l ? turns + l % 2 * matrix : flow;
            add_outer(y, s.columns(l), x, s.width_panels, sums.weight[l]);
            add_column_sums(y, s.panels(l), sums.layer_bias[l]);
            const auto end = [&](int p, int r, F a, F b) {
                const size_t at = p * kPanel + r * W;
                const float* seen = x + at;
                fetch(soon + at), fetch(soon + at + W);
                to_panels(next)(p, r, leaky_slope(load(seen), a, slope), leaky_slope(load(seen + W), b, slope));
            };
            rows_times(y, s.columns(l), f.layer[l].backward, s.width_panels, zero, end);
            y = next;
        }
        to_first_layer(s, job, first, t, flow, both, sums);
        for (size_t i = 0; t && i < matrix; i += W) store(over_times + i, load(over_times + i) + load(flow + i));
    }
    to_points(s, job, first, over_times, point, sums);
}

}  // namespace EVSPLAT_LEVEL
}  // namespace evsplat
