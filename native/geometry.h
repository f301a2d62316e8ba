// What is asked of a body's surface outside of training steps: its silhouette, points spread over it, and how
// bright these are by their normals.
#pragma once

#include <stddef.h>
#include <stdint.h>

namespace evsplat {

// Sets the pixels of mask (height, width) whose centre lies in a triangle. `pixels` (V, 2) are the vertices' places in
// the picture; triangles with a vertex that is not `in_front` of the camera, or without area, cover none.
struct Triangles {
    const double* pixels;
    const uint8_t* in_front;
    const int64_t* corners;  // (count, 3), each below V
    size_t count;
};
void fill_triangles(const Triangles&, uint8_t* mask, size_t height, size_t width);

// Writes rows of `points` (count, 3), the first one and then each the farthest from those before it.
void spread_points(const float* points, size_t count, int64_t* chosen, size_t wanted);

// Normals n of `count` points as `linear` (times, count, 3, 3) turns them, made of length 1 again, and `light`: eight
// factors of x, y, z, xy, yz, xz, xx - yy and 3 zz - 1, whose sum and 1 is the brightness (times, count).
struct TurnedNormals {
    const float *linear, *normals, *light;
    size_t times, count;
};
void shade_normals(const TurnedNormals&, float* brightness);
// Writes the gradients of `linear`, unless that is null, and of `light` (8) from that of the brightness.
void shade_normals_backward(const TurnedNormals&, const float* above, float* by_linear, float* by_light);

}  // namespace evsplat
