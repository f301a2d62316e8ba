// What is asked of a body's surface outside of training steps: its silhouette, and points spread over it.
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

}  // namespace evsplat
