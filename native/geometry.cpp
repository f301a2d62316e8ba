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

}  // namespace evsplat
