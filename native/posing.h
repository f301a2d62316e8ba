// What lies between the networks of a posed Gaussian: its changed shape, and where it is seen from.
#pragma once

#include <stddef.h>
#include <stdint.h>

namespace evsplat {

// Unit vectors from `center` to `points` positions, each turned by the transposed 3x3 part of its
// (4, 4) transform if there are transforms, and then all by `turn`.
struct ViewDirections {
    size_t points;
    const float* positions;   // (points, 3)
    const float* transforms;  // (points, 16) or null
    float center[3], turn[9];
    float* directions;        // (points, 3)
};

// Gaussians of any rotation and opacity whose footprint, as projection_kernels.cpp finds it, may reach into a picture.
struct InView {
    size_t points;
    const float *means, *scales;  // (points, 3), (points, 3)
    const float *k, *pose;        // (3, 3) camera matrix, (4, 4) world to camera
    int width, height;
};

// Writes their rows, in order, and returns how many there are.
size_t rows_in_view(const InView&, int64_t* rows);

// The 15 real spherical harmonics of degrees 1 to 3, row i at to + i * stride, and `columns` other values, row
// i at beside + i * stride.
struct ShRows {
    size_t points;
    const float *directions, *values;  // (points, 3), (points, columns)
    float *to, *beside;
    size_t stride, columns;
};

constexpr int kShValues = 15;

void view_directions(const ViewDirections&, int threads);
void sh_rows(const ShRows&, int threads);

// Weights over the joints of a tree, by passing mass from the root down; see
// src/evsplat/deform/skinning_network.py. `order` has parents first; `gate` is the logit whose sigmoid a
// joint passes on, or -1; of a joint with `divides` the children share by the softmax of their logits.
struct TreeSoftmax {
    size_t points;
    int joints, logits;
    const int32_t *order, *parents, *gate, *divides;  // (joints)
    const float* given;       // (points, logits)
    float* weights;           // (points, joints), or null to go back:
    const float* above;       // (points, joints) gradient of the weights
    float* grad;              // (points, logits)
};

constexpr size_t tree_softmax_floats(int joints, int logits) { return size_t(16) * 4 * (joints + logits); }

void tree_softmax(const TreeSoftmax&, int threads);

// A bump per coordinate, integrated over `bins` bins of [0, 1]; see src/evsplat/deform/encodings.py.
struct OneBlob {
    size_t points;
    int bins;
    const float* positions;   // (points, 3)
};

void one_blob(const OneBlob&, int threads, float* encoded);  // (points, 3, bins)
// Gradient of the positions from that of the encoded.
void one_blob_backward(const OneBlob&, const float* above, int threads, float* grad);

constexpr int kShapeChanges = 9;  // offset, change of log-scale, vector part of a quaternion

// Changes per time and point, and what they change; quaternions (w, x, y, z) of any length.
struct ShapeChange {
    size_t times, points;
    int columns;              // of `changes`: kShapeChanges and the feature
    const float* changes;     // (times, points, columns)
    const float *means, *scales_log, *quaternions;  // (points, 3), (points, 3), (points, 4)
};

// moved = mean + offset, scale = exp(scale_log + change), rotation = (1, x, y, z) * normalised quat, and a
// copy of the feature: (times, points, 3), (.., 3), (.., 4), (.., columns - kShapeChanges).
void change_shape(const ShapeChange&, int threads, float* moved, float* scales, float* rotations, float* feature);

// Gradients of the four results, each null or with rows `step` apart.
struct ShapeGrad {
    const float* data;
    size_t step;
};

// Writes the gradients of the inputs; `scales` are the result.
void change_shape_backward(const ShapeChange&, const float* scales, const ShapeGrad (&above)[4], int threads,
                           float* changes, float* means, float* scales_log, float* quaternions);

}  // namespace evsplat
