// One step of a piece of an event sensor, compiled once per SIMD level (see sensor_kernels.h).

#include "kernels.h"

namespace evsplat {
namespace EVSPLAT_LEVEL {
namespace {

#include "simd.h"

constexpr float kLog2e = 1.44269504f, kTwoPi = 6.28318531f;
constexpr float kBrightShare = 0.25f;  // of the shot noise in the dark, at full scale (v2e)
constexpr double kMicro = 1e-6;

// Natural logarithm of positive, normal numbers, 1e-7 relative (Cephes' logf).
INLINE F log(F x) {
    I e = ((I)x >> 23) - 126;
    F m = (F)(((I)x & 0x007fffff) | 0x3f000000);  // [0.5, 1)
    const I low = m < 0.70710678f;
    e += low;
    m = m + select(low, m, F{}) - 1.f;
    const F z = m * m;
    F p = splat(7.0376836292e-2f);
    p = p * m - 1.1514610310e-1f;
    p = p * m + 1.1676998740e-1f;
    p = p * m - 1.2420140846e-1f;
    p = p * m + 1.4249322787e-1f;
    p = p * m - 1.6668057665e-1f;
    p = p * m + 2.0000714765e-1f;
    p = p * m - 2.4999993993e-1f;
    p = p * m + 3.3333331174e-1f;
    const F n = __builtin_convertvector(e, F);
    return (m * z * p - n * 2.12194440e-4f - 0.5f * z + m) + n * 0.693359375f;
}

// Shares of a first-order low-pass over a step of `a` time constants whose input is linear in time:
// the output moves by (input0 - output0) * reach + (input1 - input0) * follow.
struct Response {
    F reach, follow;  // 1 - e^-a and 1 - (1 - e^-a) / a
};

INLINE Response response(F a) {
    // The closed form loses its digits where the step is short.
    const F series =
        a * (0.5f - a * (1.f / 6.f - a * (1.f / 24.f - a * (1.f / 120.f - a * (1.f / 720.f)))));
    const F reach = 1.f - exp2(-a * kLog2e);
    const I is_short = a < 0.25f;
    return {select(is_short, a * (1.f - series), reach), select(is_short, series, 1.f - reach / a)};
}

struct Pixel {
    const SensorPiece& piece;
    uint32_t index;

    void send(double at_us, bool brighter) const {
        double* last = piece.state->last_us;
        if (last) {
            const double now = piece.start_us + at_us;
            if (now - last[index] < piece.model->refractory_us) return;
            last[index] = now;
        }
        List<RawEvent>& list = *piece.events;
        if (list.size == list.capacity) list.grow(list);
        list.data[list.size++] = {uint32_t(at_us), index * 2 + (brighter ? 1 : 0)};
    }

    double draw() const {
        return uniform_number(piece.model->seed, index, piece.state->draws[index]++);
    }
};

// The events of one pixel whose change goes from `before` to `after`, while `noise` noise events are to be
// expected and `hazard` were to be expected until the next.
INLINE void send_events(const SensorPiece& piece, uint32_t index, float before, float after, double hazard,
                        double noise) {
    const PixelState& s = *piece.state;
    const Pixel pixel = {piece, index};
    const double duration = piece.duration_us, moved = double(after) - before;
    const bool brighter = after > 0.f;
    const double threshold = brighter ? s.on[index] : -s.off[index];
    const double count = __builtin_floor(after / threshold);
    const auto crossing = [&](double k) {
        const double share = moved != 0.0 ? (k * threshold - before) / moved : 0.0;
        return share < 0.0 ? 0.0 : share > 1.0 ? duration : share * duration;
    };
    double k = 1.0;
    if (noise > 0.f) {
        double used = 0.0;
        while (hazard <= noise - used) {
            used += hazard;
            const double at = used / noise * duration;
            for (; k <= count && crossing(k) <= at; k += 1.0) pixel.send(crossing(k), brighter);
            pixel.send(at, pixel.draw() < 0.5);
            hazard = -__builtin_log(pixel.draw());
        }
        s.hazard[index] = float(hazard - (noise - used));
    }
    for (; k <= count; k += 1.0) pixel.send(crossing(k), brighter);
    s.change[index] = float(after - count * threshold);
}

// sum + x with the digits that the sum has no room for carried in `rest` (Kahan): a step may be worth less
// than half a unit in the last place.
INLINE F add(F sum, F x, F& rest) {
    const F owed = x - rest, result = sum + owed;
    rest = (result - sum) - owed;
    return result;
}

template <bool filtered, bool leaking, bool noisy>
INLINE void step_piece(const SensorPiece& piece) {
    const SensorModel& model = *piece.model;
    const PixelState& s = *piece.state;
    const float seconds = float(piece.duration_us * kMicro);
    const float turns = kTwoPi * model.cutoff_hz * seconds, dark_noise = model.shot_hz * seconds;
    for (uint32_t i = piece.begin; i < piece.end; i += W) {
        const uint32_t left = piece.end - i, lanes = left < uint32_t(W) ? left : uint32_t(W);
        const F luma = max(load_some(piece.luma + i, lanes, 1.f), F{});
        F input;
        if (model.lin_log) {
            const F scaled = luma * 255.f;
            input = select(scaled <= kLinLogKnee, scaled * 0.149786614f, log(max(scaled, splat(1.f))));
        } else {
            input = log(luma + model.eps);
        }
        if (piece.first) {
            store(s.signal + i, input);
            if (filtered) store(s.input + i, input);
            continue;
        }
        const F bounded = min(luma, splat(1.f));
        F signal = input;
        const F signal_before = load(s.signal + i);
        if (filtered) {
            const F input_before = load(s.input + i);
            const Response r = response(turns * ((255.f * bounded + 20.f) / 275.f));
            signal = signal_before + (input_before - signal_before) * r.reach + (input - input_before) * r.follow;
            store(s.input + i, input);
        }
        store(s.signal + i, signal);
        const F before = load(s.change + i);
        F after = signal - signal_before;
        if (leaking) {
            F rest = load(s.change_rest + i);
            after = add(before, after + load(s.leak + i) * seconds, rest);
            store(s.change_rest + i, rest);
        } else {
            after += before;
        }
        store(s.change + i, after);
        I busy = (after >= load(s.on + i)) | (after <= -load(s.off + i));
        F noise = F{}, hazard = F{};
        if (noisy) {
            noise = dark_noise * (1.f - (1.f - kBrightShare) * bounded);
            if (s.hot_hz) noise += load(s.hot_hz + i) * seconds;
            hazard = load(s.hazard + i);
            busy |= hazard <= noise;
            F rest = load(s.hazard_rest + i);
            store(s.hazard + i, add(hazard, -noise, rest));
            store(s.hazard_rest + i, rest);
        }
        uint64_t todo = bits(busy) & (lanes == uint32_t(W) ? ~uint64_t(0) : (uint64_t(1) << lanes) - 1);
        for (; todo; todo &= todo - 1) {
            const int l = __builtin_ctzll(todo);
            send_events(piece, i + l, before[l], after[l], hazard[l], noise[l]);
        }
    }
}

}  // namespace

void sensor_step(const SensorPiece& piece) {
    const PixelState& s = *piece.state;
    const int kind = (s.input ? 4 : 0) + (s.leak ? 2 : 0) + (s.hazard ? 1 : 0);
    switch (kind) {
        case 0: step_piece<false, false, false>(piece); break;
        case 1: step_piece<false, false, true>(piece); break;
        case 2: step_piece<false, true, false>(piece); break;
        case 3: step_piece<false, true, true>(piece); break;
        case 4: step_piece<true, false, false>(piece); break;
        case 5: step_piece<true, false, true>(piece); break;
        case 6: step_piece<true, true, false>(piece); break;
        default: step_piece<true, true, true>(piece);
    }
}

}  // namespace EVSPLAT_LEVEL
}  // namespace evsplat
