#include "sensor.h"

#include <algorithm>
#include <atomic>
#include <cmath>
#include <cstring>
#include <limits>
#include <utility>

#include "levels.h"
#include "thread_pool.h"

namespace evsplat {
namespace {

constexpr size_t kPiece = 8192;  // pixels; small enough to share the work evenly
constexpr int kDigitBits = 11;   // of the sort by time: one pass for a step of two milliseconds

bool all_finite(const float* values, size_t count) {
    constexpr uint32_t kExponent = 0x7f800000u;
    uint32_t bad = 0;
    for (size_t i = 0; i < count; ++i) {
        uint32_t pattern;
        std::memcpy(&pattern, values + i, sizeof pattern);
        bad |= (pattern & kExponent) == kExponent ? 1u : 0u;
    }
    return bad == 0;
}

// Where each value of one digit of the time starts in the sorted order.
class DigitSort {
  public:
    explicit DigitSort(int shift) : shift_(shift), next_(size_t(1) << kDigitBits) {}

    size_t digit(const RawEvent& e) const { return (e.offset_us >> shift_) & (next_.size() - 1); }
    void add(const RawEvent& e) { ++next_[digit(e)]; }
    void finish() {
        size_t before = 0;
        for (size_t& n : next_) before += std::exchange(n, before);
    }
    size_t place(const RawEvent& e) { return next_[digit(e)]++; }

  private:
    int shift_;
    std::vector<size_t> next_;
};

}  // namespace

float* Sensor::fill(std::vector<float>& array, const float* values, float otherwise) {
    array.assign(pixels_ + kSensorPad, otherwise);
    if (values) std::copy(values, values + pixels_, array.begin());
    return array.data();
}

Sensor::Sensor(int width, int height, const SensorModel& model, const PixelSettings& pixels)
    : width_(width), pixels_(size_t(width) * height), model_(model), events_((pixels_ + kPiece - 1) / kPiece) {
    state_.signal = fill(signal_, nullptr);
    state_.change = fill(change_, pixels.phase);
    state_.on = fill(on_, pixels.on, 1.f);
    state_.off = fill(off_, pixels.off, 1.f);
    if (model.cutoff_hz > 0.f) state_.input = fill(input_, nullptr);
    if (pixels.leak) {
        state_.leak = fill(leak_, pixels.leak);
        state_.change_rest = fill(change_rest_, nullptr);
    }
    if (model.shot_hz > 0.f || pixels.hot_hz) {
        if (pixels.hot_hz) state_.hot_hz = fill(hot_, pixels.hot_hz);
        state_.hazard = fill(hazard_, nullptr, 1.f);
        state_.hazard_rest = fill(hazard_rest_, nullptr);
        draws_.assign(pixels_, 1);
        state_.draws = draws_.data();
        for (size_t i = 0; i < pixels_; ++i)
            hazard_[i] = float(-std::log(uniform_number(model.seed, uint32_t(i), 0)));
    }
    if (model.refractory_us > 0.0) {
        last_us_.assign(pixels_, -std::numeric_limits<double>::infinity());
        state_.last_us = last_us_.data();
    }
}

bool Sensor::step(const float* luma, int64_t time_us, int threads) {
    if (!all_finite(luma, pixels_)) return false;
    const auto kernel = select_kernels().sensor_step;
    start_us_ = started_ ? time_us_ : time_us;
    run(threads, events_.size(), [&](size_t i) {
        GrowingList<RawEvent>& events = events_[i];
        events.size = 0;
        const size_t begin = i * kPiece, end = std::min(pixels_, begin + kPiece);
        kernel({&model_, &state_, luma, uint32_t(begin), uint32_t(end), double(start_us_),
                double(time_us - start_us_), !started_, &events});
    });
    time_us_ = time_us;
    started_ = true;
    return true;
}

size_t Sensor::count() const {
    size_t total = 0;
    for (const auto& events : events_) total += events.size;
    return total;
}

void Sensor::take(int64_t* t, uint16_t* x, uint16_t* y, int8_t* p) const {
    const size_t total = count();
    int passes = 1;
    while (passes * kDigitBits < 32 && (time_us_ - start_us_) >> (passes * kDigitBits)) ++passes;
    Buffer<RawEvent> from(total), to(passes > 1 ? total : 0);
    size_t at = 0;
    for (const auto& events : events_) {
        std::copy(events.data, events.data + events.size, from.data() + at);
        at += events.size;
    }
    for (int pass = 0; pass < passes; ++pass) {
        DigitSort sort(pass * kDigitBits);
        for (size_t i = 0; i < total; ++i) sort.add(from[i]);
        sort.finish();
        if (pass + 1 < passes) {
            for (size_t i = 0; i < total; ++i) to[sort.place(from[i])] = from[i];
            from.swap(to);
            continue;
        }
        for (size_t i = 0; i < total; ++i) {
            const size_t k = sort.place(from[i]);
            const uint32_t pixel = from[i].pixel_and_sign >> 1;
            t[k] = start_us_ + from[i].offset_us;
            x[k] = uint16_t(pixel % width_), y[k] = uint16_t(pixel / width_);
            p[k] = from[i].pixel_and_sign & 1 ? 1 : -1;
        }
    }
}

}  // namespace evsplat
