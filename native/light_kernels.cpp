// Tiles that show nothing that moves, under the lights of several times, compiled once per SIMD level.

#include "kernels.h"

namespace evsplat {
namespace EVSPLAT_LEVEL {
namespace {

#include "simd.h"

constexpr int kVectors = kTile / W;

// Calls f(y, x, in_tile, count) for the vectors of a tile's rows: the picture's pixel and the tile's that each
// begins with, and how many of its pixels there are.
template <class Function>
INLINE void for_vectors(const View& view, uint32_t tile, Function f) {
    const int left = int(tile % view.tiles_x) * kTile, top = int(tile / view.tiles_x) * kTile;
    const int columns = view.width - left < kTile ? view.width - left : kTile;
    const int rows = view.height - top < kTile ? view.height - top : kTile;
    for (int y = 0; y < rows; ++y)
        for (int v = 0; v < kVectors && v * W < columns; ++v)
            f(top + y, left + v * W, size_t(y) * kTile + v * W, size_t(columns - v * W));
}

INLINE F row_of(const PlaneGrad& plane, int y, int x, size_t count) {
    const float* from = plane.data + y * plane.down + x * plane.right;
    if (plane.right == 1) return load_some(from, count);
    F value = {};
    for (size_t l = 0; l < size_t(W) && l < count; ++l) value[l] = from[ptrdiff_t(l) * plane.right];
    return value;
}

}  // namespace

void light_tile(const LightTile& s, const TileWork& work) {
    const size_t pixels = size_t(s.view->width) * s.view->height;
    for (uint32_t i = 0; i < work.time_count; ++i) {
        const size_t t = work.times[i];
        for_vectors(*s.view, work.index, [&](int y, int x, size_t, size_t count) {
            const size_t at = size_t(y) * s.view->width + x;
            const F light = load_some(s.light + t * pixels + at, count);
            for (int k = 0; k < kLitChannels; ++k) {
                float* to = s.image + (t * s.channels + k) * pixels + at;
                store_some(to, load_some(to, count) * light, count);
            }
        });
    }
}

void light_tile_backward(const LightTile& s, const LightTileGrads& g, const TileWork& work) {
    const size_t pixels = size_t(s.view->width) * s.view->height;
    for_vectors(*s.view, work.index, [&](int y, int x, size_t in_tile, size_t count) {
        const size_t at = size_t(y) * s.view->width + x;
        F unlit[kLitChannels], sums[kMaxChannels], alpha = {};
        for (int k = 0; k < kLitChannels; ++k) unlit[k] = load_some(s.unlit + k * pixels + at, count);
        for (int k = 0; k < s.channels; ++k) sums[k] = F{};
        for (uint32_t i = 0; i < work.time_count; ++i) {
            const size_t t = work.times[i];
            if (g.of_alpha && g.of_alpha[t].data) alpha += row_of(g.of_alpha[t], y, x, count);
            const F light = load_some(s.light + t * pixels + at, count);
            F by_light = {};
            for (int k = 0; g.of_image && k < s.channels; ++k) {
                const PlaneGrad& plane = g.of_image[t * s.channels + k];
                if (!plane.data) continue;
                const F given = row_of(plane, y, x, count);
                if (k < kLitChannels)
                    sums[k] += given * light, by_light += given * unlit[k];
                else
                    sums[k] += given;
            }
            if (g.light) store_some(g.light + t * pixels + at, by_light, count);
        }
        for (int k = 0; k < s.channels; ++k) store_some(g.image + k * kTilePixels + in_tile, sums[k], count);
        store_some(g.alpha + in_tile, alpha, count);
    });
}

}  // namespace EVSPLAT_LEVEL
}  // namespace evsplat
