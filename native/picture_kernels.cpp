// Passes over the pixels of pictures, compiled once per SIMD level.

#include "kernels.h"

namespace evsplat {
namespace EVSPLAT_LEVEL {
namespace {

#include "simd.h"

// Calls work(at, count) for the vectors of [begin, end); only the last may have fewer than W values.
template <class Work>
INLINE void vectors(size_t begin, size_t end, const Work& work) {
    size_t at = begin;
    for (; at + W <= end; at += W) work(at, size_t(W));
    if (at < end) work(at, end - at);
}
#define PER_VECTOR [&](size_t at, size_t count) __attribute__((always_inline))

// All ones in those of the `count` lanes whose pixel from `at`, a multiple of the lanes, has its bit.
INLINE I mask_at(const uint8_t* packed, size_t at, size_t count) {
    constexpr int bits = W < 8 ? 8 : W;
    uint32_t word = packed[at / 8];
    if (W > 8) word = word << 8 | (count > 8 ? packed[at / 8 + 1] : 0);
    word <<= at % 8;
    if (count < size_t(W)) word &= ~0u << (bits - count);
    I place;
    for (int l = 0; l < W; ++l) place[l] = bits - 1 - l;
    return -((int32_t(word) - I{}) >> place & 1);
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

struct Light {
    F linear[3], slope[3];  // of each channel
    F sum;                  // weighted, and eps
};

INLINE Light light_at(const LogBrightness& job, int picture, size_t at, size_t count) {
    Light light;
    light.sum = splat(job.eps);
    for (int c = 0; c < 3; ++c) {
        const F given = load_some(job.coded[picture] + c * job.count + at, count), coded = max(given, splat(job.darkest));
        const F power = exp2(log2(coded) * (job.gamma - 1.f));
        light.linear[c] = power * coded;
        light.sum += light.linear[c] * job.weight[c];
        light.slope[c] = select(given >= job.darkest, power * job.gamma, F{});
    }
    return light;
}

}  // namespace

double membership(const Membership& job, size_t begin, size_t end) {
    F total = {}, slope;
    vectors(begin, end, PER_VECTOR {
        const I inside = mask_at(job.inside, at, count), outside = mask_at(job.outside, at, count);
        total += membership_of(job, load_some(job.share + at, count), inside, outside, slope);
        if (job.slope) store_some(job.slope + at, slope, count);
    });
    return sum(total);
}

double misfit(const Misfit& job, size_t begin, size_t end) {
    F total = {};
    vectors(begin, end, PER_VECTOR {
        const F weight = load_some(job.weight + at, count);
        F apart[3], square = {};
        for (int c = 0; c < 3; ++c) {
            apart[c] = gather<3>(job.colours + 3 * at + c, count) - gather<3>(job.image + 3 * at + c, count);
            square += apart[c] * apart[c];
        }
        const F odds = 1.f + square * job.scale;
        total += weight * log2(odds) * 0.693147181f + (odds - odds);  // the logarithm of no number is none
        if (!job.slope) return;
        const F by = 2.f * job.scale * weight / odds;
        for (int c = 0; c < 3; ++c) {
            const F slope = by * apart[c];
            for (size_t l = 0; l < count; ++l) job.slope[3 * (at + l) + c] = slope[l];
        }
    });
    return sum(total);
}

PairOfSums square_sums(const float* first, const float* second, size_t count) {
    F a = {}, b = {};
    for (size_t i = 0; i < count; i += W) {
        const F x = load_some(first + i, count - i), y = load_some(second + i, count - i);
        a += x * x, b += y * y;
    }
    return {sum(a), sum(b)};
}

PairOfSums difference_sums(const float* map, const float* reference, float scale, float reference_scale, size_t count) {
    F absolute = {}, along = {};
    for (size_t i = 0; i < count; i += W) {
        const F x = load_some(map + i, count - i), y = load_some(reference + i, count - i);
        const F d = x * scale - y * reference_scale;
        absolute += max(d, -d) + (d - d);  // max forgets what is no number
        along += select(d > 0.f, x, select(d < 0.f, -x, F{}));
    }
    return {sum(absolute), sum(along)};
}

void difference_slope(const float* map, const float* reference, float scale, float reference_scale, float by_sign,
                      float by_map, size_t count, float* grad) {
#pragma GCC ivdep
    for (size_t i = 0; i < count; ++i) {
        const float d = map[i] * scale - reference[i] * reference_scale;
        grad[i] = (d > 0.f ? by_sign : d < 0.f ? -by_sign : 0.f) - by_map * map[i];
    }
}

WindowSums window_difference(const WindowDifference& job, size_t begin, size_t end, float* slope) {
    F value = {}, on = {}, off = {}, lag = {};
    const size_t pixels = job.pixels;
    vectors(begin, end, PER_VECTOR {
        const F sound = load_some(job.sound + at, count);
        const auto picture = [&](size_t t) { return load_some(job.brightness + t * pixels + at, count); };
        const auto map = [&](size_t row) { return load_some(job.maps + row * pixels + at, count); };
        const auto difference = [&](size_t w, F change) {
            return change - job.on * map(2 * w) + job.off * map(2 * w + 1);
        };
        const auto sign = [&](F d) { return select(d > 0.f, splat(1.f), select(d < 0.f, splat(-1.f), F{})); };
        F sum = {}, before = picture(0);
        for (size_t w = 0; w < job.windows; ++w) {
            const F after = picture(w + 1);
            sum += difference(w, after - before);
            before = after;
        }
        const F whole = sound * job.whole, by_sum = whole * sign(sum);
        value += whole * max(sum, -sum) + (sum - sum);  // max forgets what is no number
        F earlier = {};
        before = picture(0);
        for (size_t w = 0; w < job.windows; ++w) {
            const F after = picture(w + 1), d = difference(w, after - before), weight = sound * job.weight[w];
            value += weight * max(d, -d);
            const F by = weight * sign(d) + by_sum;
            on -= by * map(2 * w), off += by * map(2 * w + 1);
            if (job.drift) lag -= by * load_some(job.drift + w * pixels + at, count);
            store_some(slope + w * pixels + at, earlier - by, count);
            earlier = by, before = after;
        }
        store_some(slope + job.windows * pixels + at, earlier, count);
    });
    return {sum(value), sum(on), sum(off), sum(lag)};
}

void power(const Power& job, size_t begin, size_t end) {
    vectors(begin, end, PER_VECTOR {
        const F given = load_some(job.from + at, count), v = max(given, splat(1e-6f));
        const F less = select(given >= 1e-6f, exp2(log2(v) * (job.exponent - 1.f)), F{});
        store_some(job.value + at, less * v, count);
        if (job.slope) store_some(job.slope + at, less * job.exponent, count);
    });
}

void power_mean(const PowerMean& job, size_t begin, size_t end) {
    const float share = 1.f / float(job.pictures);
    vectors(begin, end, PER_VECTOR {
        F sum = {};
        for (int i = 0; i < job.pictures; ++i) {
            const F given = load_some(job.coded[i] + at, count), v = max(given, splat(1e-6f));
            sum += select(given >= 1e-6f, exp2(log2(v) * job.exponent), F{}) + (given - given);
        }
        store_some(job.mean + at, sum * share, count);
    });
}

void power_mean_backward(const PowerMean& job, size_t begin, size_t end, const float* above, float* const* grads) {
    const float share = job.exponent / float(job.pictures);
    vectors(begin, end, PER_VECTOR {
        const F by = load_some(above + at, count) * share;
        for (int i = 0; i < job.pictures; ++i) {
            const F given = load_some(job.coded[i] + at, count), v = max(given, splat(1e-6f));
            store_some(grads[i] + at, select(given >= 1e-6f, exp2(log2(v) * (job.exponent - 1.f)) * by, F{}), count);
        }
    });
}

void log_brightness(const LogBrightness& job, size_t begin, size_t end, float* value) {
    const auto logarithm = [&](int picture, size_t at, size_t count) __attribute__((always_inline)) {
        return rounded(log2(light_at(job, picture, at, count).sum) * 0.693147181f);
    };
    if (job.change) {
        vectors(begin, end, PER_VECTOR { store_some(value + at, logarithm(1, at, count) - logarithm(0, at, count), count); });
        return;
    }
    for (int i = 0; i < job.pictures; ++i, value += job.count)
        vectors(begin, end, PER_VECTOR { store_some(value + at, logarithm(i, at, count), count); });
}

// One picture after the other: their planes may lie so that reading one looks like reading what was just written.
void log_brightness_backward(const LogBrightness& job, size_t begin, size_t end, const float* above, float* const* grads) {
    for (int i = 0; i < job.pictures; ++i) {
        const float* up = above + (job.change ? 0 : i * job.count);
        const bool less = job.change && !i;
        vectors(begin, end, PER_VECTOR {
            const F given = load_some(up + at, count), by_value = less ? -given : given;
            const Light light = light_at(job, i, at, count);
            for (int c = 0; c < 3; ++c) {
                const F by = job.keeps_hue ? (1.f / 3.f) / (light.linear[c] + job.eps) : job.weight[c] / light.sum;
                store_some(grads[i] + c * job.count + at, light.slope[c] * by * by_value, count);
            }
        });
    }
}

void share_of_range(const uint8_t* levels, size_t count, float* shares) {
#pragma GCC ivdep
    for (size_t i = 0; i < count; ++i) shares[i] = float(levels[i]) / 255.f;
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
