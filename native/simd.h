// Vectors of floats of one SIMD level, written with the compiler's vector types.
//
// Included by kernels only, inside the namespace of its level: nothing
// here may have external linkage, or the linker could hand AVX-512 code to a machine without it.

constexpr int W = EVSPLAT_LANES;                   // lanes = pixels of a patch
constexpr int kPatchW = W == 4 ? 2 : 4;
constexpr int kPatchH = W / kPatchW;
constexpr int kPatchesX = kTile / kPatchW;
constexpr int kPatches = kTilePixels / W;

typedef float F __attribute__((vector_size(W * 4), may_alias));
typedef int32_t I __attribute__((vector_size(W * 4), may_alias));
typedef uint32_t U __attribute__((vector_size(W * 4), may_alias));
typedef float F4 __attribute__((vector_size(16), may_alias));
typedef int32_t I4 __attribute__((vector_size(16), may_alias));

#define INLINE static inline __attribute__((always_inline))

#if defined(__clang__)
#define SHUFFLE4(a, b, i, j, k, l) __builtin_shufflevector(a, b, i, j, k, l)
#else
#define SHUFFLE4(a, b, i, j, k, l) __builtin_shuffle(a, b, I4{i, j, k, l})
#endif

INLINE F splat(float value) { return value - F{}; }
INLINE F load(const float* p) { F v; __builtin_memcpy(&v, p, sizeof v); return v; }
INLINE void store(float* p, F v) { __builtin_memcpy(p, &v, sizeof v); }
// The same of the first `count` lanes, of all where there are more; the others read `rest`.
INLINE F load_some(const float* p, size_t count, float rest = 0.f) {
    if (count >= size_t(W)) return load(p);
    F v = splat(rest);
    __builtin_memcpy(&v, p, count * sizeof(float));
    return v;
}
INLINE void store_some(float* p, F v, size_t count) {
    if (count >= size_t(W)) return store(p, v);
    __builtin_memcpy(p, &v, count * sizeof(float));
}
INLINE void store_ints(int32_t* p, I v) { __builtin_memcpy(p, &v, sizeof v); }
// Into the second cache, for a read that comes later.
INLINE void fetch(const float* p) { __builtin_prefetch(p, 0, 2); }
// To an aligned place that is not read soon: past the cache, so that its line is not fetched first.
INLINE void stream(float* p, F v) {
#if defined(__AVX512F__) && EVSPLAT_LANES == 16
    _mm512_stream_ps(p, (__m512)v);
#elif defined(__AVX__) && EVSPLAT_LANES == 8
    _mm256_stream_ps(p, (__m256)v);
#elif defined(__SSE2__) && EVSPLAT_LANES == 4
    _mm_stream_ps(p, (__m128)v);
#else
    store(p, v);
#endif
}

// Where one of the two is no number, the second comes out. GCC makes a comparison and a blend of a < b ? a : b.
#if defined(__AVX512F__) && EVSPLAT_LANES == 16
INLINE F min(F a, F b) { return (F)_mm512_min_ps((__m512)a, (__m512)b); }
INLINE F max(F a, F b) { return (F)_mm512_max_ps((__m512)a, (__m512)b); }
#elif defined(__AVX__) && EVSPLAT_LANES == 8
INLINE F min(F a, F b) { return (F)_mm256_min_ps((__m256)a, (__m256)b); }
INLINE F max(F a, F b) { return (F)_mm256_max_ps((__m256)a, (__m256)b); }
#else
INLINE F min(F a, F b) { return a < b ? a : b; }
INLINE F max(F a, F b) { return a > b ? a : b; }
#endif
// As it is, so that no product in it becomes one operation with a sum outside: that would round once, not twice.
INLINE F rounded(F v) {
#if defined(__x86_64__)
    asm("" : "+x"(v));
#elif defined(__aarch64__)
    asm("" : "+w"(v));
#endif
    return v;
}
INLINE F select(I mask, F a, F b) { return mask ? a : b; }

INLINE F sqrt(F v) {
    F r;
    for (int l = 0; l < W; ++l) r[l] = __builtin_sqrtf(v[l]);
    return r;
}

INLINE F ceil(F v) {
    F r;
    for (int l = 0; l < W; ++l) r[l] = __builtin_ceilf(v[l]);
    return r;
}

INLINE F to_float(I v) { return __builtin_convertvector(v, F); }
INLINE I to_int(F v) { return __builtin_convertvector(v, I); }  // towards zero

// Field `stride * row + 0` of `count` rows; missing rows repeat the last one.
template <int stride>
INLINE F gather(const float* p, uint32_t count) {
    float rows[W];
    if (count >= W) {
        for (int l = 0; l < W; ++l) rows[l] = p[l * stride];
    } else {
        for (uint32_t l = 0; l < W; ++l) rows[l] = p[(l < count ? l : count - 1) * stride];
    }
    return load(rows);
}

// Bit l = lane l of the mask.
INLINE uint64_t bits(I mask) {
#if defined(__AVX512DQ__) && EVSPLAT_LANES == 16
    return uint32_t(_mm512_movepi32_mask((__m512i)mask));
#elif defined(__AVX__) && EVSPLAT_LANES == 8
    return uint32_t(_mm256_movemask_ps((__m256)mask));
#elif defined(__SSE2__) && EVSPLAT_LANES == 4
    return uint32_t(_mm_movemask_ps((__m128)mask));
#else
    uint64_t r = 0;
    for (int l = 0; l < W; ++l) r |= uint64_t(mask[l] & 1) << l;
    return r;
#endif
}

// Bit l = lane l of a is at most that of b.
INLINE uint64_t bits_at_most(F a, F b) {
#if defined(__AVX512F__) && EVSPLAT_LANES == 16
    return uint32_t(_mm512_cmp_ps_mask((__m512)a, (__m512)b, _CMP_LE_OQ));
#else
    return bits(a <= b);
#endif
}

// 1 / v to the last digit or two, exact at 1.
INLINE F reciprocal(F v) {
#if defined(__AVX512F__) && EVSPLAT_LANES == 16
    const F r = (F)_mm512_rcp14_ps((__m512)v);
    return r + r * (1.f - v * r);
#else
    return 1.f / v;
#endif
}

// 2^f for f in [-1/2, 1/2], 1.5e-7 relative, but exact at 0, since 1 - 2^f matters there.
INLINE F exp2_fraction(F f) {
    F p = splat(0.0013264727f);
    p = p * f + 0.009671513f;
    p = p * f + 0.055507336f;
    p = p * f + 0.24022242f;
    p = p * f + 0.693147f;
    p = p * f + 1.f;
    return p;
}

// 2^e for e <= 1, as exact as `exp2_fraction`; below -60 it gives 2^-60. The magic number rounds to
// nearest, which -ffast-math would break.
INLINE F exp2(F e) {
    e = max(e, splat(-60.f));
    const F magic = splat(12582912.f);
    const F shifted = e + magic;
    return (F)((I)exp2_fraction(e - (shifted - magic)) + ((I)shifted << 23));
}

// Base-2 logarithm of normal positive numbers, 1e-7 absolute: the exponent, and of the mantissa m in
// [sqrt(1/2), sqrt(2)) the series of 2 atanh((m - 1) / (m + 1)).
INLINE F log2(F v) {
    const I shifted = (I)v - 0x3f3504f3;  // the bits of sqrt(1/2)
    const I exponent = shifted >> 23;
    const F m = (F)((shifted & 0x7fffff) + 0x3f3504f3);
    const F t = (m - 1.f) / (m + 1.f), square = t * t;
    F p = splat(2.f / 9.f);
    p = p * square + 2.f / 7.f;
    p = p * square + 2.f / 5.f;
    p = p * square + 2.f / 3.f;
    p = p * square + 2.f;
    return to_float(exponent) + p * t * 1.44269504f;
}

// The sum of four of the lanes' quarters, so that four vectors reduce together.
INLINE F4 quarter(F v) {
#if EVSPLAT_LANES == 16
    typedef float F8 __attribute__((vector_size(32)));
    F8 half[2];
    __builtin_memcpy(half, &v, sizeof v);
    half[0] += half[1];
    F4 part[2];
    __builtin_memcpy(part, half, sizeof part);
    return part[0] + part[1];
#elif EVSPLAT_LANES == 8
    F4 part[2];
    __builtin_memcpy(part, &v, sizeof v);
    return part[0] + part[1];
#else
    F4 r;
    __builtin_memcpy(&r, &v, sizeof v);
    return r;
#endif
}

// Sums over the lanes of four vectors.
INLINE F4 sum4(F a, F b, F c, F d) {
    const F4 qa = quarter(a), qb = quarter(b), qc = quarter(c), qd = quarter(d);
    const F4 ab = SHUFFLE4(qa, qb, 0, 4, 1, 5) + SHUFFLE4(qa, qb, 2, 6, 3, 7);
    const F4 cd = SHUFFLE4(qc, qd, 0, 4, 1, 5) + SHUFFLE4(qc, qd, 2, 6, 3, 7);
    return SHUFFLE4(ab, cd, 0, 1, 4, 5) + SHUFFLE4(ab, cd, 2, 3, 6, 7);
}

// to[i] = the sum over the lanes of the i-th of `count` vectors, added to what is there with `add`; whole
// groups of four are written.
INLINE void sums(const F* vectors, int count, float* to, bool add) {
    const int groups = (count + 3) / 4;
    const F zero = F{};
    const auto vector = [&](int i) { return i < count ? vectors[i] : zero; };
#if EVSPLAT_LANES == 16
#pragma GCC unroll 3
    for (int first = 0; first < groups; first += 4) {
        // Of vectors i, i + 4, i + 8, i + 12, quarter by quarter of the result.
        __m512 quarters[4];
#pragma GCC unroll 4
        for (int i = 0; i < 4; ++i) {
            const __m512 a = (__m512)vector(4 * first + i), b = (__m512)vector(4 * first + i + 4);
            const __m512 c = (__m512)vector(4 * first + i + 8), d = (__m512)vector(4 * first + i + 12);
            const __m512 ab = _mm512_add_ps(_mm512_shuffle_f32x4(a, b, 0x44), _mm512_shuffle_f32x4(a, b, 0xee));
            const __m512 cd = _mm512_add_ps(_mm512_shuffle_f32x4(c, d, 0x44), _mm512_shuffle_f32x4(c, d, 0xee));
            quarters[i] = _mm512_add_ps(_mm512_shuffle_f32x4(ab, cd, 0x88), _mm512_shuffle_f32x4(ab, cd, 0xdd));
        }
        const auto pair = [](__m512 a, __m512 b) {
            return _mm512_add_ps(_mm512_unpacklo_ps(a, b), _mm512_unpackhi_ps(a, b));
        };
        const __m512 low = pair(quarters[0], quarters[1]), high = pair(quarters[2], quarters[3]);
        __m512 total = _mm512_add_ps(_mm512_shuffle_ps(low, high, 0x44), _mm512_shuffle_ps(low, high, 0xee));
        const __mmask16 there = __mmask16(groups - first >= 4 ? 0xffff : (1 << 4 * (groups - first)) - 1);
        if (add) total = _mm512_add_ps(total, _mm512_maskz_loadu_ps(there, to + 4 * first));
        _mm512_mask_storeu_ps(to + 4 * first, there, total);
    }
#else
    for (int first = 0; first < 4 * groups; first += 4) {
        F4 total = sum4(vector(first), vector(first + 1), vector(first + 2), vector(first + 3)), before;
        if (add) {
            __builtin_memcpy(&before, to + first, sizeof before);
            total += before;
        }
        __builtin_memcpy(to + first, &total, sizeof total);
    }
#endif
}

INLINE float sum(F v) {
    const F4 q = quarter(v);
    return (q[0] + q[1]) + (q[2] + q[3]);
}
