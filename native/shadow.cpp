#include "shadow.h"

#include <algorithm>
#include <cmath>
#include <vector>

#include "buffer.h"
#include "levels.h"
#include "thread_pool.h"

namespace evsplat {
namespace {

constexpr size_t kPlaces = 16384;  // of a piece; fixes the order of sums over places
constexpr size_t kOwnPlaces = 65536;

size_t pieces_of(const ShadowPlaces& places, size_t size) {
    return std::max<size_t>(1, (places.count + size - 1) / size);
}

struct Vector {
    double v[3] = {};
    double& operator[](int i) { return v[i]; }
    double operator[](int i) const { return v[i]; }
};

double dot(const Vector& a, const Vector& b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }

Vector middle_of(const Shadow& s, size_t time) {
    Vector sum;
    for (size_t i = 0; i < 3 * s.points; ++i) sum[int(i % 3)] += s.body[time * s.points * 3 + i];
    for (double& v : sum.v) v /= double(s.points);
    return sum;
}

// Two unit vectors at right angles to `axis` and each other (Duff et al. 2017, JCGT 6).
struct Across {
    double sign, a, b;
    Vector first, second;

    explicit Across(const Vector& axis) {
        const double x = axis[0], y = axis[1], z = axis[2];
        sign = std::copysign(1.0, z), a = -1 / (sign + z), b = x * y * a;
        first = {{1 + sign * x * x * a, sign * b, -sign * x}};
        second = {{b, sign + y * y * a, -y}};
    }

    // The gradient of the axis.
    Vector backward(const Vector& axis, const Vector& by_first, const Vector& by_second) const {
        const double x = axis[0], y = axis[1];
        const double by_b = by_first[1] * sign + by_second[0];
        const double by_a = by_first[0] * sign * x * x + by_second[1] * y * y + by_b * x * y;
        return {{by_first[0] * sign * 2 * x * a - by_first[2] * sign + by_b * y * a,
                 by_second[1] * 2 * y * a - by_second[2] + by_b * x * a, by_a * a * a}};
    }
};

struct View {
    Vector middle, axis;
    double distance;

    View(const Vector& middle, const float* lamp) : middle(middle) {
        for (int r = 0; r < 3; ++r) axis[r] = middle[r] - lamp[r];
        distance = std::sqrt(dot(axis, axis));
        for (double& v : axis.v) v /= distance;
    }

    LampView plain() const {
        LampView view = {};
        const Across across(axis);
        for (int r = 0; r < 3; ++r) {
            view.middle[r] = float(middle[r]), view.axis[r] = float(axis[r]);
            view.across[0][r] = float(across.first[r]), view.across[1][r] = float(across.second[r]);
        }
        view.distance = float(distance);
        return view;
    }

    // From a view's sums to the gradients of middle and lamp.
    void backward(const double* sums, Vector& by_middle, Vector& by_lamp) const {
        const auto three = [&](int at) { return Vector{{sums[at], sums[at + 1], sums[at + 2]}}; };
        const Across across(axis);
        Vector by_axis = across.backward(axis, three(kByU), three(kByV));
        for (int r = 0; r < 3; ++r) by_axis[r] += sums[kByB + r];
        const double along = dot(by_axis, axis);
        for (int r = 0; r < 3; ++r) {
            const double ray = (by_axis[r] - along * axis[r]) / distance + sums[kDistance] * axis[r];
            by_lamp[r] = -ray;
            by_middle[r] = ray - sums[kU] * across.first[r] - sums[kV] * across.second[r] - sums[kB] * axis[r];
        }
    }
};

// All lamps' views, (lamps, times).
struct Views {
    std::vector<View> exact;
    std::vector<LampView> plain;

    explicit Views(const Shadow& s) {
        std::vector<Vector> middles;
        for (size_t t = 0; t < s.times; ++t) middles.push_back(middle_of(s, t));
        for (int l = 0; l < s.lamps; ++l)
            for (size_t t = 0; t < s.times; ++t) {
                exact.emplace_back(middles[t], s.lamp + 3 * l);
                plain.push_back(exact.back().plain());
            }
    }
};

ShadowSplat splat_of(const Shadow& s, const Views& views, int lamp, size_t time) {
    return {views.plain[lamp * s.times + time], s.body + time * s.points * 3, s.points, s.width[lamp], s.strength,
            s.layered};
}

// Lamps [first, first + count) at one time, for the kernels.
struct Looks {
    std::vector<LampView> views;
    std::vector<const float*> grids;
    ShadowLook look;

    Looks(const Shadow& s, const ShadowPlaces& places, const Views& all, const float* from, int first, int count,
          size_t time) {
        for (int l = first; l < first + count; ++l) {
            views.push_back(all.plain[l * s.times + time]);
            grids.push_back(from + (l * s.times + time) * s.grid());
        }
        const float* at = places.at + (s.layered ? time * places.count * 3 : 0);
        look = {count, views.data(), grids.data(), places.share, at};
    }
};

}  // namespace

void cast_shadow(const Shadow& s, const ShadowPlaces& places, int threads, float* grids, float* result) {
    const Kernels& kernels = select_kernels();
    const Views views(s);
    run(threads, s.lamps * s.times, [&](size_t task) {
        const ShadowSplat splat = splat_of(s, views, int(task / s.times), task % s.times);
        kernels.shadow_splat(splat, grids + task * s.grid());
    });
    const size_t pieces = pieces_of(places, kPlaces);
    const size_t pictures = s.layered ? s.lamps * s.times : s.times;
    run(threads, pictures * pieces, [&](size_t task) {
        const size_t picture = task / pieces, begin = task % pieces * kPlaces;
        const size_t end = std::min(places.count, begin + kPlaces);
        float* to = result + picture * places.count;
        if (s.layered) {
            const Looks looks(s, places, views, grids, int(picture / s.times), 1, picture % s.times);
            kernels.shadow_on_body(looks.look, begin, end, to);
        } else {
            const Looks looks(s, places, views, grids, 0, s.lamps, picture);
            kernels.shadow_on_scene(looks.look, begin, end, to);
        }
    });
}

void cast_shadow_backward(const Shadow& s, const ShadowPlaces& places, const float* grids, const float* above,
                          int threads, const ShadowGrads& grads) {
    const Kernels& kernels = select_kernels();
    const Views views(s);
    const size_t size = s.layered ? kOwnPlaces : kPlaces, pieces = pieces_of(places, size);
    const size_t lamps = s.lamps, slots = lamps * s.times;
    // Of each lamp, time and piece.
    Buffer<float> grid_parts(slots * pieces * s.grid()), sum_parts(slots * pieces * kViewSums);
    Buffer<float> share_parts(slots * pieces);
    Buffer<float> place_parts(grads.places ? s.times * places.count * 3 : 0);
    const auto slot = [&](size_t lamp, size_t time, size_t piece) { return (lamp * s.times + time) * pieces + piece; };
    run(threads, (s.layered ? slots : s.times) * pieces, [&](size_t task) {
        const size_t piece = task % pieces, begin = piece * size, end = std::min(places.count, begin + size);
        const size_t picture = task / pieces, time = picture % s.times;
        const size_t first = s.layered ? picture / s.times : 0, count = s.layered ? 1 : lamps;
        std::vector<float*> to;
        for (size_t l = first; l < first + count; ++l) {
            to.push_back(grid_parts.data() + slot(l, time, piece) * s.grid());
            std::fill_n(to.back(), s.grid(), 0.f);
        }
        const Looks looks(s, places, views, grids, int(first), int(count), time);
        if (s.layered) {
            kernels.shadow_on_body_backward(looks.look, begin, end, above + picture * places.count, to[0],
                                            sum_parts.data() + slot(first, time, piece) * kViewSums);
            return;
        }
        float sums[kMaxLamps * kViewSums], share[kMaxLamps];
        float* by_place = grads.places ? place_parts.data() + time * places.count * 3 : nullptr;
        kernels.shadow_on_scene_backward(looks.look, begin, end, above + time * places.count, to.data(), sums, share,
                                         by_place);
        for (size_t l = 0; l < count; ++l) {
            share_parts[slot(l, time, piece)] = share[l];
            std::copy_n(sums + l * kViewSums, kViewSums, sum_parts.data() + slot(l, time, piece) * kViewSums);
        }
    });

    for (size_t i = 0; grads.places && i < places.count * 3; ++i) {
        grads.places[i] = place_parts.data()[i];
        for (size_t t = 1; t < s.times; ++t) grads.places[i] += place_parts.data()[t * places.count * 3 + i];
    }
    struct Totals {
        double lamp[3] = {}, width = 0;
    };
    std::vector<Totals> totals(slots);
    run(threads, s.times, [&](size_t time) {
        float* body = grads.body ? grads.body + time * s.points * 3 : nullptr;
        if (body) std::fill_n(body, s.points * 3, 0.f);
        Vector by_middle;
        for (size_t l = 0; l < lamps; ++l) {
            float* grid = grid_parts.data() + slot(l, time, 0) * s.grid();
            double sums[kViewSums] = {};
            for (size_t piece = 0; piece < pieces; ++piece) {
                const float* more = sum_parts.data() + slot(l, time, piece) * kViewSums;
                for (int k = 0; k < kViewSums; ++k) sums[k] += more[k];
                const float* cells = grid + piece * s.grid();
                if (piece)
                    for (size_t i = 0; i < s.grid(); ++i) grid[i] += cells[i];
            }
            Totals& total = totals[l * s.times + time];
            kernels.shadow_splat_backward(splat_of(s, views, int(l), time), grid, {body, sums, &total.width});
            Vector middle, lamp;
            views.exact[l * s.times + time].backward(sums, middle, lamp);
            for (int r = 0; r < 3; ++r) by_middle[r] += middle[r], total.lamp[r] = lamp[r];
        }
        if (body)
            for (size_t i = 0; i < 3 * s.points; ++i) body[i] += float(by_middle[int(i % 3)] / double(s.points));
    });
    for (size_t l = 0; l < lamps; ++l) {
        Totals sum;
        double share = 0;
        for (size_t t = 0; t < s.times; ++t) {
            const Totals& total = totals[l * s.times + t];
            for (int r = 0; r < 3; ++r) sum.lamp[r] += total.lamp[r];
            sum.width += total.width;
            for (size_t piece = 0; piece < pieces && grads.share; ++piece) share += share_parts[slot(l, t, piece)];
        }
        for (int r = 0; r < 3; ++r) grads.lamp[3 * l + r] = float(sum.lamp[r]);
        grads.width[l] = float(sum.width);
        if (grads.share) grads.share[l] = float(share);
    }
}

}  // namespace evsplat
