// Passes over the pixels of pictures, compiled once per SIMD level.

#include "kernels.h"
#if defined(__x86_64__)
#include <immintrin.h>
#endif

namespace evsplat {
namespace EVSPLAT_LEVEL {
namespace {

#include "simd.h"

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
    F whole;
    for (int l = 0; l < W; ++l) whole[l] = float(exponent[l]);
    return whole + p * t * 1.44269504f;
}

// The pixels from `at`, of which `count` are there.
template <class Load, class Store>
INLINE void pixels(const LogBrightness& job, size_t at, const Load& load_at, const Store& store_at) {
    F light = splat(job.eps), slope[3];
    for (int c = 0; c < 3; ++c) {
        const F given = load_at(job.coded[c] + at), coded = max(given, splat(job.darkest));
        const F power = exp2(log2(coded) * (job.gamma - 1.f));
        light += power * coded * job.weight[c];
        slope[c] = select(given >= job.darkest, power * (job.weight[c] * job.gamma), F{});
    }
    store_at(job.value + at, log2(light) * 0.693147181f);
    if (!job.slope[0]) return;
    for (int c = 0; c < 3; ++c) store_at(job.slope[c] + at, slope[c] / light);
}

INLINE void powers(const Power& job, const F given, F& value, F& slope) {
    const F v = max(given, splat(1e-6f));
    const F less = select(given >= 1e-6f, exp2(log2(v) * (job.exponent - 1.f)), F{});
    value = less * v, slope = less * job.exponent;
}

}  // namespace

void power(const Power& job, size_t begin, size_t end) {
    F value, slope;
    size_t at = begin;
    for (; at + W <= end; at += W) {
        powers(job, load(job.from + at), value, slope);
        store(job.value + at, value);
        if (job.slope) store(job.slope + at, slope);
    }
    for (; at < end; ++at) {
        powers(job, splat(job.from[at]), value, slope);
        job.value[at] = value[0];
        if (job.slope) job.slope[at] = slope[0];
    }
}

void log_brightness(const LogBrightness& job, size_t begin, size_t end) {
    size_t at = begin;
    for (; at + W <= end; at += W) pixels(job, at, load, store);
    if (at == end) return;
    const size_t bytes = (end - at) * sizeof(float);
    const auto part = [bytes](const float* from) {
        F v = splat(1.f);
        __builtin_memcpy(&v, from, bytes);
        return v;
    };
    pixels(job, at, part, [bytes](float* to, F v) { __builtin_memcpy(to, &v, bytes); });
}

void add_sign(const float* image, const float* reference, float by_difference, float scale, size_t count, float* grad) {
#pragma GCC ivdep
    for (size_t i = 0; i < count; ++i) {
        const float difference = image[i] - reference[i];
        const float sign = difference > 0.f ? by_difference : difference < 0.f ? -by_difference : 0.f;
        grad[i] = sign + scale * grad[i];
    }
}

}  // namespace EVSPLAT_LEVEL
}  // namespace evsplat
