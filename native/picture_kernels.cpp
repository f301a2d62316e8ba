// Passes over the pixels of pictures, compiled once per SIMD level.

#include "kernels.h"

namespace evsplat {
namespace EVSPLAT_LEVEL {
namespace {

#include "simd.h"

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

// All ones in the lanes whose pixel from `at`, a multiple of the lanes, has its bit.
INLINE I mask_at(const uint8_t* packed, size_t at) {
    constexpr int bits = W < 8 ? 8 : W;
    uint32_t word = packed[at / 8];
    if (W > 8) word = word << 8 | packed[at / 8 + 1];
    word <<= at % 8;
    I lanes;
    for (int l = 0; l < W; ++l) lanes[l] = -int32_t(word >> (bits - 1 - l) & 1);
    return lanes;
}

INLINE F membership_of(const Membership& job, F given, I inside, I outside, F& slope) {
    // Of the two the second is taken where there is no number.
    const F low = splat(job.lowest), high = splat(1.f - job.lowest);
    const F at_least = select(low > given, low, given), share = select(high < at_least, high, at_least);
    const F right = select(inside, share, select(outside, 1.f - share, splat(1.f)));
    const F sign = select(inside, splat(1.f), select(outside, splat(-1.f), F{}));
    slope = select((given >= low) & (given <= high), sign / right, F{});
    return log2(right) * 0.693147181f + (right - right);  // the logarithm of no number is none
}

}  // namespace

double membership(const Membership& job, size_t begin, size_t end) {
    F total = {}, slope;
    size_t at = begin;
    for (; at + W <= end; at += W) {
        total += membership_of(job, load(job.share + at), mask_at(job.inside, at), mask_at(job.outside, at), slope);
        if (job.slope) store(job.slope + at, slope);
    }
    double rest = 0.0;
    for (; at < end; ++at) {
        const auto bit = [at](const uint8_t* packed) { return I{} - int32_t(packed[at / 8] >> (7 - at % 8) & 1); };
        rest += membership_of(job, splat(job.share[at]), bit(job.inside), bit(job.outside), slope)[0];
        if (job.slope) job.slope[at] = slope[0];
    }
    return rest + sum(total);
}

PairOfSums square_sums(const float* first, const float* second, size_t count) {
    F a = {}, b = {};
    size_t i = 0;
    for (; i + W <= count; i += W) {
        const F x = load(first + i), y = load(second + i);
        a += x * x, b += y * y;
    }
    PairOfSums sums = {sum(a), sum(b)};
    for (; i < count; ++i) sums.first += first[i] * first[i], sums.second += second[i] * second[i];
    return sums;
}

PairOfSums difference_sums(const float* map, const float* reference, float scale, float reference_scale, size_t count) {
    F absolute = {}, along = {};
    const auto add = [&](F x, F y, F& by_size, F& by_sign) {
        const F d = x * scale - y * reference_scale;
        by_size += max(d, -d) + (d - d);  // max forgets what is no number
        by_sign += select(d > 0.f, x, select(d < 0.f, -x, F{}));
    };
    size_t i = 0;
    for (; i + W <= count; i += W) add(load(map + i), load(reference + i), absolute, along);
    PairOfSums sums = {sum(absolute), sum(along)};
    for (; i < count; ++i) {
        F size = {}, sign = {};
        add(splat(map[i]), splat(reference[i]), size, sign);
        sums.first += size[0], sums.second += sign[0];
    }
    return sums;
}

void difference_slope(const float* map, const float* reference, float scale, float reference_scale, float by_sign,
                      float by_map, size_t count, float* grad) {
#pragma GCC ivdep
    for (size_t i = 0; i < count; ++i) {
        const float d = map[i] * scale - reference[i] * reference_scale;
        grad[i] = (d > 0.f ? by_sign : d < 0.f ? -by_sign : 0.f) - by_map * map[i];
    }
}

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
