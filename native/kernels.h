// The plain data that the driver and the kernels exchange, and the table of kernels of one SIMD level.
#pragma once

#include <stddef.h>
#include <stdint.h>

#if defined(EVSPLAT_LANES) && (defined(__x86_64__) || defined(__i386__))
#include <immintrin.h>  // for kernels alone: it takes most of a second to read
#endif

#include "event_windows.h"
#include "list.h"
#include "mlp_kernels.h"
#include "picture.h"
#include "posing.h"
#include "sensor_kernels.h"
#include "shadow.h"
#include "skinning.h"
#include "ssim.h"
#include "surface_light.h"

namespace evsplat {

constexpr int kTile = 16;              // pixels along the side of a tile
constexpr int kTilePixels = kTile * kTile;
constexpr uint32_t kBlock = 512;       // Gaussians per unit of projection work; fixes the order of sums
constexpr int kMoments = 6;            // gradient slot: sums of h, hu, hv, huu, huv, hvv, then channels
constexpr int kMaxChannels = 32;       // drawn in one go; more are drawn in blocks
constexpr float kMinAlpha = 1.f / 255.f;  // below it a Gaussian is not drawn

constexpr int kLitChannels = 3;

constexpr int slot_stride(int channels) { return (kMoments + channels + 3) / 4 * 4; }

// Camera and image of one render. `r`, `t`: world to camera, row-major.
struct View {
    float r[9], t[3];
    float fx, fy, cx, cy;
    float near_plane, low_pass;  // metres, px^2
    int width, height, tiles_x, tiles_y;
};

// The Gaussians of one time. `linear` and `offset` may be null.
struct Gaussians {
    const float *means, *quaternions, *scales, *opacities, *linear, *offset;
    uint32_t count;
};

// What compositing needs of one projected Gaussian. With d = pixel - (x, y), u = l11 dx + l12 dy and
// v = l22 dy, the opacity at the pixel is exp2(log2_opacity - u^2 - v^2): a Cholesky factor of the
// inverse covariance keeps digits that the quadratic form loses for long thin Gaussians.
struct alignas(32) Projected {
    float x, y, l11, l12, l22, log2_opacity, depth, unused;
};

// One Gaussian in one tile, in the order of the Gaussians; `patches` has a bit per patch it reaches.
struct Slot {
    uint32_t tile, gaussian;
    uint64_t patches;
};

// One Gaussian in one tile, in the order of compositing.
struct Entry {
    uint32_t gaussian, slot;
    uint64_t patches;
};

// Gaussians below `split` move: theirs is the first array, those of one time. The others stand still.
struct ForwardJob {
    View view;
    int channels;
    uint32_t split;
    const Projected* projected[2];
    const float* values[2];       // (N, value_stride), of which `channels` are drawn
    size_t value_stride;
    const float* background;      // null, or value of channel k at pixel (x, y): k*bc + x*bx + y*by
    ptrdiff_t background_c, background_x, background_y;
    float *image, *alpha;         // planar (T, C, H, W) and (T, H, W)
    size_t image_t, alpha_t;      // floats from one time to the next
    const float* light;           // (H, W), null for 1: factor on the first kLitChannels of what stands still
};

// One tile with one list of entries, and the times whose picture it is.
struct TileWork {
    uint32_t index;
    const Entry* entries;
    uint32_t count;
    const uint32_t* times;
    uint32_t time_count;
    bool bare;                    // nothing moving is among the entries
    // What the backward pass starts from, by patch, not by row:
    float* final_t;               // (256) transmittance behind the last entry
    int32_t* last;                // (256) last entry before compositing stopped; where it did not, that or a later one
    uint32_t* patch_end;          // (patches) entries after which a patch is opaque
};

// The gradient of one channel of a picture, element (y, x) at data[y * down + x * right]; null is zero.
struct PlaneGrad {
    const float* data = nullptr;
    ptrdiff_t down = 0, right = 0;
};

struct BackwardJob {
    ForwardJob forward;
    const PlaneGrad *image_grad, *alpha_grad;  // of channel k at time t: image_grad[t * image_grad_t + k]; null: zero
    ptrdiff_t image_grad_t, alpha_grad_t;
    float* slots;                 // (slots, slot_stride(C))
    float* background_grad;       // null, or (tiles, C) or (H, W, value_stride), added to
    bool background_is_image;
    float* light_grad;            // (H, W), written; null: not wanted
};

// A tile where nothing moves, drawn without light, and its pictures under the lights of their times.
struct LightTile {
    const View* view;
    int channels;
    const float *light, *unlit;  // (T, H, W) and (kLitChannels, H, W)
    float* image;                // (T, channels, H, W)
};

// Of the pictures, of channel k at time t at of_image[t * channels + k], and of alpha; null: zero. What is written:
// their sums over the times, (channels, tile) and (tile), of the picture without light; (T, H, W) of the lights, or null.
struct LightTileGrads {
    const PlaneGrad *of_image, *of_alpha;
    float *image, *alpha, *light;
};

struct PairOfSums {
    double first, second;
};

// Gradients that are added to; each may be null.
struct GaussianGrads {
    float *means, *quaternions, *scales, *opacities, *values, *linear, *offset;
    size_t value_stride;
    float* view;                  // (blocks, 12): rotation row-major, translation; written, not added
};

// Kernels outside of kernels.cpp: KERNEL(result, name, arguments) of each.
#define EVSPLAT_KERNELS(KERNEL) \
    /* Projects [begin, end), appends its slots; first_slot[i] is relative to the list's start. */ \
    KERNEL(void, project, (const View&, const Gaussians&, uint32_t begin, uint32_t end, Projected*, int32_t* radii, uint32_t* first_slot, List<Slot>&)) \
    /* Sums the slots of each Gaussian of [begin, end) and goes back through the projection. */ \
    KERNEL(void, project_backward, (const View&, const Gaussians&, uint32_t begin, uint32_t end, const Projected*, const uint32_t* first_slot, const float* slots, int channels, const GaussianGrads&)) \
    /* Multiplies pictures that are there without light by their lights. */ \
    KERNEL(void, light_tile, (const LightTile&, const TileWork&)) \
    KERNEL(void, light_tile_backward, (const LightTile&, const LightTileGrads&, const TileWork&)) \
    KERNEL(void, mlp_forward, (const MlpShape&, const MlpForward&, size_t block, float* scratch)) \
    KERNEL(void, mlp_backward, (const MlpShape&, const MlpBackward&, size_t block, const MlpSums&, float* scratch)) \
    /* Sums over a band, and the gradient of the similarity. */ \
    KERNEL(SsimSums, ssim_band, (const SsimBand&)) \
    /* Rows [begin, end) of a plane's windows; `line` is a padded row. */ \
    KERNEL(void, window_means, (const WindowMeans&, size_t plane, int begin, int end, double* line)) \
    KERNEL(void, log_brightness, (const LogBrightness&, size_t begin, size_t end, float* value)) /* of each picture's pixels */ \
    KERNEL(void, log_brightness_backward, (const LogBrightness&, size_t begin, size_t end, const float* above, float* const* grads)) \
    KERNEL(void, power, (const Power&, size_t begin, size_t end)) \
    KERNEL(void, power_mean, (const PowerMean&, size_t begin, size_t end)) /* of all planes' values */ \
    KERNEL(void, power_mean_backward, (const PowerMean&, size_t begin, size_t end, const float* above, float* const* grads)) \
    KERNEL(void, share_of_range, (const uint8_t*, size_t, float*)) \
    KERNEL(void, add_sign, (const float*, const float*, float, float, size_t, float*)) \
    KERNEL(double, membership, (const Membership&, size_t begin, size_t end)) /* begin: a multiple of 16 */ \
    KERNEL(double, misfit, (const Misfit&, size_t begin, size_t end)) \
    /* Of two maps: squares; absolute differences and their signs times the first; the gradient of those. */ \
    KERNEL(PairOfSums, square_sums, (const float*, const float*, size_t)) \
    KERNEL(PairOfSums, difference_sums, (const float*, const float*, float, float, size_t)) \
    KERNEL(void, difference_slope, (const float*, const float*, float, float, float, float, size_t, float*)) \
    KERNEL(WindowSums, window_difference, (const WindowDifference&, size_t begin, size_t end, float* slope)) \
    KERNEL(void, view_directions, (const ViewDirections&, size_t begin, size_t end)) \
    KERNEL(void, sh_rows, (const ShRows&, size_t begin, size_t end)) \
    KERNEL(void, tree_softmax, (const TreeSoftmax&, size_t begin, size_t end, float* scratch)) \
    /* Points [begin, end). */ \
    KERNEL(void, skin, (const Skinning&, size_t begin, size_t end, Hangs* scratch, float* moved, float* blended, float* linear)) \
    KERNEL(void, skin_backward, (const Skinning&, const SkinningGrads&, const float* blended, size_t begin, size_t end)) \
    KERNEL(void, surface_light, (const SurfaceLight&, size_t begin, size_t end, float* factors)) \
    /* Sums over the points, and the gradient of the shares unless `lit` is null. */ \
    KERNEL(void, surface_light_backward, (const SurfaceLight&, size_t begin, size_t end, const float* above, float* sums, float* lit)) \
    /* A body's points onto a grid, and from the grid's gradient, which changes, to theirs. */ \
    KERNEL(void, shadow_splat, (const ShadowSplat&, float* grid)) \
    KERNEL(void, shadow_splat_backward, (const ShadowSplat&, float* grid, const SplatGrads&)) \
    /* Places [begin, end); back, it adds to grids and writes (lamps, kViewSums) sums and the shares'. */ \
    KERNEL(void, shadow_on_scene, (const ShadowLook&, size_t begin, size_t end, float* factor)) \
    KERNEL(void, shadow_on_scene_backward, (const ShadowLook&, size_t begin, size_t end, const float* above, float* const* grids, float* sums, float* share, float* places)) \
    KERNEL(void, shadow_on_body, (const ShadowLook&, size_t begin, size_t end, float* lit)) \
    KERNEL(void, shadow_on_body_backward, (const ShadowLook&, size_t begin, size_t end, const float* above, float* grid, float* sums)) \
    KERNEL(void, sensor_step, (const SensorPiece&))

struct TileKernels;

struct Kernels {
    const char* name;
    int lanes, patches;
    void (*forward)(const ForwardJob&, const TileWork&);
    // Writes the entries' slots; with `add` those of Gaussians that stand still are added to.
    void (*backward)(const BackwardJob&, const TileWork&, bool add);
    // Independent multiply-adds for `rounds`; returns the floating-point operations done.
    double (*multiply_add)(int64_t rounds, float* sink);
#define EVSPLAT_POINTER(result, name, arguments) result(*name) arguments;
    EVSPLAT_KERNELS(EVSPLAT_POINTER)
    const TileKernels* tiles = nullptr;  // networks on AMX, in place of the two above; null without
};

#define EVSPLAT_FUNCTION(result, name, arguments) result name arguments;
#define EVSPLAT_LEVEL_TABLE(level)        \
    namespace level {                     \
    extern const Kernels kernels;         \
    EVSPLAT_KERNELS(EVSPLAT_FUNCTION)     \
    }
EVSPLAT_LEVEL_TABLE(portable)
#ifdef EVSPLAT_X86
EVSPLAT_LEVEL_TABLE(avx2)
EVSPLAT_LEVEL_TABLE(avx512)
#endif

}  // namespace evsplat
