// Networks whose hidden layers multiply bfloat16 and sum in float32: two products per lane and step.
// Needs AVX-512 with BF16; compiled for that level only. The first layer stays in float32, since its
// inputs are places.

#include "kernels.h"
#include <immintrin.h>

namespace evsplat {
namespace EVSPLAT_LEVEL {
namespace {

#include "simd.h"
#include "mlp_panels.h"

static_assert(W == 16, "a vector of pairs holds 16");

struct Pairs {
    typedef uint32_t Element;
    static constexpr int per = 2;
    static U load(const uint32_t* p) { U v; __builtin_memcpy(&v, p, sizeof v); return v; }
    static F add(F sum, uint32_t a, U b) {
        return (F)_mm512_dpbf16_ps((__m512)sum, (__m512bh)_mm512_set1_epi32(int32_t(a)), (__m512bh)b);
    }
};

constexpr size_t kHalfPanel = kPanel / 2;  // elements of a panel of pairs

// A matrix of hidden values twice: pairs of neighbouring columns, as the left side of x W, and pairs of
// neighbouring rows, as either side of y^T x.
struct Hidden {
    uint32_t *columns, *rows;

    Hidden(float* memory, int panels) : columns((uint32_t*)memory), rows(columns + panels * kHalfPanel) {}
};

// Rows (row, row + 1) of one panel to `columns` and, unless null, to `rows`.
INLINE void store_rows(uint32_t* columns, uint32_t* rows, int p, int row, F a, F b) {
    const __m512i both = (__m512i)_mm512_cvtne2ps_pbh((__m512)b, (__m512)a);
    _mm512_storeu_si512(columns + p * kHalfPanel + row * (W / 2), both);  // two rows follow each other
    if (!rows) return;
    const __m512i order = _mm512_set_epi16(31, 15, 30, 14, 29, 13, 28, 12, 27, 11, 26, 10, 25, 9, 24, 8, 23, 7, 22, 6,
                                           21, 5, 20, 4, 19, 3, 18, 2, 17, 1, 16, 0);
    _mm512_storeu_si512(rows + p * kHalfPanel + row / 2 * W, _mm512_permutexvar_epi16(order, both));
}

// Adds the sums of the columns of pairs of rows.
INLINE void add_sums_of_columns(const uint32_t* rows, int panels, float* sum) {
    const uint32_t ones = 0x3f803f80u;
    for (int p = 0; p < panels; ++p) {
        F total = load(sum + p * W);
        for (int r = 0; r < R / 2; ++r) total = Pairs::add(total, ones, Pairs::load(rows + p * kHalfPanel + r * W));
        store(sum + p * W, total);
    }
}

void forward(const MlpShape& s, const MlpForward& job, size_t block, float* scratch) {
    const size_t first = block * R;
    const F slope = splat(s.slope);
    float* point = scratch;
    float* both = point + s.point_panels * kPanel;
    float* shared = both + s.both_panels * kPanel;
    float* result = shared + s.width_panels * kPanel;
    uint32_t* turns[2];
    turns[0] = (uint32_t*)(result + s.out_panels * kPanel);
    turns[1] = turns[0] + s.width_panels * kHalfPanel;

    pack(job.point, first, s.points, s.per_point, s.point_panels, point);
    const auto zero = [](int, int) { return F{}; };
    rows_times<Single>(point, s.per_point, job.point_weight.forward, s.width_panels, zero, to_panels(shared));
    for (size_t t = 0; t < s.times; ++t) {
        uint32_t* kept = s.keep ? (uint32_t*)(job.activations + (block * s.times + t) * s.kept()) : nullptr;
        const float* bias = job.bias + t * s.width_panels * W;
        const auto start = [&](int p, int r) { return load(shared + p * kPanel + r * W) + load(bias + p * W); };
        const auto into = [&](int layer) {
            uint32_t* columns = turns[layer % 2];
            uint32_t* rows = kept ? kept + layer * s.width_panels * kHalfPanel : nullptr;
            return [columns, rows, slope](int p, int r, F a, F b) {
                store_rows(columns, rows, p, r, leaky(a, slope), leaky(b, slope));
            };
        };
        if (job.both) {
            pack(job.both + t * s.points * s.per_both, first, s.points, s.per_both, s.both_panels, both);
            rows_times<Single>(both, s.per_both, job.both_weight.forward, s.width_panels, start, into(0));
        } else {
            for (int p = 0; p < s.width_panels; ++p)
                for (int r = 0; r < R; r += 2) into(0)(p, r, start(p, r), start(p, r + 1));
        }
        for (int l = 0; l < s.layers; ++l) {
            const MlpWeight& w = job.layer[l];
            const auto from_bias = [&](int p, int) { return load(w.bias + p * W); };
            const uint32_t* weight = (const uint32_t*)w.forward;
            const int pairs = (s.width + 1) / 2;
            if (l + 1 == s.layers)
                rows_times<Pairs>(turns[l % 2], pairs, weight, s.out_panels, from_bias, to_panels(result));
            else
                rows_times<Pairs>(turns[l % 2], pairs, weight, s.width_panels, from_bias, into(l + 1));
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
    float* flow = above + s.out_panels * kPanel;  // at the first layer, in float32
    float* over_times = flow + matrix;
    const Hidden top(over_times + matrix, s.out_panels);
    float* behind = over_times + matrix + s.out_panels * kPanel;
    const Hidden turns[2] = {{behind, s.width_panels}, {behind + matrix, s.width_panels}};

    const auto zero = [](int, int) { return F{}; };
    pack(f.point, first, s.points, s.per_point, s.point_panels, point);
    for (size_t t = 0; t < s.times; ++t) {
        const uint32_t* kept = (const uint32_t*)(f.activations + (block * s.times + t) * s.kept());
        pack(job.output_grad + t * s.points * s.out, first, s.points, s.out, s.out_panels, above);
        for (int p = 0; p < s.out_panels; ++p)
            for (int r = 0; r < R; r += 2) {
                const float* row = above + p * kPanel + r * W;
                store_rows(top.columns, top.rows, p, r, load(row), load(row + W));
            }
        Hidden y = top;
        for (int l = s.layers - 1; l >= 0; --l) {
            const uint32_t* x = kept + l * s.width_panels * kHalfPanel;
            const Hidden next = turns[l % 2];
            add_outer<Pairs>(y.rows, s.panels(l), x, s.width_panels, sums.weight[l]);
            add_sums_of_columns(y.rows, s.panels(l), sums.layer_bias[l]);
            const auto end = [&](int p, int r, F a, F b) {
                const U seen = Pairs::load(x + p * kHalfPanel + r / 2 * W);
                a = leaky_slope((F)(seen << 16), a, slope), b = leaky_slope((F)(seen & 0xffff0000u), b, slope);
                if (l)
                    store_rows(next.columns, next.rows, p, r, a, b);
                else
                    to_panels(flow)(p, r, a, b);
            };
            const uint32_t* weight = (const uint32_t*)f.layer[l].backward;
            rows_times<Pairs>(y.columns, (s.columns(l) + 1) / 2, weight, s.width_panels, zero, end);
            y = next;
        }
        to_first_layer(s, job, first, t, flow, both, sums);
        for (size_t i = 0; i < matrix; i += W)
            store(over_times + i, t ? load(over_times + i) + load(flow + i) : load(flow + i));
    }
    to_points(s, job, first, over_times, point, sums);
}

}  // namespace

const MlpKernels mlp_kernels = {W, 2, forward, backward};

}  // namespace EVSPLAT_LEVEL
}  // namespace evsplat
