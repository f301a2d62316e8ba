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

// Neighbouring columns are pairs on the left side of x W, neighbouring rows on either side of y^T x, so
// that a matrix of hidden values is there twice.
struct Pairs {
    typedef uint32_t Element;
    static constexpr int per = 2;
    static constexpr size_t kPanelPairs = kPanel / per;
    static U load(const uint32_t* p) { U v; __builtin_memcpy(&v, p, sizeof v); return v; }
    static F add(F sum, uint32_t a, U b) {
        return (F)_mm512_dpbf16_ps((__m512)sum, (__m512bh)_mm512_set1_epi32(int32_t(a)), (__m512bh)b);
    }
    static F add_values(F sum, U b) { return add(sum, 0x3f803f80u, b); }  // times one

    static Hidden<uint32_t> place(uint32_t* own, uint32_t* kept) { return {own, kept}; }
    static Hidden<uint32_t> matrix(float* memory, int panels) {
        uint32_t* pairs = (uint32_t*)memory;
        return {pairs, pairs + panels * kPanelPairs};
    }
    static Hidden<uint32_t> from_panels(float* panels, float* memory, int count) {
        const Hidden<uint32_t> to = matrix(memory, count);
        for (int p = 0; p < count; ++p)
            for (int r = 0; r < R; r += 2) {
                F a, b;
                Single::load_rows(panels, p, r, a, b);
                store_rows(to, p, r, a, b);
            }
        return to;
    }

    // Without `rows` only to `columns`.
    static void keep_rows(const Hidden<uint32_t>& to, int p, int row, F a, F b) {
        const __m512i both = to_columns(to.columns, p, row, a, b);
        if (to.rows) stream((float*)(to.rows + p * kPanelPairs + row / 2 * W), (F)in_rows(both));
    }
    static void store_rows(const Hidden<uint32_t>& to, int p, int row, F a, F b) {
        const __m512i both = to_columns(to.columns, p, row, a, b);
        _mm512_storeu_si512(to.rows + p * kPanelPairs + row / 2 * W, in_rows(both));
    }
    static __m512i to_columns(uint32_t* columns, int p, int row, F a, F b) {
        const __m512i both = (__m512i)_mm512_cvtne2ps_pbh((__m512)b, (__m512)a);
        _mm512_storeu_si512(columns + p * kPanelPairs + row * (W / 2), both);  // one row behind the other
        return both;
    }
    static __m512i in_rows(__m512i both) {
        const __m512i order = _mm512_set_epi16(31, 15, 30, 14, 29, 13, 28, 12, 27, 11, 26, 10, 25, 9, 24, 8, 23, 7,
                                               22, 6, 21, 5, 20, 4, 19, 3, 18, 2, 17, 1, 16, 0);
        return _mm512_permutexvar_epi16(order, both);
    }
    static void load_rows(const uint32_t* rows, int p, int row, F& a, F& b) {
        const U pairs = load(rows + p * kPanelPairs + row / 2 * W);
        a = (F)(pairs << 16), b = (F)(pairs & 0xffff0000u);
    }
};

}  // namespace

const MlpKernels mlp_kernels = {W, Pairs::per, forward<Pairs>, backward<Pairs>};

}  // namespace EVSPLAT_LEVEL
}  // namespace evsplat
