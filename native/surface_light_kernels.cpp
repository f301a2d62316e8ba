// The light on a range of points, compiled once per SIMD level.

#include "kernels.h"

namespace evsplat {
namespace EVSPLAT_LEVEL {
namespace {

#include "simd.h"

INLINE F dot(const F* a, const F* b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }

// W surface points at one time.
struct Surface {
    F normal[3], place[3];
    F moved[kLightPlaces];    // what coefficients multiply: 1 and the place as the light knows it
    F basis[kLightNormals];

    INLINE Surface at(const SurfaceLight& job, size_t t, size_t n, uint32_t count) {
        Surface s;
        const size_t row = t * job.points + n;
        F canonical[3];
        canonical[0] = gather<3>(job.normals + n * 3, count);
        canonical[1] = gather<3>(job.normals + n * 3 + 1, count);
        canonical[2] = gather<3>(job.normals + n * 3 + 2, count);
        for (int r = 0; r < 3; ++r) {
            const float* line = job.transforms + row * 16 + 4 * r;
            s.normal[r] = canonical[0] * gather<16>(line, count) + canonical[1] * gather<16>(line + 1, count) +
                          canonical[2] * gather<16>(line + 2, count);
            s.place[r] = gather<3>(job.places + row * 3 + r, count);
        }
        const F scale = 1.f / max(sqrt(dot(s.normal, s.normal)), splat(1e-12f));
        s.moved[0] = splat(1.f);
        for (int r = 0; r < 3; ++r) {
            s.normal[r] *= scale;
            s.moved[1 + r] = min(max((s.place[r] - job.center[r]) / job.radius, splat(-2.f)), splat(2.f));
        }
        const F x = s.normal[0], y = s.normal[1], z = s.normal[2];
        const float c1 = 0.48860251f, c2 = 1.09254843f;
        s.basis[0] = splat(1.f);
        s.basis[1] = -c1 * y, s.basis[2] = c1 * z, s.basis[3] = -c1 * x;
        s.basis[4] = c2 * x * y, s.basis[5] = -c2 * y * z;
        s.basis[6] = 0.31539157f * (2.f * z * z - x * x - y * y);
        s.basis[7] = -c2 * x * z, s.basis[8] = 0.54627422f * (x * x - y * y);
        return s;
    }
};

// What a lamp gives to W surface points: the cosine over the square, times the lamp's own square.
struct Beam {
    F ray[3], square, along, facing, near;
    float own, from_center[3];

    INLINE Beam of(const SurfaceLight& job, int lamp, const Surface& s) {
        Beam b;
        const float* at = job.lamp + 3 * lamp;
        b.own = 0.f;
        for (int r = 0; r < 3; ++r) {
            b.ray[r] = at[r] - s.place[r];
            b.from_center[r] = at[r] - job.center[r];
            b.own += b.from_center[r] * b.from_center[r];
        }
        b.square = dot(b.ray, b.ray);
        b.along = max(dot(b.ray, s.normal), F{});
        b.facing = b.along / sqrt(b.square);
        b.near = b.own / max(b.square, splat(kLampNearest * kLampNearest));
        return b;
    }
};

INLINE const float* lit_row(const SurfaceLight& job, const float* lit, int lamp, size_t t) {
    return lit + (lamp * job.lit_times + (job.lit_times > 1 ? t : 0)) * job.points;
}
INLINE F lit_share(const SurfaceLight& job, int lamp, size_t t, size_t n, uint32_t count) {
    return job.lit ? gather<1>(lit_row(job, job.lit, lamp, t) + n, count) : splat(1.f);
}

// Before the bounds.
INLINE void factors_of(const SurfaceLight& job, const Surface& s, size_t t, size_t n, uint32_t count, F (&factor)[3]) {
    for (int c = 0; c < 3; ++c) factor[c] = splat(1.f);
    for (int p = 0; p < kLightPlaces; ++p)
        for (int c = 0; c < 3; ++c) {
            F sum = F{};
            for (int k = 0; k < kLightNormals; ++k)
                sum += s.basis[k] * job.coefficients[(p * kLightNormals + k) * 3 + c];
            factor[c] += s.moved[p] * sum;
        }
    for (int l = 0; l < job.lamps; ++l) {
        const Beam b = Beam::of(job, l, s);
        const F light = b.facing * b.near * lit_share(job, l, t, n, count);
        for (int c = 0; c < 3; ++c) factor[c] += light * job.intensity[3 * l + c];
    }
}

INLINE uint32_t lanes(size_t at, size_t end) { return uint32_t(end - at < size_t(W) ? end - at : W); }

}  // namespace

void surface_light(const SurfaceLight& job, size_t begin, size_t end, float* factors) {
    for (size_t t = 0; t < job.times; ++t)
        for (size_t n = begin; n < end; n += W) {
            const uint32_t count = lanes(n, end);
            F factor[3];
            factors_of(job, Surface::at(job, t, n, count), t, n, count, factor);
            for (int c = 0; c < 3; ++c) {
                const F bounded = min(max(factor[c], splat(kDarkest)), splat(kBrightest));
                for (uint32_t l = 0; l < count; ++l) factors[(t * job.points + n + l) * 3 + c] = bounded[l];
            }
        }
}

void surface_light_backward(const SurfaceLight& job, size_t begin, size_t end, const float* above, float* sums,
                            float* lit) {
    F coefficients[kLightCoefficients] = {};
    F lamp_sums[6 * kMaxLamps] = {};
    for (size_t n = begin; n < end; n += W) {
        const uint32_t count = lanes(n, end);
        for (size_t t = 0; t < job.times; ++t) {
            const Surface s = Surface::at(job, t, n, count);
            F factor[3], g[3];
            factors_of(job, s, t, n, count, factor);
            for (int c = 0; c < 3; ++c) {
                F up = F{};
                for (uint32_t l = 0; l < count; ++l) up[l] = above[(t * job.points + n + l) * 3 + c];
                g[c] = select((factor[c] > kDarkest) & (factor[c] < kBrightest), up, F{});
            }
            for (int p = 0; p < kLightPlaces; ++p)
                for (int k = 0; k < kLightNormals; ++k) {
                    const F value = s.moved[p] * s.basis[k];
                    for (int c = 0; c < 3; ++c) coefficients[(p * kLightNormals + k) * 3 + c] += value * g[c];
                }
            for (int l = 0; l < job.lamps; ++l) {
                const Beam b = Beam::of(job, l, s);
                const F share = lit_share(job, l, t, n, count);
                const float* strength = job.intensity + 3 * l;
                const F by_light = g[0] * strength[0] + g[1] * strength[1] + g[2] * strength[2];
                const F light = b.facing * b.near;
                if (lit) {
                    float* to = const_cast<float*>(lit_row(job, lit, l, t)) + n;
                    const F value = by_light * light;
                    const bool more = job.lit_times == 1 && t > 0;
                    for (uint32_t i = 0; i < count; ++i) to[i] = value[i] + (more ? to[i] : 0.f);
                }
                const F by_beam = by_light * share, root = sqrt(b.square);
                const F turn = select(b.along > 0.f, by_beam * b.near / root, F{});
                const F away = turn * b.along / b.square +
                               select(b.square > kLampNearest * kLampNearest, by_beam * light * 2.f / b.square, F{});
                const F grow = by_beam * b.facing * b.near * (2.f / b.own);
                for (int r = 0; r < 3; ++r) {
                    lamp_sums[3 * l + r] += turn * s.normal[r] - away * b.ray[r] + grow * b.from_center[r];
                    lamp_sums[3 * (job.lamps + l) + r] += g[r] * light * share;
                }
            }
        }
    }
    for (int i = 0; i < kLightCoefficients; ++i) sums[i] = sum(coefficients[i]);
    for (int i = 0; i < 6 * job.lamps; ++i) sums[kLightCoefficients + i] = sum(lamp_sums[i]);
}

}  // namespace EVSPLAT_LEVEL
}  // namespace evsplat
