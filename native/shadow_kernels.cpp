// Points of the body onto the grids of a shadow, and what places find there; compiled once per SIMD level.

#include "kernels.h"

namespace evsplat {
namespace EVSPLAT_LEVEL {
namespace {

#include "simd.h"

constexpr float kHalfLog2e = 0.72134752f, kLog2e = 1.44269504f;
constexpr float kFar = 6.f;         // standard deviations after which a point adds nothing
constexpr float kFarEdges = 18.f;   // edges of layers after which it is in a layer or is not
constexpr int kRows = kShadowCells + 2;

INLINE int least(int a, int b) { return a < b ? a : b; }
INLINE int most(int a, int b) { return a > b ? a : b; }
INLINE int floor_int(float v) { const int i = int(v); return i - (float(i) > v); }

INLINE F exp_of_negative(F v) { return exp2(v * kLog2e); }
INLINE float sigmoid(float v) { return 1.f / (1.f + __builtin_expf(-v)); }

INLINE F gather_at(const float* p, I index) {
#if defined(__AVX512F__) && EVSPLAT_LANES == 16
    return (F)_mm512_i32gather_ps((__m512i)index, p, 4);
#elif defined(__AVX2__) && EVSPLAT_LANES == 8
    return (F)_mm256_i32gather_ps(p, (__m256i)index, 4);
#else
    F v;
    for (int l = 0; l < W; ++l) v[l] = p[index[l]];
    return v;
#endif
}

// ------------------------------------------------------------------ points onto the grid

// One axis of a round Gaussian: cells [low, high] of 1 .. kShadowCells, and its values from `start` on.
struct Bell {
    int low, high, start, vectors;
    float value[kShadowRow], away[kShadowRow];  // away: cells from the middle

    INLINE bool of(Bell& bell, float metres, float width) {
        const float at = metres * kShadowScale + (kShadowReach * kShadowScale + 1.f), cells = width * kShadowScale;
        if (!(at > -1e6f && at < 1e6f && cells < 1e6f)) return false;
        bell.low = most(1, floor_int(at - kFar * cells) + 1), bell.high = least(kShadowCells, floor_int(at + kFar * cells));
        if (bell.low > bell.high) return false;
        bell.vectors = (bell.high - bell.low) / W + 1;
        bell.start = least(bell.low, kShadowRow - bell.vectors * W);
        F step;
        for (int l = 0; l < W; ++l) step[l] = float(l);
        const float sharp = kHalfLog2e / (cells * cells);
        for (int v = 0; v < bell.vectors; ++v) {
            const F away = step + (float(bell.start + v * W) - at);
            store(bell.away + v * W, away);
            store(bell.value + v * W, exp2(-sharp * away * away));
        }
        return true;
    }
};

// Of one point: where it is on the plane and behind it, and the layers that it enters, with how much of it.
struct Caster {
    float q[3], u, v, b, along, spread;
    Bell row, column;
    int layer, layers;
    float enters[kShadowLayers], slope[kShadowLayers];  // slope: by b

    INLINE bool of(Caster& c, const ShadowSplat& s, size_t i) {
        const LampView& view = s.view;
        for (int r = 0; r < 3; ++r) c.q[r] = s.body[3 * i + r] - view.middle[r];
        const auto along = [&](const float* axis) { return c.q[0] * axis[0] + c.q[1] * axis[1] + c.q[2] * axis[2]; };
        c.u = along(view.across[0]), c.v = along(view.across[1]), c.b = along(view.axis);
        c.along = c.b + view.distance > kShadowNearest ? c.b + view.distance : kShadowNearest;
        c.spread = view.distance / c.along;
        if (!Bell::of(c.row, c.u * c.spread, s.width) || !Bell::of(c.column, c.v * c.spread, s.width)) return false;
        c.layer = 0, c.layers = 1, c.enters[0] = 1.f, c.slope[0] = 0.f;
        if (!s.layered) return true;
        if (!(c.b > -1e3f && c.b < 1e3f)) return false;
        const float at = (c.b + kShadowReach) * kShadowLayerScale, far = kFarEdges * kShadowLayerEdge * kShadowLayerScale;
        c.layer = most(0, floor_int(at - far) + 1);
        // What enters before the first layer is in it.
        c.layers = most(c.layer + 1, least(kShadowLayers, floor_int(at + far) + 2)) - c.layer;
        if (c.layer >= kShadowLayers) return false;
        float before = 0.f, before_slope = 0.f;
        for (int k = 0; k < c.layers; ++k) {
            const float edge = float(c.layer + k) / kShadowLayerScale - kShadowReach;
            const float in = sigmoid((edge - c.b) / kShadowLayerEdge), slope = -in * (1.f - in) / kShadowLayerEdge;
            c.enters[k] = in - before, c.slope[k] = slope - before_slope;
            before = in, before_slope = slope;
        }
        return true;
    }
};

// The border and what bells wrote beside the cells.
INLINE void clear_border(float* plane) {
    for (int row = 1; row <= kShadowCells; ++row) {
        float* cells = plane + row * kShadowRow;
        cells[0] = 0.f;
        for (int i = kShadowCells + 1; i < kShadowRow; ++i) cells[i] = 0.f;
    }
    __builtin_memset(plane, 0, kShadowRow * sizeof(float));
    __builtin_memset(plane + (kRows - 1) * kShadowRow, 0, kShadowRow * sizeof(float));
}

// The first plane that holds anything.
INLINE float* planes_of(float* grid, bool layered) { return grid + (layered ? kShadowPlane : 0); }

INLINE void add_plane(float* to, const float* from) {
    for (size_t i = 0; i < kShadowPlane; i += W) store(to + i, load(to + i) + load(from + i));
}

// ------------------------------------------------------------------ places

// W places as a lamp sees them: coordinates in cells, with the border.
struct Seen {
    F q[3], u, v, b, along, spread, row, column;
    I inside, ahead;  // of the grid; farther from the lamp than the nearest

    INLINE Seen of(const LampView& view, const F (&place)[3]) {
        Seen s;
        for (int r = 0; r < 3; ++r) s.q[r] = place[r] - view.middle[r];
        s.u = s.q[0] * view.across[0][0] + s.q[1] * view.across[0][1] + s.q[2] * view.across[0][2];
        s.v = s.q[0] * view.across[1][0] + s.q[1] * view.across[1][1] + s.q[2] * view.across[1][2];
        s.b = s.q[0] * view.axis[0] + s.q[1] * view.axis[1] + s.q[2] * view.axis[2];
        const F along = s.b + view.distance;
        s.ahead = along > kShadowNearest;
        s.along = max(along, splat(kShadowNearest));
        s.spread = view.distance / s.along;
        const float middle = kShadowReach * kShadowScale + 1.f;
        s.row = s.u * s.spread * kShadowScale + middle, s.column = s.v * s.spread * kShadowScale + middle;
        const float end = float(kRows - 1);
        s.inside = (s.row > 0.f) & (s.row < end) & (s.column > 0.f) & (s.column < end);
        return s;
    }
};

INLINE void places_of(const float* at, uint32_t count, F (&place)[3]) {
    for (int r = 0; r < 3; ++r) place[r] = gather<3>(at + r, count);
}

INLINE void store_places(float* to, const F (&place)[3], uint32_t count) {
    for (int r = 0; r < 3; ++r) {
        float one[W];
        store(one, place[r]);
        for (uint32_t l = 0; l < count; ++l) to[3 * l + r] = one[l];
    }
}

// A coordinate between two cells; NaN is at the border.
struct Between {
    I cell;
    F share;

    INLINE Between of(F at, int cells) {
        at = min(max(at, F{}), splat(float(cells - 1)));
        I cell = to_int(at);
        cell = cell > cells - 2 ? I{} + (cells - 2) : cell;
        return {cell, at - to_float(cell)};
    }
};

INLINE F mix(F a, F b, F share) { return a + share * (b - a); }

// Bilinear look-up in one plane.
struct Found {
    F value, by_row, by_column;
    I index;
    F row, column;  // shares

    INLINE Found at(const float* plane, const Seen& s) {
        const Between row = Between::of(s.row, kRows), column = Between::of(s.column, kRows);
        Found f;
        f.index = row.cell * kShadowRow + column.cell, f.row = row.share, f.column = column.share;
        const F a = gather_at(plane, f.index), b = gather_at(plane + 1, f.index);
        const F c = gather_at(plane + kShadowRow, f.index), d = gather_at(plane + kShadowRow + 1, f.index);
        const F low = mix(a, b, f.column), high = mix(c, d, f.column);
        f.value = mix(low, high, f.row);
        f.by_row = high - low;
        f.by_column = mix(b - a, d - c, f.row);
        return f;
    }
};

// Adds `by` times the four weights to the cells of each lane in `lanes`.
INLINE void scatter(float* plane, I index, F row, F column, F by, uint64_t lanes) {
    float a[W], b[W], c[W], d[W];
    int32_t cell[W];
    const F high = by * row, low = by - high;
    store(b, low * column), store(a, low - low * column);
    store(d, high * column), store(c, high - high * column);
    store_ints(cell, index);
    for (; lanes; lanes &= lanes - 1) {
        const int l = __builtin_ctzll(lanes);
        float* to = plane + cell[l];
        to[0] += a[l], to[1] += b[l];
        to[kShadowRow] += c[l], to[kShadowRow + 1] += d[l];
    }
}

// Adds the gradient of W places on the plane (by metres there) and along the axis to a view's sums, and to `place`
// that of the places themselves.
INLINE void add_to_view(const LampView& view, const Seen& s, F by_row, F by_column, F by_b, F* sums, F* place = nullptr) {
    const F by_u = by_row * kShadowScale, by_v = by_column * kShadowScale;
    const F by_spread = by_u * s.u + by_v * s.v, per = 1.f / s.along;
    const F u = by_u * s.spread, v = by_v * s.spread;
    const F b = by_b - select(s.ahead, by_spread * s.spread * per, F{});
    sums[kDistance] += by_spread * per * (1.f - select(s.ahead, s.spread, F{}));
    for (int r = 0; r < 3; ++r) {
        sums[kByU + r] += u * s.q[r];
        sums[kByV + r] += v * s.q[r];
        sums[kByB + r] += b * s.q[r];
        if (place) place[r] += u * view.across[0][r] + v * view.across[1][r] + b * view.axis[r];
    }
    sums[kU] += u, sums[kV] += v, sums[kB] += b;
}

// Where the body is between place and lamp; NaN stays NaN, which `exp2` would lose.
INLINE F behind(F b) {
    const F away = (b - kShadowFadeAt) / kShadowFade;
    const F small = exp_of_negative(-max(away, -away));
    return select(away > 0.f, splat(1.f), small) / (1.f + small) + 0.f * b;
}

INLINE uint32_t lanes(size_t at, size_t end) { return uint32_t(end - at < size_t(W) ? end - at : W); }
INLINE uint64_t first_lanes(uint32_t count) { return (uint64_t(1) << count) - 1; }

}  // namespace

void shadow_splat(const ShadowSplat& s, float* grid) {
    const int layers = s.layered ? kShadowLayers : 1;
    __builtin_memset(grid, 0, (s.layered ? kShadowPlanes : 1) * kShadowPlane * sizeof(float));
    float* planes = planes_of(grid, s.layered);
    const float strength = s.strength / (s.width * s.width);
    for (size_t i = 0; i < s.points; ++i) {
        Caster c;
        if (!Caster::of(c, s, i)) continue;
        for (int k = 0; k < c.layers; ++k) {
            float* plane = planes + (c.layer + k) * kShadowPlane + c.column.start;
            const float enters = strength * c.enters[k];
            for (int row = c.row.low; row <= c.row.high; ++row) {
                const float by = enters * c.row.value[row - c.row.start];
                float* cells = plane + row * kShadowRow;
                for (int v = 0; v < c.column.vectors * W; v += W)
                    store(cells + v, load(cells + v) + by * load(c.column.value + v));
            }
        }
    }
    for (int k = 0; k < layers; ++k) {
        clear_border(planes + k * kShadowPlane);
        if (k) add_plane(planes + k * kShadowPlane, planes + (k - 1) * kShadowPlane);
    }
}

void shadow_splat_backward(const ShadowSplat& s, float* grid, const SplatGrads& grads) {
    const int layers = s.layered ? kShadowLayers : 1;
    float* planes = planes_of(grid, s.layered);
    for (int k = layers - 1; k >= 0; --k) {
        clear_border(planes + k * kShadowPlane);
        if (k < layers - 1) add_plane(planes + k * kShadowPlane, planes + (k + 1) * kShadowPlane);
    }
    const float strength = s.strength / (s.width * s.width), cells = s.width * kShadowScale;
    for (size_t i = 0; i < s.points; ++i) {
        Caster c;
        if (!Caster::of(c, s, i)) continue;
        // Moments of the gradient under the point's bell, across the columns still vectors.
        F zeroth[kShadowRow / W] = {}, first[kShadowRow / W] = {}, second[kShadowRow / W] = {};
        float total = 0.f, by_b = 0.f;
        for (int k = 0; k < c.layers; ++k) {
            const float* plane = planes + (c.layer + k) * kShadowPlane + c.column.start;
            F layer[kShadowRow / W] = {};
            for (int row = c.row.low; row <= c.row.high; ++row) {
                const float value = c.row.value[row - c.row.start], away = c.row.away[row - c.row.start];
                const float* cell = plane + row * kShadowRow;
                const float one = value * away * c.enters[k], two = one * away;
                for (int v = 0; v < c.column.vectors; ++v) {
                    const F g = load(cell + v * W);
                    layer[v] += value * g, first[v] += one * g, second[v] += two * g;
                }
            }
            F sum_k = F{};
            for (int v = 0; v < c.column.vectors; ++v) {
                sum_k += layer[v] * load(c.column.value + v * W);
                zeroth[v] += c.enters[k] * layer[v];
            }
            const float in_layer = sum(sum_k);
            total += c.enters[k] * in_layer, by_b += c.slope[k] * in_layer;
        }
        F row = F{}, column = F{}, square = F{};
        for (int v = 0; v < c.column.vectors; ++v) {
            const F value = load(c.column.value + v * W), away = load(c.column.away + v * W);
            row += first[v] * value;
            column += zeroth[v] * value * away;
            square += (second[v] + zeroth[v] * away * away) * value;
        }
        const float per_square = strength / (cells * cells);
        *grads.width += double(per_square * sum(square) - 2.f * strength * total) / s.width;
        const float by_u = per_square * sum(row) * kShadowScale, by_v = per_square * sum(column) * kShadowScale;
        const float by_spread = by_u * c.u + by_v * c.v;
        const bool ahead = c.along > kShadowNearest;
        const float u = by_u * c.spread, v = by_v * c.spread;
        const float b = strength * by_b - (ahead ? by_spread * c.spread / c.along : 0.f);
        for (int r = 0; r < 3; ++r) {
            grads.sums[kByU + r] += u * c.q[r];
            grads.sums[kByV + r] += v * c.q[r];
            grads.sums[kByB + r] += b * c.q[r];
            if (grads.body)
                grads.body[3 * i + r] += u * s.view.across[0][r] + v * s.view.across[1][r] + b * s.view.axis[r];
        }
        grads.sums[kU] += u, grads.sums[kV] += v, grads.sums[kB] += b;
        grads.sums[kDistance] += by_spread / c.along * (1.f - (ahead ? c.spread : 0.f));
    }
}

void shadow_on_scene(const ShadowLook& look, size_t begin, size_t end, float* factor) {
    for (size_t n = begin; n < end; n += W) {
        const uint32_t count = lanes(n, end);
        F place[3], all = splat(1.f);
        places_of(look.at + 3 * n, count, place);
        for (int l = 0; l < look.lamps; ++l) {
            const Seen s = Seen::of(look.views[l], place);
            const F depth = Found::at(look.grids[l], s).value * behind(s.b);
            all *= 1.f - look.share[l] * (1.f - exp_of_negative(-depth)) + 0.f * depth;
        }
        store_some(factor + n, all, count);
    }
}

void shadow_on_scene_backward(const ShadowLook& look, size_t begin, size_t end, const float* above, float* const* grids,
                              float* sums, float* share, float* places) {
    F view_sums[kMaxLamps][kViewSums] = {}, share_sums[kMaxLamps] = {};
    for (size_t n = begin; n < end; n += W) {
        const uint32_t count = lanes(n, end);
        F place[3], light[kMaxLamps], left[kMaxLamps], fade[kMaxLamps], before[kMaxLamps];
        Seen seen[kMaxLamps];
        Found found[kMaxLamps];
        places_of(look.at + 3 * n, count, place);
        F all = load_some(above + n, count);
        for (int l = 0; l < look.lamps; ++l) {
            seen[l] = Seen::of(look.views[l], place);
            found[l] = Found::at(look.grids[l], seen[l]);
            fade[l] = behind(seen[l].b);
            left[l] = exp_of_negative(-found[l].value * fade[l]);
            light[l] = 1.f - look.share[l] * (1.f - left[l]);
            before[l] = all;
            all *= light[l];
        }
        F after = splat(1.f), by_place[3] = {};
        for (int l = look.lamps - 1; l >= 0; --l) {
            const F by = before[l] * after;
            after *= light[l];
            share_sums[l] -= by * (1.f - left[l]);
            const F by_depth = -by * look.share[l] * left[l];
            const F by_value = select(seen[l].inside, by_depth * fade[l], F{});
            const uint64_t touched = first_lanes(count) & ~bits(by_value == 0.f);
            if (!touched) continue;
            scatter(grids[l], found[l].index, found[l].row, found[l].column, by_value, touched);
            const F by_b = by_depth * found[l].value * fade[l] * (1.f - fade[l]) * (1.f / kShadowFade);
            add_to_view(look.views[l], seen[l], by_value * found[l].by_row, by_value * found[l].by_column, by_b,
                        view_sums[l], by_place);
        }
        if (places) store_places(places + 3 * n, by_place, count);
    }
    for (int l = 0; l < look.lamps; ++l) {
        for (int k = 0; k < kViewSums; ++k) sums[l * kViewSums + k] = sum(view_sums[l][k]);
        share[l] = sum(share_sums[l]);
    }
}

namespace {

// Trilinear look-up between the planes of layers.
struct Layered {
    Found low, high;
    Between layer;
    I start, inside;  // of the lower plane
    F depth;

    INLINE Layered at(const float* grid, const Seen& s) {
        Layered f;
        const F at = (s.b - kShadowOwnSurface) * kShadowLayerScale + (kShadowReach * kShadowLayerScale + 1.f);
        f.layer = Between::of(at, kShadowPlanes);
        f.inside = s.inside & (at > 0.f) & (at < float(kShadowPlanes - 1));
        f.start = f.layer.cell * int32_t(kShadowPlane);
        const Between row = Between::of(s.row, kRows), column = Between::of(s.column, kRows);
        const I index = row.cell * kShadowRow + column.cell + f.start;
        for (int k = 0; k < 2; ++k) {
            Found& found = k ? f.high : f.low;
            const float* plane = grid + (k ? kShadowPlane : 0);
            found.index = index, found.row = row.share, found.column = column.share;
            const F a = gather_at(plane, index), b = gather_at(plane + 1, index);
            const F c = gather_at(plane + kShadowRow, index), d = gather_at(plane + kShadowRow + 1, index);
            const F near = mix(a, b, found.column), far = mix(c, d, found.column);
            found.value = mix(near, far, found.row);
            found.by_row = far - near;
            found.by_column = mix(b - a, d - c, found.row);
        }
        f.depth = mix(f.low.value, f.high.value, f.layer.share);
        return f;
    }
};

}  // namespace

void shadow_on_body(const ShadowLook& look, size_t begin, size_t end, float* lit) {
    for (size_t n = begin; n < end; n += W) {
        const uint32_t count = lanes(n, end);
        F place[3];
        places_of(look.at + 3 * n, count, place);
        const Seen s = Seen::of(*look.views, place);
        store_some(lit + n, exp_of_negative(-Layered::at(*look.grids, s).depth) + 0.f * s.b, count);
    }
}

void shadow_on_body_backward(const ShadowLook& look, size_t begin, size_t end, const float* above, float* grid,
                             float* sums) {
    F view_sums[kViewSums] = {};
    for (size_t n = begin; n < end; n += W) {
        const uint32_t count = lanes(n, end);
        F place[3];
        places_of(look.at + 3 * n, count, place);
        const Seen s = Seen::of(*look.views, place);
        const Layered f = Layered::at(*look.grids, s);
        const F by = select(f.inside, -load_some(above + n, count) * exp_of_negative(-f.depth), F{});
        const uint64_t touched = first_lanes(count) & ~bits(by == 0.f);
        if (!touched) continue;
        const F high = by * f.layer.share, low = by - high;
        scatter(grid, f.low.index, f.low.row, f.low.column, low, touched);
        scatter(grid + kShadowPlane, f.low.index, f.low.row, f.low.column, high, touched);
        add_to_view(*look.views, s, low * f.low.by_row + high * f.high.by_row,
                    low * f.low.by_column + high * f.high.by_column,
                    by * (f.high.value - f.low.value) * kShadowLayerScale, view_sums);
    }
    for (int k = 0; k < kViewSums; ++k) sums[k] = sum(view_sums[k]);
}

}  // namespace EVSPLAT_LEVEL
}  // namespace evsplat
