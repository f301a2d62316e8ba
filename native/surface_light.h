// The light on a person's surface: a factor on its colours by how it is turned and where it stands.
#pragma once

#include <stddef.h>

namespace evsplat {

constexpr int kLightPlaces = 4, kLightNormals = 9;  // 1, x, y, z; spherical harmonics of degrees 0 to 2
constexpr int kLightCoefficients = kLightPlaces * kLightNormals * 3;
constexpr float kDarkest = 0.2f, kBrightest = 3.f;  // bounds of the factor
constexpr float kLampNearest = 0.3f;                // metres; nearer, light grows no more

// As `Shading` in src/evsplat/deform/shading.py has it.
struct SurfaceLight {
    size_t times, points;
    const float* transforms;    // (times, points, 16), canonical to world
    const float* normals;       // (points, 3), canonical
    const float* places;        // (times, points, 3), in the world
    const float* coefficients;  // (kLightPlaces, kLightNormals, 3)
    float center[3], radius;
    int lamps;
    const float *lamp, *intensity;  // (lamps, 3), (lamps, 3)
    const float* lit;               // (lamps, lit_times, points), shares of the lamps' light; may be null
    size_t lit_times;               // times or 1
};

constexpr size_t light_sums(int lamps) { return kLightCoefficients + 6 * size_t(lamps); }

// Writes factors (times, points, 3).
void surface_light(const SurfaceLight&, int threads, float* factors);

// Writes the gradients of coefficients, lamps' places and intensities one after the other, and that of
// `lit` unless it is null, for the gradient `above` of the factors.
void surface_light_backward(const SurfaceLight&, const float* above, int threads, float* sums, float* lit);

}  // namespace evsplat
