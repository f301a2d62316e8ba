// Z-buffer renderer of synthetic captures: a textured room with baked light, a skinned person in it and
// the person's soft shadow. Linear light, no noise, the same bits with any number of threads; see
// src/evsplat/staging/renderer.py for the meaning of the arrays.
#pragma once

#include <stddef.h>
#include <stdint.h>

#include <array>
#include <vector>

namespace evsplat::zbuffer {

constexpr int kMaxLevels = 8;
constexpr int kSamples = 2;     // of the person, per pixel and axis
constexpr float kNear = 0.05f;  // metres; nothing nearer is drawn

// Level k has half the width and height of level k - 1; linear RGB.
struct Texture {
    const float* level[kMaxLevels] = {};  // (layers, height >> k, width >> k, 3)
    int levels = 0, layers = 0, width = 0, height = 0;
};

struct Room {
    size_t triangles = 0;
    const float *corners = nullptr, *normals = nullptr;  // (F, 3, 3), (F, 3)
    const float* uv = nullptr;                           // (F, 3, 2), repeating
    const int32_t* layer = nullptr;                      // (F)
    const float *tint = nullptr;                         // (F, 3)
    const float *direct = nullptr, *ambient = nullptr;   // (F, 3), (F, 3, 3): light at the corners
    Texture texture;
};

struct Person {
    size_t vertices = 0, triangles = 0, joints = 0, influences = 0, contacts = 0;
    const int32_t* faces = nullptr;     // (F, 3)
    const float* uv = nullptr;          // (V, 2)
    const uint8_t* cutout = nullptr;    // (F): the atlas's alpha cuts holes
    const int32_t* bones = nullptr;     // (V, K)
    const float* weights = nullptr;     // (V, K)
    const int32_t* contact = nullptr;   // (C): joints that darken the floor below them
    const float* rest_joints = nullptr; // (J, 3)
    Texture texture;
    const uint8_t* alpha = nullptr;     // (height, width) of the atlas
};

// A flat lamp, light from all around, and how skin and cloth answer.
struct Light {
    std::array<float, 3> position = {};
    std::array<float, 3> facing = {0, 0, -1};  // the way it shines, of length 1
    float power = 0;
    std::array<float, 12> world_to_light = {};  // (3, 4), z away from the lamp
    float shadow_focal = 0, shadow_radius = 0;  // texels
    int shadow_size = 0;                        // texels along a side
    float shadow_bias = 0;                      // metres
    std::array<float, 3> ambient_below = {}, ambient_above = {};
    float rim = 0, wrap = 0, specular = 0, shininess = 1;
};

struct View {
    int width = 0, height = 0;
    float fx = 0, fy = 0, cx = 0, cy = 0;
    float r[9] = {}, t[3] = {};  // world to camera
    bool operator==(const View&) const;
};

// What the empty room looks like from one view.
struct Layers {
    View view;
    int samples = 0;
    std::vector<float> direct, ambient;  // (H, W, 3): light of the lamp, of all else
    std::vector<float> surface;          // (H, W, 4): place of the wall behind the pixel's middle, z of its normal
    std::vector<float> depth;            // (H kSamples, W kSamples), metres
};

// One instant of the person.
struct Pose {
    const float* bones;               // (J, 4, 4), rest to world
    const float *vertices, *normals;  // (V, 3), at rest
};

Layers draw_room(const Room&, const View&, int samples);
// image: (H, W, 4), linear RGB and the person's share of the pixel.
void draw_person(const Person&, const Light&, const Layers&, const Pose&, bool shadows, float* image);

}  // namespace evsplat::zbuffer
