// Soft shadows of a body in the light of lamps: its points, seen from a lamp, are round Gaussians on the plane
// through its middle that faces the lamp, added up on a grid.
//
// As `BodyShadow` in src/evsplat/models/discs/shadow.py has it. Depths that are at most e^-18 of their largest are
// left out.
#pragma once

#include <stddef.h>

namespace evsplat {

constexpr int kMaxLamps = 16;
constexpr float kShadowReach = 1.5f;                      // metres, half side of the grid, and of the layers
constexpr int kShadowCells = 49, kShadowLayers = 31;      // along a side; layers along the light
constexpr float kShadowScale = (kShadowCells - 1) / (2.f * kShadowReach);       // cells in a metre
constexpr float kShadowLayerScale = (kShadowLayers - 1) / (2.f * kShadowReach);
constexpr float kShadowLayerEdge = 0.03f;                 // metres, of the step with which a point enters a layer
constexpr float kShadowOwnSurface = 0.12f;                // metres that a point is nearer to the lamp to shade another
constexpr float kShadowNearest = 0.1f;                    // metres from the lamp
constexpr float kShadowFade = 0.1f, kShadowFadeAt = -0.2f;  // of the shadow on the scene, metres behind the middle
// A grid has a border of zeros, so that what lies outside is lit.
constexpr int kShadowRow = 64;
constexpr size_t kShadowPlane = size_t(kShadowCells + 2) * kShadowRow, kShadowPlanes = kShadowLayers + 2;

// How a lamp sees the body at one time.
struct LampView {
    float middle[3], axis[3], across[2][3], distance;
};

// Gradient of a view, as sums over points q from the middle that have coordinates u, v across and b along the axis.
enum ViewSum { kByU = 0, kByV = 3, kByB = 6, kU = 9, kV, kB, kDistance, kViewSums };

// The body at `times`, before `lamps`.
struct Shadow {
    size_t times, points;
    int lamps;
    const float *body, *lamp, *width;  // (times, points, 3), (lamps, 3), (lamps)
    float strength;                    // depth of one point, times square metres
    bool layered;                      // a grid has kShadowPlanes planes, else one
    size_t grid() const { return layered ? kShadowPlanes * kShadowPlane : kShadowPlane; }
};

// What is asked for: the factor of all lamps (times, places) at places of the scene (places, 3), by the lamps' shares,
// or, with layers, the share of light (lamps, times, places) at places of the body (times, places, 3).
struct ShadowPlaces {
    size_t count;
    const float *at, *share;  // share: (lamps), null with layers
};

struct ShadowGrads {
    float *body, *lamp, *width, *share;  // body may be null; share is null with layers; written
    float* places;                       // (places, 3), summed over the times; null with layers, and may be; written
};

// Writes the grids (lamps, times, grid) and the result.
void cast_shadow(const Shadow&, const ShadowPlaces&, int threads, float* grids, float* result);

// From the grids that `cast_shadow` wrote and the gradient of its result.
void cast_shadow_backward(const Shadow&, const ShadowPlaces&, const float* grids, const float* above, int threads,
                          const ShadowGrads&);

// One lamp at one time, for the kernels.
struct ShadowSplat {
    LampView view;
    const float* body;  // (points, 3)
    size_t points;
    float width, strength;  // metres; depth of a point times square metres
    bool layered;
};

// All lamps at one time; of layers one lamp.
struct ShadowLook {
    int lamps;
    const LampView* views;
    const float* const* grids;
    const float* share;
    const float* at;
};

struct SplatGrads {
    float *body;          // (points, 3), added to; may be null
    double *sums, *width;  // (kViewSums) and one, added to
};

}  // namespace evsplat
