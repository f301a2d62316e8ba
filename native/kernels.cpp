// Compositing and its gradient for one SIMD level, and the level's table; compiled once per level.
//
// EVSPLAT_LEVEL is the namespace, EVSPLAT_LANES the floats per vector. No function of the C++ library
// is used and everything but kernels has internal linkage (see simd.h).

#include "kernels.h"

namespace evsplat {
namespace EVSPLAT_LEVEL {
namespace {

#include "simd.h"

// Compiled once, not in every caller: what is done once per tile and plane. Only the loops over Gaussians are
// compiled per number of channels.
#define APART static __attribute__((noinline))

constexpr float kMaxAlpha = 0.999f;
constexpr float kMinTransmittance = 1e-4f;

struct Tile {
    int x0, y0, columns, rows;  // pixels inside the image
};

INLINE Tile tile_of(const View& view, uint32_t index) {
    Tile t;
    t.x0 = int(index) % view.tiles_x * kTile, t.y0 = int(index) / view.tiles_x * kTile;
    t.columns = view.width - t.x0 < kTile ? view.width - t.x0 : kTile;
    t.rows = view.height - t.y0 < kTile ? view.height - t.y0 : kTile;
    return t;
}

// Vectors of fewer than 16 lanes composite by narrow.h, which counts pixels from the tile's corner.
constexpr bool kFromCorner = W < 16;

// Pixel centres of each patch, and whether they are in the image.
struct Pixels {
    F x[kPatches], y[kPatches];
    I inside[kPatches];
};

INLINE void fill_pixels(const Tile& t, Pixels& pixels) {
    F lane_x, lane_y;
    for (int l = 0; l < W; ++l) lane_x[l] = float(l % kPatchW) + 0.5f, lane_y[l] = float(l / kPatchW) + 0.5f;
    for (int p = 0; p < kPatches; ++p) {
        const F x = lane_x + float(p % kPatchesX * kPatchW), y = lane_y + float(p / kPatchesX * kPatchH);
        pixels.x[p] = kFromCorner ? x : x + float(t.x0), pixels.y[p] = kFromCorner ? y : y + float(t.y0);
        pixels.inside[p] = (x < float(t.columns)) & (y < float(t.rows));
    }
}

// Calls f(patch, lane, x, y) for each pixel of the tile inside the image.
template <class Function>
INLINE void for_pixels(const Tile& t, Function f) {
    for (int p = 0; p < kPatches; ++p)
        for (int l = 0; l < W; ++l) {
            const int x = p % kPatchesX * kPatchW + l % kPatchW, y = p / kPatchesX * kPatchH + l / kPatchW;
            if (x < t.columns && y < t.rows) f(p, l, t.x0 + x, t.y0 + y);
        }
}

#if EVSPLAT_LANES == 16
// Four rows of a tile to its four patches there, or back: blocks of four pixels are transposed.
INLINE void transpose_blocks(F (&v)[4]) {
    const __m512 a = (__m512)v[0], b = (__m512)v[1], c = (__m512)v[2], d = (__m512)v[3];
    const __m512 ab = _mm512_shuffle_f32x4(a, b, 0x44), ab2 = _mm512_shuffle_f32x4(a, b, 0xee);
    const __m512 cd = _mm512_shuffle_f32x4(c, d, 0x44), cd2 = _mm512_shuffle_f32x4(c, d, 0xee);
    v[0] = (F)_mm512_shuffle_f32x4(ab, cd, 0x88), v[1] = (F)_mm512_shuffle_f32x4(ab, cd, 0xdd);
    v[2] = (F)_mm512_shuffle_f32x4(ab2, cd2, 0x88), v[3] = (F)_mm512_shuffle_f32x4(ab2, cd2, 0xdd);
}
#endif

// Copies planar image rows to or from the patches' lanes.
APART void store_plane(const Tile& t, const F* patches, int step, float* plane, int width) {
    if (t.columns == kTile && t.rows == kTile) {
#if EVSPLAT_LANES == 16
        for (int y = 0; y < kTile; y += kPatchH) {
            F v[4];
            for (int i = 0; i < 4; ++i) v[i] = patches[(y + i) * step];
            transpose_blocks(v);
            for (int i = 0; i < 4; ++i) store(plane + size_t(t.y0 + y + i) * width + t.x0, v[i]);
        }
        return;
#endif
        for (int p = 0; p < kPatches; ++p) {
            float* out = plane + size_t(t.y0 + p / kPatchesX * kPatchH) * width + t.x0 + p % kPatchesX * kPatchW;
            const float* lanes = (const float*)&patches[p * step];
            for (int r = 0; r < kPatchH; ++r)
                __builtin_memcpy(out + size_t(r) * width, lanes + r * kPatchW, kPatchW * sizeof(float));
        }
    } else {
        for_pixels(t, [&](int p, int l, int x, int y) { plane[size_t(y) * width + x] = patches[p * step][l]; });
    }
}

APART void load_plane(const Tile& t, F* patches, int step, const float* plane, ptrdiff_t sx, ptrdiff_t sy) {
    if (t.columns == kTile && t.rows == kTile) {
#if EVSPLAT_LANES == 16
        if (sx == 1) {
            for (int y = 0; y < kTile; y += kPatchH) {
                F v[4];
                for (int i = 0; i < 4; ++i) v[i] = load(plane + (t.y0 + y + i) * sy + t.x0);
                transpose_blocks(v);
                for (int i = 0; i < 4; ++i) patches[(y + i) * step] = v[i];
            }
            return;
        }
#endif
        for (int p = 0; p < kPatches; ++p) {
            const float* in = plane + (t.y0 + p / kPatchesX * kPatchH) * sy + (t.x0 + p % kPatchesX * kPatchW) * sx;
            // Not by way of a vector: reading what narrower stores have just written stalls.
            float* lanes = (float*)&patches[p * step];
            if (sx == 1) {
                for (int r = 0; r < kPatchH; ++r)
                    __builtin_memcpy(lanes + r * kPatchW, in + r * sy, kPatchW * sizeof(float));
            } else {
                for (int l = 0; l < W; ++l) lanes[l] = in[l / kPatchW * sy + l % kPatchW * sx];
            }
        }
    } else {
        for (int p = 0; p < kPatches; ++p) patches[p * step] = F{};
        for_pixels(t, [&](int p, int l, int x, int y) { patches[p * step][l] = plane[x * sx + y * sy]; });
    }
}

struct Found {
    const Projected* projected;
    const float* values;
};

INLINE Found find(const ForwardJob& job, uint32_t gaussian) {
    const bool still = gaussian >= job.split;
    const size_t i = gaussian - (still ? job.split : 0);
    return {job.projected[still] + i, job.values[still] + i * job.value_stride};
}

INLINE void prefetch_entries(const ForwardJob& job, const Entry* entries, uint32_t from, uint32_t to) {
    for (uint32_t i = from; i < to; ++i) {
        const Found found = find(job, entries[i].gaussian);
        __builtin_prefetch(found.projected);
        __builtin_prefetch(found.values);
    }
}

INLINE uint32_t least(uint32_t a, uint32_t b) { return a < b ? a : b; }

struct Alpha {
    F u, v, raw, value;  // value: 0 below 1/255, at most 0.999
};

// Adds a Gaussian's values to a patch's; the first are lit.
template <int C, bool Lit>
INLINE void add_values(F* colour, int channels, F weight, F lit, const float* value) {
    for (int k = 0; k < (C ? C : channels); ++k) colour[k] += (Lit && k < kLitChannels ? lit : weight) * value[k];
}

// By patch, of a tile's forward pass. Passed by value, like the other: what is stored behind one of its pointers
// cannot change it.
struct Front {
    const F* light;   // means nothing where there is none
    F *live, *final;  // transmittance, 0 once stopped; what it was when it stopped
    I* last;          // entry of the stop, as narrow.h and wide.h say
    F* colour;        // the channels of a patch together
};

// By patch, of a tile's backward pass.
struct Behind {
    const I* last;
    const F *grad, *light;
    F *transmittance, *behind, *light_grad;
};

// One Gaussian in a patch, back to front; its sums are added to `slot`. `alpha`: that of `a` where it was drawn, else 0.
template <int C, bool Lit>
INLINE void add_gradient(const Behind& at, int p, int channels, const Alpha& a, F alpha, bool still,
                         const float* colour, F* slot) {
    F* hc = slot + kMoments;
    const F t = at.transmittance[p] * reciprocal(1.f - alpha);
    const F weight = t * alpha;
    at.transmittance[p] = t;
    const F* v = at.grad + p * channels;
    F shade = F{};
    if (Lit) {
        const F lit = still ? weight * at.light[p] : weight;
        for (int k = 0; k < kLitChannels; ++k) {
            shade += colour[k] * v[k];
            hc[k] += lit * v[k];
        }
        if (still) {
            at.light_grad[p] += weight * shade;
            shade *= at.light[p];
        }
    }
    for (int k = Lit ? kLitChannels : 0; k < channels; ++k) {
        shade += colour[k] * v[k];
        hc[k] += weight * v[k];
    }
    const F differs = shade - at.behind[p];
    at.behind[p] += alpha * differs;
    const F h = select(a.raw <= kMaxAlpha, weight * differs, F{});
    const F h_u = h * a.u, h_v = h * a.v;
    slot[0] += h, slot[1] += h_u, slot[2] += h_v;
    slot[3] += h_u * a.u, slot[4] += h_u * a.v, slot[5] += h_v * a.v;
}

#if EVSPLAT_LANES < 16
#include "narrow.h"
#else
#include "wide.h"
#endif

// C > 0: that many channels, kept in registers; C = 0: up to kMaxChannels, kept in memory. Lit: there is a light.
#define BY_CHANNELS(channels, lit, function, ...)                          \
    switch (lit ? -channels : channels) {                                  \
        case 1: function<1, false>(__VA_ARGS__); break;                    \
        case 2: function<2, false>(__VA_ARGS__); break;                    \
        case 3: function<3, false>(__VA_ARGS__); break;                    \
        case 4: function<4, false>(__VA_ARGS__); break;                    \
        case 5: function<5, false>(__VA_ARGS__); break;                    \
        case 6: function<6, false>(__VA_ARGS__); break;                    \
        case 7: function<7, false>(__VA_ARGS__); break;                    \
        case 8: function<8, false>(__VA_ARGS__); break;                    \
        case -4: function<4, true>(__VA_ARGS__); break;                    \
        default:                                                           \
            if (lit) function<0, true>(__VA_ARGS__);                       \
            else function<0, false>(__VA_ARGS__);                          \
    }

void forward(const ForwardJob& job, const TileWork& work) {
    const View& view = job.view;
    const int channels = job.channels;
    const Tile tile = tile_of(view, work.index);
    Pixels pixels;
    fill_pixels(tile, pixels);
    F live[kPatches], final[kPatches], light[kPatches];
    I last[kPatches];
    F colour[kPatches * kMaxChannels];
    for (int p = 0; p < kPatches; ++p) {
        live[p] = select(pixels.inside[p], splat(1.f), F{});
        final[p] = splat(1.f);
        last[p] = I{} - 1;
    }
    for (int k = 0; k < kPatches * channels; ++k) colour[k] = F{};
    const bool lit = job.light;
    if (lit) load_plane(tile, light, 1, job.light, 1, view.width);
    const Front at = {light, live, final, last, colour};
    BY_CHANNELS(channels, lit, composite, job, work, tile, pixels, at)

    __builtin_memcpy(work.final_t, final, sizeof final);
    __builtin_memcpy(work.last, last, sizeof last);
    if (job.background) {
        F value[kPatches];
        for (int k = 0; k < channels; ++k) {
            load_plane(tile, value, 1, job.background + k * job.background_c, job.background_x, job.background_y);
            F* to = colour + k;
            if (lit) {
                for (int p = 0; p < kPatches; ++p)
                    to[p * channels] += final[p] * value[p] * (k < kLitChannels ? light[p] : splat(1.f));
            } else {
                for (int p = 0; p < kPatches; ++p) to[p * channels] += final[p] * value[p];
            }
        }
    }
    const size_t plane = size_t(view.width) * view.height;
    for (int p = 0; p < kPatches; ++p) final[p] = 1.f - final[p];
    for (uint32_t i = 0; i < work.time_count; ++i) {
        float* image = job.image + work.times[i] * job.image_t;
        for (int k = 0; k < channels; ++k) store_plane(tile, colour + k, channels, image + k * plane, view.width);
        store_plane(tile, final, 1, job.alpha + work.times[i] * job.alpha_t, view.width);
    }
}

// Sum over the times of a tile: what shows the same picture gets the same gradient.
INLINE void load_gradient(const Tile& t, const TileWork& work, F* patches, int step, const PlaneGrad* of, ptrdiff_t of_t) {
    bool any = false;
    for (uint32_t i = 0; of && i < work.time_count; ++i) {
        const PlaneGrad& plane = of[work.times[i] * of_t];
        if (!plane.data) continue;
        if (!any) {
            load_plane(t, patches, step, plane.data, plane.right, plane.down);
            any = true;
            continue;
        }
        F more[kPatches];
        load_plane(t, more, 1, plane.data, plane.right, plane.down);
        for (int p = 0; p < kPatches; ++p) patches[p * step] += more[p];
    }
    for (int p = 0; p < kPatches && !any; ++p) patches[p * step] = F{};
}

// Back to front, with two running scalars per pixel: the transmittance T_i and the gradient-weighted
// value `behind` of what lies behind Gaussian i, as if it were alone: with s_i = value_i . dL/dpixel,
// dL/dalpha_i = T_i (s_i - behind_i) and behind_(i-1) = behind_i + alpha_i (s_i - behind_i).
// Unlike a front-to-back pass, which gets the light from behind as (total - sum so far), this loses no
// digits behind nearly opaque Gaussians.
void backward(const BackwardJob& back, const TileWork& work, bool add) {
    const ForwardJob& job = back.forward;
    const View& view = job.view;
    const int channels = job.channels;
    const int stride = slot_stride(channels);
    const Tile tile = tile_of(view, work.index);
#if EVSPLAT_LANES < 16
    prefetch_tile(back, work, tile, stride);
#endif
    Pixels pixels;
    fill_pixels(tile, pixels);
    F transmittance[kPatches], behind[kPatches], value[kPatches], light[kPatches], light_grad[kPatches];
    I last[kPatches];
    F grad[kPatches * kMaxChannels];
    __builtin_memcpy(transmittance, work.final_t, sizeof transmittance);
    __builtin_memcpy(last, work.last, sizeof last);

    load_gradient(tile, work, value, 1, back.alpha_grad, back.alpha_grad_t);
    for (int p = 0; p < kPatches; ++p) behind[p] = -value[p];
    const bool lit = job.light;
    if (lit) load_plane(tile, light, 1, job.light, 1, view.width);
    for (int p = 0; p < kPatches && lit; ++p) light_grad[p] = F{};
    for (int k = 0; k < channels; ++k) {
        F* of = grad + k;
        load_gradient(tile, work, of, channels, back.image_grad ? back.image_grad + k : nullptr, back.image_grad_t);
        if (!job.background) continue;
        load_plane(tile, value, 1, job.background + k * job.background_c, job.background_x, job.background_y);
        if (lit && k < kLitChannels) {
            for (int p = 0; p < kPatches; ++p) {
                const F by = of[p * channels] * value[p];
                behind[p] += by * light[p];
                light_grad[p] += by * transmittance[p];
            }
        } else {
            for (int p = 0; p < kPatches; ++p) behind[p] += of[p * channels] * value[p];
        }
    }
    if (back.background_grad) {
        if (back.background_is_image) {
            for (int k = 0; k < channels; ++k)
                for_pixels(tile, [&](int p, int l, int x, int y) {
                    back.background_grad[(size_t(y) * view.width + x) * job.value_stride + k] +=
                        grad[p * channels + k][l] * transmittance[p][l] * (lit && k < kLitChannels ? light[p][l] : 1.f);
                });
        } else {
            for (int k = 0; k < channels; ++k) {
                F total = F{};
                for (int p = 0; p < kPatches; ++p)
                    total += grad[p * channels + k] * transmittance[p] * (lit && k < kLitChannels ? light[p] : splat(1.f));
                back.background_grad[size_t(work.index) * channels + k] += sum(total);
            }
        }
    }

    const Behind at = {last, grad, light, transmittance, behind, light_grad};
    BY_CHANNELS(channels, lit, composite_backward, back, work, tile, pixels, stride, add, at)
    if (lit && back.light_grad) store_plane(tile, light_grad, 1, back.light_grad, view.width);
}

double multiply_add(int64_t rounds, float* sink) {
    // Named variables, as GCC keeps an array in memory; ten hide the latency of two units.
    const F b = splat(0.999f), c = splat(1e-3f);
    F a0 = splat(*sink), a1 = a0 + 1.f, a2 = a0 + 2.f, a3 = a0 + 3.f, a4 = a0 + 4.f;
    F a5 = a0 + 5.f, a6 = a0 + 6.f, a7 = a0 + 7.f, a8 = a0 + 8.f, a9 = a0 + 9.f;
    for (int64_t i = 0; i < rounds; ++i) {
        a0 = a0 * b + c, a1 = a1 * b + c, a2 = a2 * b + c, a3 = a3 * b + c, a4 = a4 * b + c;
        a5 = a5 * b + c, a6 = a6 * b + c, a7 = a7 * b + c, a8 = a8 * b + c, a9 = a9 * b + c;
    }
    *sink = sum(a0 + a1 + a2 + a3 + a4 + a5 + a6 + a7 + a8 + a9);
    return double(rounds) * 10 * W * 2;
}

}  // namespace

#define EVSPLAT_ENTRY(result, name, arguments) name,
const Kernels kernels = {EVSPLAT_NAME, W, kPatches, forward, backward, multiply_add, EVSPLAT_KERNELS(EVSPLAT_ENTRY)};

}  // namespace EVSPLAT_LEVEL
}  // namespace evsplat
