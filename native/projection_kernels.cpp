// Projection of Gaussians and its gradient for one SIMD level; compiled once per level (see kernels.cpp).

#include "kernels.h"

namespace evsplat {
namespace EVSPLAT_LEVEL {
namespace {

#include "simd.h"

constexpr float kMaxExtent = 3.33f;         // standard deviations
constexpr float kHalfLog2e = 0.72134752f;   // exp(-s/2) = exp2(-kHalfLog2e s)
constexpr float kMaxPixel = 1e6f;           // farther than this from the image is not drawn

// Everything that both directions of the projection of W Gaussians need.
struct Projection {
    F px, py, pz;                  // mean in the world
    F x, y, z, rz, xn, yn;         // mean in the camera; 1/z, x/z, y/z
    F j00, j02, j11, j12;          // Jacobian of the projection
    I inside_x, inside_y;          // the Jacobian's angle is not clamped
    F a[2][3], b[2][3], br[2][3];  // J Rv, J Rv linear, J Rv linear R
    F lin[3][3], rot[3][3], s[3];
    F qw, qx, qy, qz, inv_norm;    // unit quaternion
    F m[2][3];                     // J Rv linear R S
    F cov_xx, cov_xy, cov_yy, det;
};

struct Limits { float x_lo, x_hi, y_lo, y_hi; };

// gsplat clamps the angle in the Jacobian to the field of view enlarged by 30 % of its half width.
INLINE Limits limits(const View& view) {
    const float mx = 0.15f * view.width / view.fx, my = 0.15f * view.height / view.fy;
    return {-view.cx / view.fx - mx, (view.width - view.cx) / view.fx + mx,
            -view.cy / view.fy - my, (view.height - view.cy) / view.fy + my};
}

INLINE void project_lanes(const View& view, const Gaussians& g, uint32_t i, uint32_t n, Projection& p) {
    const float* r = view.r;
    const float* mean = g.means + 3 * size_t(i);
    p.px = gather<3>(mean, n), p.py = gather<3>(mean + 1, n), p.pz = gather<3>(mean + 2, n);
    p.x = r[0] * p.px + r[1] * p.py + r[2] * p.pz + view.t[0];
    p.y = r[3] * p.px + r[4] * p.py + r[5] * p.pz + view.t[1];
    p.z = r[6] * p.px + r[7] * p.py + r[8] * p.pz + view.t[2];
    p.rz = 1.f / p.z;
    p.xn = p.x * p.rz, p.yn = p.y * p.rz;

    const Limits lim = limits(view);
    const F cx = min(max(p.xn, splat(lim.x_lo)), splat(lim.x_hi));
    const F cy = min(max(p.yn, splat(lim.y_lo)), splat(lim.y_hi));
    p.inside_x = cx == p.xn, p.inside_y = cy == p.yn;
    p.j00 = view.fx * p.rz, p.j11 = view.fy * p.rz;
    p.j02 = -p.j00 * cx, p.j12 = -p.j11 * cy;
    for (int k = 0; k < 3; ++k) {
        p.a[0][k] = p.j00 * r[k] + p.j02 * r[6 + k];
        p.a[1][k] = p.j11 * r[3 + k] + p.j12 * r[6 + k];
    }
    if (g.linear) {
        const float* linear = g.linear + 9 * size_t(i);
        for (int k = 0; k < 9; ++k) p.lin[k / 3][k % 3] = gather<9>(linear + k, n);
        for (int o = 0; o < 2; ++o)
            for (int k = 0; k < 3; ++k)
                p.b[o][k] = p.a[o][0] * p.lin[0][k] + p.a[o][1] * p.lin[1][k] + p.a[o][2] * p.lin[2][k];
    } else {
        for (int o = 0; o < 2; ++o)
            for (int k = 0; k < 3; ++k) p.b[o][k] = p.a[o][k];
    }

    const float* quat = g.quaternions + 4 * size_t(i);
    F qw = gather<4>(quat, n), qx = gather<4>(quat + 1, n), qy = gather<4>(quat + 2, n), qz = gather<4>(quat + 3, n);
    p.inv_norm = 1.f / sqrt(qw * qw + qx * qx + qy * qy + qz * qz);
    p.qw = qw *= p.inv_norm, p.qx = qx *= p.inv_norm, p.qy = qy *= p.inv_norm, p.qz = qz *= p.inv_norm;
    p.rot[0][0] = 1.f - 2.f * (qy * qy + qz * qz);
    p.rot[0][1] = 2.f * (qx * qy - qw * qz);
    p.rot[0][2] = 2.f * (qx * qz + qw * qy);
    p.rot[1][0] = 2.f * (qx * qy + qw * qz);
    p.rot[1][1] = 1.f - 2.f * (qx * qx + qz * qz);
    p.rot[1][2] = 2.f * (qy * qz - qw * qx);
    p.rot[2][0] = 2.f * (qx * qz - qw * qy);
    p.rot[2][1] = 2.f * (qy * qz + qw * qx);
    p.rot[2][2] = 1.f - 2.f * (qx * qx + qy * qy);
    const float* scale = g.scales + 3 * size_t(i);
    for (int k = 0; k < 3; ++k) {
        p.s[k] = gather<3>(scale + k, n);
        for (int o = 0; o < 2; ++o) {
            p.br[o][k] = p.b[o][0] * p.rot[0][k] + p.b[o][1] * p.rot[1][k] + p.b[o][2] * p.rot[2][k];
            p.m[o][k] = p.br[o][k] * p.s[k];
        }
    }

    const F(&m)[2][3] = p.m;
    const F xx = m[0][0] * m[0][0] + m[0][1] * m[0][1] + m[0][2] * m[0][2];
    const F yy = m[1][0] * m[1][0] + m[1][1] * m[1][1] + m[1][2] * m[1][2];
    p.cov_xy = m[0][0] * m[1][0] + m[0][1] * m[1][1] + m[0][2] * m[1][2];
    p.cov_xx = xx + view.low_pass, p.cov_yy = yy + view.low_pass;
    // det(M M^T + eps I) from the minors of M: xx yy - xy^2 would cancel for long thin Gaussians.
    const F n01 = m[0][0] * m[1][1] - m[0][1] * m[1][0];
    const F n02 = m[0][0] * m[1][2] - m[0][2] * m[1][0];
    const F n12 = m[0][1] * m[1][2] - m[0][2] * m[1][1];
    p.det = n01 * n01 + n02 * n02 + n12 * n12 + view.low_pass * (xx + yy + view.low_pass);
}

// Which patches of the tile at (x0, y0) hold a pixel where u^2 + v^2 <= limit; exact up to rounding.
INLINE uint64_t patches_reached(const Projected& p, float kx, float ky, float x0, float y0, float limit) {
    const float left = x0 + 0.5f - p.x, top = y0 + 0.5f - p.y;
    uint64_t reached = 0;
    for (int first = 0; first < kPatches; first += W) {
        F xa, ya;
        for (int l = 0; l < W; ++l) {
            xa[l] = float((first + l) % kPatchesX * kPatchW);
            ya[l] = float((first + l) / kPatchesX * kPatchH);
        }
        xa += left, ya += top;
        const F xb = xa + float(kPatchW - 1), yb = ya + float(kPatchH - 1);
        // The least value over a rectangle lies on the vertical or the horizontal line through the
        // point of the rectangle that is nearest to the centre in that coordinate.
        const F xc = min(max(F{}, xa), xb), yc = min(max(F{}, ya), yb);
        const F xe = min(max(kx * yc, xa), xb), ye = min(max(ky * xc, ya), yb);
        const F u1 = p.l11 * xc + p.l12 * ye, v1 = p.l22 * ye;
        const F u2 = p.l11 * xe + p.l12 * yc, v2 = p.l22 * yc;
        const F least = min(u1 * u1 + v1 * v1, u2 * u2 + v2 * v2);
        reached |= bits_at_most(least, splat(limit)) << first;
    }
    return reached;
}

// The tile that holds a pixel, or the nearest of the image.
INLINE I tile_at(F pixel, int last) { return to_int(min(max(pixel * (1.f / kTile), F{}), splat(float(last)))); }

INLINE void scatter_add(float* p, int stride, uint32_t n, F v) {
    for (uint32_t l = 0; l < n; ++l) p[l * stride] += v[l];
}

}  // namespace

void project(const View& view, const Gaussians& g, uint32_t begin, uint32_t end, Projected* projected,
             int32_t* radii, uint32_t* first_slot, List<Slot>& slots) {
    for (uint32_t i = begin; i < end; i += W) {
        const uint32_t n = end - i < uint32_t(W) ? end - i : uint32_t(W);
        Projection p;
        project_lanes(view, g, i, n, p);
        F mx = view.fx * p.xn + view.cx, my = view.fy * p.yn + view.cy;
        if (g.offset) {
            mx += gather<2>(g.offset + 2 * size_t(i), n);
            my += gather<2>(g.offset + 2 * size_t(i) + 1, n);
        }
        const F opacity = gather<1>(g.opacities + i, n);
        const float s = __builtin_sqrtf(kHalfLog2e);
        const F l22 = s / sqrt(p.cov_yy);
        const F l11 = s * sqrt(p.cov_yy / p.det);
        const F kx = p.cov_xy / p.cov_yy, ky = p.cov_xy / p.cov_xx;
        const F l12 = -l11 * kx;
        const F sx = sqrt(p.cov_xx), sy = sqrt(p.cov_yy);
        const F log2_opacity = log2(opacity);
        const F limit = log2_opacity + 7.9943534f;  // log2(255)
        const F extent = sqrt(max(limit, F{}) / kHalfLog2e), drawn = min(extent, splat(kMaxExtent));
        const F rx = ceil(drawn * sx), ry = ceil(drawn * sy);
        // Comparisons are written so that NaN fails them and is not drawn.
        const I ok = (p.z >= view.near_plane) & (p.det > 0.f) & (opacity >= kMinAlpha) & (p.det < 1e30f) &
                     (mx > -kMaxPixel) & (mx < kMaxPixel) & (my > -kMaxPixel) & (my < kMaxPixel) &
                     (sx < kMaxPixel) & (sy < kMaxPixel) & (l11 < 1e6f) & (mx + rx > 0.f) &
                     (mx - rx < float(view.width)) & (my + ry > 0.f) & (my - ry < float(view.height));
        const I radius = ok & to_int(max(rx, ry));

        // Rounding must not cut a patch that the pixel test would keep; that test decides.
        const F ex = extent * sx * 1.001f + 0.51f, ey = extent * sy * 1.001f + 0.51f;
        const I tx0 = tile_at(mx - ex, view.tiles_x - 1), tx1 = tile_at(mx + ex, view.tiles_x - 1);
        const I ty0 = tile_at(my - ey, view.tiles_y - 1), ty1 = tile_at(my + ey, view.tiles_y - 1);
        __builtin_memcpy(radii + i, &radius, n * sizeof *radii);
        const uint64_t drawn_lanes = bits(ok);
        float x[W], y[W], a[W], b[W], c[W], o[W], z[W], fx[W], fy[W], slack[W];
        store(x, mx), store(y, my), store(a, l11), store(b, l12), store(c, l22), store(o, log2_opacity), store(z, p.z);
        store(fx, kx), store(fy, ky), store(slack, limit * 1.001f + 1e-3f);
        int32_t left[W], right[W], top[W], bottom[W];
        store_ints(left, tx0), store_ints(right, tx1), store_ints(top, ty0), store_ints(bottom, ty1);
        for (uint32_t l = 0; l < n; ++l) {
            const uint32_t gaussian = i + l;
            first_slot[gaussian] = uint32_t(slots.size);
            if (!(drawn_lanes >> l & 1)) continue;
            const Projected out = {x[l], y[l], a[l], b[l], c[l], o[l], z[l], 0.f};
            projected[gaussian] = out;
            const size_t most = slots.size + size_t(right[l] - left[l] + 1) * (bottom[l] - top[l] + 1);
            while (most > slots.capacity) slots.grow(slots);
            Slot* next = slots.data + slots.size;
            for (int ty = top[l]; ty <= bottom[l]; ++ty)
                for (int tx = left[l]; tx <= right[l]; ++tx) {
                    const uint64_t reached =
                        patches_reached(out, fx[l], fy[l], float(tx * kTile), float(ty * kTile), slack[l]);
                    // Written in any case, as a branch here would be guessed wrong half of the time.
                    *next = {uint32_t(ty * view.tiles_x + tx), gaussian, reached};
                    next += reached != 0;
                }
            slots.size = size_t(next - slots.data);
        }
    }
}

void project_backward(const View& view, const Gaussians& g, uint32_t begin, uint32_t end,
                      const Projected* projected, const uint32_t* first_slot, const float* slots,
                      int channels, const GaussianGrads& grads) {
    const int stride = slot_stride(channels);
    const float* r = view.r;
    F view_grad[12] = {};
    const bool geometry = grads.means || grads.quaternions || grads.scales || grads.opacities || grads.linear ||
                          grads.offset || grads.view;
    for (uint32_t i = begin; i < end; i += W) {
        const uint32_t n = end - i < uint32_t(W) ? end - i : uint32_t(W);
        if (first_slot[i] == first_slot[i + n]) continue;
        float moments[kMoments][W] = {};
        float factors[3][W] = {};
        for (uint32_t l = 0; l < n; ++l) {
            const uint32_t from = first_slot[i + l], to = first_slot[i + l + 1];
            if (from == to) continue;
            const float* slot = slots + size_t(from) * stride;
            F4 low = {}, high = {};
            for (uint32_t s = 0; s < to - from; ++s) {
                F4 a, b;
                __builtin_memcpy(&a, slot + size_t(s) * stride, sizeof a);
                __builtin_memcpy(&b, slot + size_t(s) * stride + 4, sizeof b);
                low += a, high += b;
            }
            for (int k = 0; k < 4; ++k) moments[k][l] = low[k];
            moments[4][l] = high[0], moments[5][l] = high[1];
            if (grads.values) {
                float* out = grads.values + size_t(i + l) * grads.value_stride;
                out[0] += high[2];
                if (channels > 1) out[1] += high[3];
                for (int k = 2; k < channels; ++k) {
                    float total = 0.f;
                    for (uint32_t s = 0; s < to - from; ++s) total += slot[size_t(s) * stride + kMoments + k];
                    out[k] += total;
                }
            }
            const Projected& q = projected[i + l];
            factors[0][l] = q.l11, factors[1][l] = q.l12, factors[2][l] = q.l22;
        }
        if (!geometry) continue;

        // Lanes without slots have zero moments but may hold NaN (behind the camera): they are
        // masked at the end.
        Projection p;
        project_lanes(view, g, i, n, p);
        const float inv_s2 = 1.f / kHalfLog2e;
        const F l11 = load(factors[0]), l12 = load(factors[1]), l22 = load(factors[2]);
        const F h0 = load(moments[0]), hu = load(moments[1]), hv = load(moments[2]);
        const F huu = load(moments[3]), huv = load(moments[4]), hvv = load(moments[5]);
        I drawn;
        for (int l = 0; l < W; ++l) drawn[l] = uint32_t(l) < n && first_slot[i + l] != first_slot[i + l + 1] ? -1 : 0;
        const F zero = F{};

        const F gx = l11 * hu * inv_s2, gy = (l12 * hu + l22 * hv) * inv_s2;
        if (grads.opacities)
            scatter_add(grads.opacities + i, 1, n, select(drawn, h0 / gather<1>(g.opacities + i, n), zero));
        if (grads.offset) {
            scatter_add(grads.offset + 2 * size_t(i), 2, n, select(drawn, gx, zero));
            scatter_add(grads.offset + 2 * size_t(i) + 1, 2, n, select(drawn, gy, zero));
        }

        // dL/dSigma = L^T W L / 2 with W the second moments of (u, v); every product is taken as
        // L times something bounded, so that thin Gaussians lose no digits.
        const F scale = splat(inv_s2 * inv_s2);
        F db_r[2][3], d_scale[3];
        for (int k = 0; k < 3; ++k) {
            const F ub = l11 * p.br[0][k] + l12 * p.br[1][k], vb = l22 * p.br[1][k];
            const F um = ub * p.s[k], vm = vb * p.s[k];
            const F yu = (huu * um + huv * vm) * scale, yv = (huv * um + hvv * vm) * scale;
            d_scale[k] = ub * yu + vb * yv;
            db_r[0][k] = l11 * yu * p.s[k];
            db_r[1][k] = (l12 * yu + l22 * yv) * p.s[k];
        }
        if (grads.scales)
            for (int k = 0; k < 3; ++k)
                scatter_add(grads.scales + 3 * size_t(i) + k, 3, n, select(drawn, d_scale[k], zero));

        if (grads.quaternions) {
            F d[3][3];
            for (int a = 0; a < 3; ++a)
                for (int k = 0; k < 3; ++k) d[a][k] = p.b[0][a] * db_r[0][k] + p.b[1][a] * db_r[1][k];
            const F w = p.qw, x = p.qx, y = p.qy, z = p.qz;
            F q[4];
            q[0] = 2.f * (x * (d[2][1] - d[1][2]) + y * (d[0][2] - d[2][0]) + z * (d[1][0] - d[0][1]));
            q[1] = 2.f * (-2.f * x * (d[1][1] + d[2][2]) + y * (d[1][0] + d[0][1]) + z * (d[2][0] + d[0][2]) +
                          w * (d[2][1] - d[1][2]));
            q[2] = 2.f * (x * (d[1][0] + d[0][1]) - 2.f * y * (d[0][0] + d[2][2]) + z * (d[2][1] + d[1][2]) +
                          w * (d[0][2] - d[2][0]));
            q[3] = 2.f * (x * (d[2][0] + d[0][2]) + y * (d[2][1] + d[1][2]) - 2.f * z * (d[0][0] + d[1][1]) +
                          w * (d[1][0] - d[0][1]));
            const F along = q[0] * w + q[1] * x + q[2] * y + q[3] * z;
            const F unit[4] = {w, x, y, z};
            for (int k = 0; k < 4; ++k)
                scatter_add(grads.quaternions + 4 * size_t(i) + k, 4, n,
                            select(drawn, (q[k] - along * unit[k]) * p.inv_norm, zero));
        }

        F db[2][3], da[2][3];
        for (int o = 0; o < 2; ++o)
            for (int k = 0; k < 3; ++k)
                db[o][k] = db_r[o][0] * p.rot[k][0] + db_r[o][1] * p.rot[k][1] + db_r[o][2] * p.rot[k][2];
        if (g.linear) {
            if (grads.linear)
                for (int a = 0; a < 3; ++a)
                    for (int k = 0; k < 3; ++k)
                        scatter_add(grads.linear + 9 * size_t(i) + 3 * a + k, 9, n,
                                    select(drawn, p.a[0][a] * db[0][k] + p.a[1][a] * db[1][k], zero));
            for (int o = 0; o < 2; ++o)
                for (int k = 0; k < 3; ++k)
                    da[o][k] = db[o][0] * p.lin[k][0] + db[o][1] * p.lin[k][1] + db[o][2] * p.lin[k][2];
        } else {
            for (int o = 0; o < 2; ++o)
                for (int k = 0; k < 3; ++k) da[o][k] = db[o][k];
        }
        if (!grads.means && !grads.view) continue;

        const F dj00 = da[0][0] * r[0] + da[0][1] * r[1] + da[0][2] * r[2];
        const F dj02 = da[0][0] * r[6] + da[0][1] * r[7] + da[0][2] * r[8];
        const F dj11 = da[1][0] * r[3] + da[1][1] * r[4] + da[1][2] * r[5];
        const F dj12 = da[1][0] * r[6] + da[1][1] * r[7] + da[1][2] * r[8];
        // With j00 = fx/z and j02 = -fx clamp(x/z)/z.
        const F dx_n = select(p.inside_x, -p.j00 * dj02, zero) + view.fx * gx;
        const F dy_n = select(p.inside_y, -p.j11 * dj12, zero) + view.fy * gy;
        const F dx = select(drawn, dx_n * p.rz, zero), dy = select(drawn, dy_n * p.rz, zero);
        const F dz = select(drawn,
                            -(dx_n * p.xn + dy_n * p.yn + p.j00 * dj00 + p.j02 * dj02 + p.j11 * dj11 +
                              p.j12 * dj12) * p.rz,
                            zero);
        if (grads.means)
            for (int k = 0; k < 3; ++k)
                scatter_add(grads.means + 3 * size_t(i) + k, 3, n, r[k] * dx + r[3 + k] * dy + r[6 + k] * dz);
        if (grads.view) {
            const F world[3] = {p.px, p.py, p.pz};
            for (int k = 0; k < 3; ++k) {
                view_grad[k] += select(drawn, dx * world[k] + p.j00 * da[0][k], zero);
                view_grad[3 + k] += select(drawn, dy * world[k] + p.j11 * da[1][k], zero);
                view_grad[6 + k] += select(drawn, dz * world[k] + p.j02 * da[0][k] + p.j12 * da[1][k], zero);
            }
            view_grad[9] += dx, view_grad[10] += dy, view_grad[11] += dz;
        }
    }
    if (grads.view)
        for (int k = 0; k < 12; ++k) grads.view[size_t(begin / kBlock) * 12 + k] = sum(view_grad[k]);
}

}  // namespace EVSPLAT_LEVEL
}  // namespace evsplat
