#include "geometry.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <vector>

namespace evsplat {

struct Point {
    double x, y;
};

static size_t within(double place, size_t size) { return size_t(std::min(std::max(0.0, place), double(size))); }

void fill_triangles(const Triangles& t, uint8_t* mask, size_t height, size_t width) {
    for (size_t i = 0; i < t.count; ++i) {
        const int64_t* corner = t.corners + 3 * i;
        if (!t.in_front[corner[0]] || !t.in_front[corner[1]] || !t.in_front[corner[2]]) continue;
        Point p[3];
        for (int k = 0; k < 3; ++k) p[k] = {t.pixels[2 * corner[k]], t.pixels[2 * corner[k] + 1]};
        const double area = (p[1].x - p[0].x) * (p[2].y - p[0].y) - (p[1].y - p[0].y) * (p[2].x - p[0].x);
        if (!(area < 0 || area > 0)) continue;
        const double sign = area < 0 ? -1 : 1;
        // First and one-past-last pixel whose centre (index + 0.5) can lie inside.
        const auto [left, right] = std::minmax({p[0].x, p[1].x, p[2].x});
        const auto [top, bottom] = std::minmax({p[0].y, p[1].y, p[2].y});
        const size_t x0 = within(std::ceil(left - 0.5), width), x1 = within(std::floor(right - 0.5) + 1, width);
        const size_t y0 = within(std::ceil(top - 0.5), height), y1 = within(std::floor(bottom - 0.5) + 1, height);
        for (size_t y = y0; y < y1; ++y) {
            double along_y[3];
            for (int k = 0; k < 3; ++k) along_y[k] = (p[(k + 1) % 3].x - p[k].x) * (double(y) + 0.5 - p[k].y);
            for (size_t x = x0; x < x1; ++x) {
                bool inside = true;
                for (int k = 0; k < 3; ++k) {
                    const double along_x = (p[(k + 1) % 3].y - p[k].y) * (double(x) + 0.5 - p[k].x);
                    inside &= sign * (along_y[k] - along_x) >= 0;
                }
                if (inside) mask[y * width + x] = 1;
            }
        }
    }
}

void spread_points(const float* points, size_t count, int64_t* chosen, size_t wanted) {
    // axis by axis, for vectors of the compiler
    std::vector<float> x(count), y(count), z(count), away(count, std::numeric_limits<float>::infinity());
    for (size_t i = 0; i < count; ++i) x[i] = points[3 * i], y[i] = points[3 * i + 1], z[i] = points[3 * i + 2];
    size_t last = 0;
    for (size_t k = 0; k < wanted; ++k) {
        chosen[k] = int64_t(last);
        const float a = x[last], b = y[last], c = z[last];
        for (size_t i = 0; i < count; ++i) {
            const float dx = x[i] - a, dy = y[i] - b, dz = z[i] - c;
            const float apart = dx * dx + dy * dy + dz * dz;
            away[i] = apart < away[i] ? apart : away[i];
        }
        float most = away[0];
        for (size_t i = 1; i < count; ++i) most = away[i] > most ? away[i] : most;
        last = size_t(std::find(away.begin(), away.end(), most) - away.begin());
        if (last == count) last = 0;  // not a number
    }
}

struct Turned {
    float n[3];
    float length;
};

static Turned turned(const float* m, const float* normal) {
    float t[3];
    for (int i = 0; i < 3; ++i) t[i] = m[3 * i] * normal[0] + m[3 * i + 1] * normal[1] + m[3 * i + 2] * normal[2];
    const float length = std::max(std::sqrt(t[0] * t[0] + t[1] * t[1] + t[2] * t[2]), 1e-12f);
    return {{t[0] / length, t[1] / length, t[2] / length}, length};
}

static void harmonics(const float* n, float* h) {
    const float x = n[0], y = n[1], z = n[2];
    h[0] = x, h[1] = y, h[2] = z, h[3] = x * y, h[4] = y * z, h[5] = x * z, h[6] = x * x - y * y, h[7] = 3 * z * z - 1;
}

void shade_normals(const TurnedNormals& s, float* brightness) {
    for (size_t i = 0; i < s.times * s.count; ++i) {
        float h[8], sum = 1;
        harmonics(turned(s.linear + 9 * i, s.normals + 3 * (i % s.count)).n, h);
        for (int k = 0; k < 8; ++k) sum += s.light[k] * h[k];
        brightness[i] = sum;
    }
}

void shade_normals_backward(const TurnedNormals& s, const float* above, float* by_linear, float* by_light) {
    double sums[8] = {};
    const float* l = s.light;
    for (size_t i = 0; i < s.times * s.count; ++i) {
        const float* normal = s.normals + 3 * (i % s.count);
        const Turned t = turned(s.linear + 9 * i, normal);
        float h[8];
        harmonics(t.n, h);
        for (int k = 0; k < 8; ++k) sums[k] += above[i] * h[k];
        if (!by_linear) continue;
        const float x = t.n[0], y = t.n[1], z = t.n[2];
        const float by[3] = {l[0] + l[3] * y + l[5] * z + 2 * l[6] * x, l[1] + l[3] * x + l[4] * z - 2 * l[6] * y,
                             l[2] + l[4] * y + l[5] * x + 6 * l[7] * z};
        // Only what turns a normal: its length is 1 again. One of no length has no direction to lose.
        const float along = t.length > 1e-12f ? x * by[0] + y * by[1] + z * by[2] : 0;
        const float scale = above[i] / t.length;
        for (int j = 0; j < 3; ++j) {
            const float by_turned = scale * (by[j] - along * t.n[j]);
            for (int k = 0; k < 3; ++k) by_linear[9 * i + 3 * j + k] = by_turned * normal[k];
        }
    }
    for (int k = 0; k < 8; ++k) by_light[k] = float(sums[k]);
}

}  // namespace evsplat
