#include "zbuffer.h"

#include <algorithm>
#include <cmath>
#include <cstring>
#include <limits>

#include "buffer.h"

namespace evsplat::zbuffer {
namespace {

constexpr float kFar = std::numeric_limits<float>::infinity();
constexpr int kTaps = 12;           // of the shadow's soft edge
constexpr uint8_t kOpaque = 115;    // atlas alpha from which a cut-out is solid
constexpr int kBlock = 8;           // texels along a side of the shadow map's blocks
constexpr float kFloorUp = 0.7f, kFloorHeight = 0.3f;  // what contact shadows fall on: normal z, metres

struct Vec {
    float x, y, z;
};
Vec operator+(Vec a, Vec b) { return {a.x + b.x, a.y + b.y, a.z + b.z}; }
Vec operator-(Vec a, Vec b) { return {a.x - b.x, a.y - b.y, a.z - b.z}; }
Vec operator*(float s, Vec a) { return {s * a.x, s * a.y, s * a.z}; }
float dot(Vec a, Vec b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
Vec unit(Vec a) { return (1.f / std::sqrt(dot(a, a) + 1e-20f)) * a; }
Vec vec(const float* p) { return {p[0], p[1], p[2]}; }
// Rows of a (3, 4) matrix.
Vec apply(const float* m, Vec p) {
    return {m[0] * p.x + m[1] * p.y + m[2] * p.z + m[3], m[4] * p.x + m[5] * p.y + m[6] * p.z + m[7],
            m[8] * p.x + m[9] * p.y + m[10] * p.z + m[11]};
}

// std::floor is a call where the processor may lack an instruction for it.
int floor_of(float v) {
    const int whole = int(v);
    return whole - (v < float(whole));
}

// Homogeneous position in an image, (x z, y z, z) in samples, and the place itself where z is in front.
struct Point {
    double x, y, z, column, row;
};
Point point(double x, double y, double z) { return {x, y, z, x / z, y / z}; }

// Shares of a triangle's corners as linear functions of the pixel (Olano and Greer 1997): dividing by
// their sum, which is 1 / z, makes them perspective-correct, and triangles that pass behind the camera
// need no clipping. Double, because tiny triangles lose their area to cancellation in float.
struct Triangle {
    double e[3][3];
    double determinant;
    int x0, x1, y0, y1;  // samples to visit, ends included
};

// Extent in the image of the part of a triangle in front of the camera.
struct Extent {
    double left = HUGE_VAL, right = -HUGE_VAL, top = HUGE_VAL, bottom = -HUGE_VAL;

    void add(const Point& p) {
        left = std::min(left, p.column), right = std::max(right, p.column);
        top = std::min(top, p.row), bottom = std::max(bottom, p.row);
    }
    // Where an edge passes the near plane.
    void add_crossing(const Point& a, const Point& b) {
        if ((a.z > kNear) == (b.z > kNear)) return;
        const double s = (kNear - a.z) / (b.z - a.z);
        add(point(a.x + s * (b.x - a.x), a.y + s * (b.y - a.y), kNear));
    }
};

bool set_up(const Point& a, const Point& b, const Point& c, int width, int height, Triangle& t) {
    Extent seen;
    for (const Point* p : {&a, &b, &c})
        if (p->z > kNear) seen.add(*p);
    if (a.z <= kNear || b.z <= kNear || c.z <= kNear)
        seen.add_crossing(a, b), seen.add_crossing(b, c), seen.add_crossing(c, a);
    if (!(seen.right >= 0.5 && seen.bottom >= 0.5 && seen.left <= width - 0.5 && seen.top <= height - 0.5)) return false;
    t.x0 = int(std::ceil(std::max(seen.left, 0.5) - 0.5)), t.x1 = int(std::min(seen.right, width - 0.5) - 0.5);
    t.y0 = int(std::ceil(std::max(seen.top, 0.5) - 0.5)), t.y1 = int(std::min(seen.bottom, height - 0.5) - 0.5);
    if (t.x0 > t.x1 || t.y0 > t.y1) return false;
    const Point* p[] = {&a, &b, &c};
    for (int i = 0; i < 3; ++i) {
        const Point &u = *p[(i + 1) % 3], &v = *p[(i + 2) % 3];
        t.e[i][0] = u.y * v.z - u.z * v.y;
        t.e[i][1] = u.z * v.x - u.x * v.z;
        t.e[i][2] = u.x * v.y - u.y * v.x;
    }
    t.determinant = a.x * t.e[0][0] + a.y * t.e[0][1] + a.z * t.e[0][2];
    if (!(std::abs(t.determinant) > 1e-9 * std::abs(a.z * b.z * c.z))) return false;
    const double inverse = 1 / t.determinant;
    for (auto& edge : t.e)
        for (double& value : edge) value *= inverse;
    return true;
}

// Calls accept(sample, z, w1, w2) wherever the triangle is nearer than `depth`; true keeps it.
template <class Accept>
void fill(const Triangle& t, int width, float* depth, Accept accept) {
    for (int y = t.y0; y <= t.y1; ++y) {
        const double py = y + 0.5;
        const double row[3] = {t.e[0][1] * py + t.e[0][2], t.e[1][1] * py + t.e[1][2], t.e[2][1] * py + t.e[2][2]};
        float* line = depth + size_t(y) * width;
        for (int x = t.x0; x <= t.x1; ++x) {
            const double px = x + 0.5;
            const double e0 = t.e[0][0] * px + row[0], e1 = t.e[1][0] * px + row[1], e2 = t.e[2][0] * px + row[2];
            if (e0 < 0 || e1 < 0 || e2 < 0) continue;
            const double inverse = e0 + e1 + e2;
            if (!(inverse > 0)) continue;
            const double zd = 1.0 / inverse;
            const float z = float(zd);
            if (z <= kNear || z >= line[x]) continue;
            if (accept(size_t(y) * width + x, z, float(e1 * zd), float(e2 * zd))) line[x] = z;
        }
    }
}

// Squared texels that a squared sample covers, divided by z^3: the Jacobian of texture over image.
float texel_density(const Triangle& t, const float* a, const float* b, const float* c, const Texture& texture) {
    const double area = double(b[0] - a[0]) * (c[1] - a[1]) - double(b[1] - a[1]) * (c[0] - a[0]);
    return float(std::abs(area / t.determinant) * texture.width * texture.height);
}

float level_of(float density, float z) { return 0.5f * std::log2(std::max(density * z * z * z, 1e-12f)); }

Vec bilinear(const Texture& t, int layer, int level, float u, float v) {
    const int w = t.width >> level, h = t.height >> level;
    const float* pixels = t.level[level] + size_t(layer) * w * h * 3;
    // a repeated texture is read at the share of a tile, which keeps digits far from the origin
    const float x = (u - floor_of(u)) * w - 0.5f, y = (v - floor_of(v)) * h - 0.5f;
    int x0 = floor_of(x), y0 = floor_of(y);
    const float fx = x - x0, fy = y - y0;
    const int x1 = x0 + 1 < w ? x0 + 1 : 0, y1 = y0 + 1 < h ? y0 + 1 : 0;
    if (x0 < 0) x0 = w - 1;
    if (y0 < 0) y0 = h - 1;
    const auto at = [&](int row, int column) { return vec(pixels + 3 * (size_t(row) * w + column)); };
    return (1 - fy) * ((1 - fx) * at(y0, x0) + fx * at(y0, x1)) + fy * ((1 - fx) * at(y1, x0) + fx * at(y1, x1));
}

Vec sample(const Texture& t, int layer, float level, float u, float v) {
    level = std::min(std::max(level, 0.f), float(t.levels - 1));
    const int low = int(level);
    const float share = level - low;
    const Vec fine = bilinear(t, layer, low, u, v);
    return share > 0 ? (1 - share) * fine + share * bilinear(t, layer, low + 1, u, v) : fine;
}

struct Hit {
    int32_t triangle;
    float w1, w2;
};

Point project(const View& v, Vec p, double samples) {
    const double x = double(v.r[0]) * p.x + double(v.r[1]) * p.y + double(v.r[2]) * p.z + v.t[0];
    const double y = double(v.r[3]) * p.x + double(v.r[4]) * p.y + double(v.r[5]) * p.z + v.t[1];
    const double z = double(v.r[6]) * p.x + double(v.r[7]) * p.y + double(v.r[8]) * p.z + v.t[2];
    return point(samples * (v.fx * x + v.cx * z), samples * (v.fy * y + v.cy * z), z);
}

Vec optical_centre(const View& v) {
    return {-(v.r[0] * v.t[0] + v.r[3] * v.t[1] + v.r[6] * v.t[2]),
            -(v.r[1] * v.t[0] + v.r[4] * v.t[1] + v.r[7] * v.t[2]),
            -(v.r[2] * v.t[0] + v.r[5] * v.t[1] + v.r[8] * v.t[2])};
}

template <class Accept>
void fill_room(const Room& room, const View& view, int samples, float* depth, Accept accept) {
    for (size_t f = 0; f < room.triangles; ++f) {
        Point p[3];
        for (int k = 0; k < 3; ++k) p[k] = project(view, vec(room.corners + 9 * f + 3 * k), samples);
        Triangle t;
        if (set_up(p[0], p[1], p[2], view.width * samples, view.height * samples, t))
            fill(t, view.width * samples, depth,
                 [&](size_t i, float z, float w1, float w2) { return accept(t, f, i, z, w1, w2); });
    }
}

// The person as the lamp sees it.
class ShadowMap {
  public:
    ShadowMap(const Light& light, const Person& person, const Vec* vertices)
        : light_(light), size_(light.shadow_size), blocks_((size_ + kBlock - 1) / kBlock), depth_(size_t(size_) * size_),
          nearest_(size_t(blocks_) * blocks_), x0_(size_), y0_(size_) {
        std::fill_n(depth_.data(), depth_.size(), kFar);
        Buffer<Point> seen(person.vertices);
        const double focal = light.shadow_focal, centre = 0.5 * size_;
        for (size_t v = 0; v < person.vertices; ++v) {
            const Vec p = apply(light.world_to_light.data(), vertices[v]);
            seen[v] = point(focal * p.x + centre * p.z, focal * p.y + centre * p.z, p.z);
        }
        for (size_t f = 0; f < person.triangles; ++f) {
            const int32_t* c = person.faces + 3 * f;
            Triangle t;
            if (!set_up(seen[c[0]], seen[c[1]], seen[c[2]], size_, size_, t)) continue;
            fill(t, size_, depth_.data(), [](size_t, float, float, float) { return true; });
            x0_ = std::min(x0_, t.x0), x1_ = std::max(x1_, t.x1), y0_ = std::min(y0_, t.y0), y1_ = std::max(y1_, t.y1);
        }
        mark_blocks();
        for (int k = 0; k < kTaps; ++k) {
            // a sunflower: even cover of the disc
            const double radius = light.shadow_radius * std::sqrt((k + 0.5) / kTaps), angle = (k + 0.5) * 2.39996;
            taps_[k][0] = float(radius * std::cos(angle)), taps_[k][1] = float(radius * std::sin(angle));
        }
    }

    // Share of the lamp that reaches a place. Each tap compares four texels and blends, so that a
    // shadow that moves slowly changes the light without steps, which would become events.
    float lit(Vec place) const {
        const Vec p = apply(light_.world_to_light.data(), place);
        if (p.z <= kNear) return 1;
        const float x = p.x / p.z * light_.shadow_focal + 0.5f * size_, y = p.y / p.z * light_.shadow_focal + 0.5f * size_;
        if (!(x >= 0 && y >= 0 && x < size_ && y < size_)) return 1;
        const float limit = p.z - light_.shadow_bias, margin = light_.shadow_radius + 2;
        if (nearest_[size_t(y / kBlock) * blocks_ + size_t(x / kBlock)] > limit) return 1;
        const bool inside = x >= margin && y >= margin && x < size_ - margin && y < size_ - margin;
        return inside ? mean<true>(x, y, limit) : mean<false>(x, y, limit);
    }

  private:
    template <bool inside>
    float mean(float x, float y, float limit) const {
        float sum = 0;
        for (const auto& tap : taps_) {
            const float sx = x + tap[0] - 0.5f, sy = y + tap[1] - 0.5f;
            const int x0 = inside ? int(sx) : floor_of(sx), y0 = inside ? int(sy) : floor_of(sy);
            const float fx = sx - x0, fy = sy - y0;
            float upper, lower;
            if (inside) {
                const float* texel = &depth_[size_t(y0) * size_ + x0];
                upper = (1 - fx) * float(texel[0] > limit) + fx * float(texel[1] > limit);
                texel += size_;
                lower = (1 - fx) * float(texel[0] > limit) + fx * float(texel[1] > limit);
            } else {
                upper = (1 - fx) * open(x0, y0, limit) + fx * open(x0 + 1, y0, limit);
                lower = (1 - fx) * open(x0, y0 + 1, limit) + fx * open(x0 + 1, y0 + 1, limit);
            }
            sum += (1 - fy) * upper + fy * lower;
        }
        return sum / kTaps;
    }

    float open(int x, int y, float limit) const {
        if (x < 0 || y < 0 || x >= size_ || y >= size_) return 1;
        return float(depth_[size_t(y) * size_ + x] > limit);
    }

    // nearest_: for each block, the least depth that a tap from there can meet.
    void mark_blocks() {
        std::fill_n(nearest_.data(), nearest_.size(), kFar);
        const int reach = int(std::ceil((light_.shadow_radius + 1) / kBlock));
        for (int by = y0_ / kBlock; by * kBlock <= y1_; ++by)
            for (int bx = x0_ / kBlock; bx * kBlock <= x1_; ++bx) {
                const float least = least_depth(bx, by);
                if (least == kFar) continue;
                for (int y = std::max(0, by - reach); y <= std::min(blocks_ - 1, by + reach); ++y)
                    for (int x = std::max(0, bx - reach); x <= std::min(blocks_ - 1, bx + reach); ++x)
                        nearest_[size_t(y) * blocks_ + x] = std::min(nearest_[size_t(y) * blocks_ + x], least);
            }
    }

    float least_depth(int bx, int by) const {
        float least = kFar;
        for (int y = by * kBlock; y < std::min(size_, (by + 1) * kBlock); ++y)
            for (int x = bx * kBlock; x < std::min(size_, (bx + 1) * kBlock); ++x)
                least = std::min(least, depth_[size_t(y) * size_ + x]);
        return least;
    }

    const Light& light_;
    int size_, blocks_;
    Buffer<float> depth_;
    Buffer<float> nearest_;
    int x0_, x1_ = -1, y0_, y1_ = -1;  // texels that the person covers lie within, ends included
    float taps_[kTaps][2];
};

// Linear blend skinning of places and normals.
void skin(const Person& person, const Pose& pose, Vec* vertices, Vec* normals) {
    for (size_t v = 0; v < person.vertices; ++v) {
        float m[12] = {};
        for (size_t k = 0; k < person.influences; ++k) {
            const float w = person.weights[v * person.influences + k];
            if (w == 0) continue;
            const float* bone = pose.bones + 16 * size_t(person.bones[v * person.influences + k]);
            for (int i = 0; i < 12; ++i) m[i] += w * bone[i];
        }
        const Vec n = vec(pose.normals + 3 * v);
        vertices[v] = apply(m, vec(pose.vertices + 3 * v));
        normals[v] = {m[0] * n.x + m[1] * n.y + m[2] * n.z, m[4] * n.x + m[5] * n.y + m[6] * n.z,
                      m[8] * n.x + m[9] * n.y + m[10] * n.z};
    }
}

// Light that a place on the person sends to the eye.
Vec shade(const Light& light, const ShadowMap& shadow, Vec albedo, Vec place, Vec normal, Vec eye) {
    normal = unit(normal);
    const Vec to_eye = unit(eye - place);
    float facing = dot(normal, to_eye);
    if (facing < 0) normal = -1.f * normal, facing = -facing;  // the inside of a garment
    const Vec away = vec(light.position.data()) - place;
    const Vec to_light = unit(away), back = -1.f * vec(light.facing.data());
    float lamp = std::max((dot(normal, to_light) + light.wrap) / (1 + light.wrap), 0.f) * std::max(dot(to_light, back), 0.f) /
                 (dot(away, away) + 1e-20f) * light.power;
    if (lamp > 0) lamp *= shadow.lit(place);
    const float gloss = light.specular * lamp * std::pow(std::max(dot(normal, unit(to_light + to_eye)), 0.f), light.shininess);
    const float above = 0.5f + 0.5f * normal.z;
    const Vec below = vec(light.ambient_below.data()), sky = vec(light.ambient_above.data());
    const Vec around = below + above * (sky - below);
    const float all = lamp + light.rim * facing;
    return {albedo.x * (all + around.x) + gloss, albedo.y * (all + around.y) + gloss, albedo.z * (all + around.z) + gloss};
}

// How much of the ambient light joints near the floor leave to a place on it.
float contact(const std::vector<Vec>& joints, Vec place) {
    float left = 1;
    for (const Vec& joint : joints) {
        const Vec d = joint - place;
        const float r2 = dot(d, d);
        if (r2 >= 1) continue;
        const float hidden = d.z / std::sqrt(r2 + 1e-6f) * 0.022f / (r2 + 0.004f) * (1 - r2);
        if (hidden > 0) left *= 1 - std::min(hidden, 0.85f);
    }
    return left;
}

}  // namespace

bool View::operator==(const View& o) const {
    return width == o.width && height == o.height && fx == o.fx && fy == o.fy && cx == o.cx && cy == o.cy &&
           std::equal(r, r + 9, o.r) && std::equal(t, t + 3, o.t);
}

Layers draw_room(const Room& room, const View& view, int samples) {
    const size_t pixels = size_t(view.width) * view.height;
    Layers out;
    out.view = view, out.samples = samples;
    out.direct.assign(3 * pixels, 0), out.ambient.assign(3 * pixels, 0), out.surface.assign(4 * pixels, 0);
    const int width = view.width * samples;
    std::vector<float> depth(pixels * samples * samples, kFar);
    Buffer<Hit> hits(depth.size());
    Buffer<float> density(room.triangles);
    std::fill_n(hits.data(), hits.size(), Hit{-1, 0, 0});
    size_t last = room.triangles;
    fill_room(room, view, samples, depth.data(), [&](const Triangle& t, size_t f, size_t i, float, float w1, float w2) {
        const float* uv = room.uv + 6 * f;
        if (f != last) density[last = f] = texel_density(t, uv, uv + 2, uv + 4, room.texture);
        hits[i] = {int32_t(f), w1, w2};
        return true;
    });
    const float share = 1.f / (samples * samples);
    const int middle = samples / 2;
    for (size_t i = 0; i < depth.size(); ++i) {
        const Hit& hit = hits[i];
        if (hit.triangle < 0) continue;
        const size_t f = hit.triangle, y = i / width, x = i % width, pixel = y / samples * view.width + x / samples;
        const float w[3] = {1 - hit.w1 - hit.w2, hit.w1, hit.w2};
        float u = 0, v = 0, lamp = 0;
        Vec around = {0, 0, 0}, place = {0, 0, 0};
        for (int k = 0; k < 3; ++k) {
            u += w[k] * room.uv[6 * f + 2 * k], v += w[k] * room.uv[6 * f + 2 * k + 1];
            lamp += w[k] * room.direct[3 * f + k];
            around = around + w[k] * vec(room.ambient + 9 * f + 3 * k);
            place = place + w[k] * vec(room.corners + 9 * f + 3 * k);
        }
        const Vec texel = sample(room.texture, room.layer[f], level_of(density[f], depth[i]), u, v);
        const float* tint = room.tint + 3 * f;
        const float albedo[3] = {texel.x * tint[0], texel.y * tint[1], texel.z * tint[2]}, a[3] = {around.x, around.y, around.z};
        for (int k = 0; k < 3; ++k) {
            out.direct[3 * pixel + k] += share * albedo[k] * lamp;
            out.ambient[3 * pixel + k] += share * albedo[k] * a[k];
        }
        if (int(x % samples) == middle && int(y % samples) == middle) {
            float* surface = &out.surface[4 * pixel];
            surface[0] = place.x, surface[1] = place.y, surface[2] = place.z, surface[3] = room.normals[3 * f + 2];
        }
    }
    if (samples == kSamples) {
        out.depth.swap(depth);
    } else {
        out.depth.assign(pixels * kSamples * kSamples, kFar);
        fill_room(room, view, kSamples, out.depth.data(), [](const Triangle&, size_t, size_t, float, float, float) { return true; });
    }
    return out;
}

void draw_person(const Person& person, const Light& light, const Layers& room, const Pose& pose, bool shadows, float* image) {
    const View& view = room.view;
    const int width = view.width * kSamples, height = view.height * kSamples;
    Buffer<Vec> vertices(person.vertices), normals(person.vertices);
    skin(person, pose, vertices.data(), normals.data());
    const ShadowMap shadow(light, person, vertices.data());

    Buffer<Point> seen(person.vertices);
    for (size_t v = 0; v < person.vertices; ++v) seen[v] = project(view, vertices[v], kSamples);
    Buffer<float> depth(room.depth.size()), density(person.triangles);
    std::copy(room.depth.begin(), room.depth.end(), depth.data());
    Buffer<Hit> hits(room.depth.size());
    std::fill_n(hits.data(), hits.size(), Hit{-1, 0, 0});
    const Texture& atlas = person.texture;
    for (size_t f = 0; f < person.triangles; ++f) {
        const int32_t* c = person.faces + 3 * f;
        Triangle t;
        if (!set_up(seen[c[0]], seen[c[1]], seen[c[2]], width, height, t)) continue;
        const float *a = person.uv + 2 * c[0], *b = person.uv + 2 * c[1], *d = person.uv + 2 * c[2];
        density[f] = texel_density(t, a, b, d, atlas);
        fill(t, width, depth.data(), [&](size_t i, float, float w1, float w2) {
            if (person.cutout[f]) {
                const float u = a[0] + w1 * (b[0] - a[0]) + w2 * (d[0] - a[0]);
                const float v = a[1] + w1 * (b[1] - a[1]) + w2 * (d[1] - a[1]);
                const int x = std::min(atlas.width - 1, std::max(0, int(u * atlas.width)));
                const int y = std::min(atlas.height - 1, std::max(0, int(v * atlas.height)));
                if (person.alpha[size_t(y) * atlas.width + x] < kOpaque) return false;
            }
            hits[i] = {int32_t(f), w1, w2};
            return true;
        });
    }

    std::vector<Vec> joints;
    for (size_t k = 0; k < person.contacts; ++k) {
        const size_t joint = person.contact[k];
        joints.push_back(apply(pose.bones + 16 * joint, vec(person.rest_joints + 3 * joint)));
    }
    const Vec eye = optical_centre(view);
    constexpr float share = 1.f / (kSamples * kSamples);
    for (int row = 0; row < view.height; ++row)
        for (int column = 0; column < view.width; ++column) {
            const size_t pixel = size_t(row) * view.width + column;
            Vec sum = {0, 0, 0};
            int covered = 0;
            for (int k = 0; k < kSamples * kSamples; ++k) {
                const size_t i = size_t(row * kSamples + k / kSamples) * width + column * kSamples + k % kSamples;
                const Hit& hit = hits[i];
                if (hit.triangle < 0) continue;
                ++covered;
                const int32_t* c = person.faces + 3 * size_t(hit.triangle);
                const float w[3] = {1 - hit.w1 - hit.w2, hit.w1, hit.w2};
                Vec place = {0, 0, 0}, normal = {0, 0, 0};
                float u = 0, v = 0;
                for (int corner = 0; corner < 3; ++corner) {
                    place = place + w[corner] * vertices[c[corner]];
                    normal = normal + w[corner] * normals[c[corner]];
                    u += w[corner] * person.uv[2 * c[corner]], v += w[corner] * person.uv[2 * c[corner] + 1];
                }
                const Vec albedo = sample(atlas, 0, level_of(density[hit.triangle], depth[i]), u, v);
                sum = sum + share * shade(light, shadow, albedo, place, normal, eye);
            }
            if (covered < kSamples * kSamples) {
                const float* surface = &room.surface[4 * pixel];
                float lamp = 1, around = 1;
                if (shadows) {
                    const Vec place = vec(surface);
                    lamp = shadow.lit(place);
                    if (surface[3] > kFloorUp && place.z < kFloorHeight) around = contact(joints, place);
                }
                const float rest = 1 - share * covered;
                sum = sum + rest * (lamp * vec(&room.direct[3 * pixel]) + around * vec(&room.ambient[3 * pixel]));
            }
            float* out = image + 4 * pixel;
            out[0] = sum.x, out[1] = sum.y, out[2] = sum.z, out[3] = share * covered;
        }
}

}  // namespace evsplat::zbuffer
