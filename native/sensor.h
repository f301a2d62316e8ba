// An event camera: the state of its pixels, moved from picture to picture.
#pragma once

#include <vector>

#include "buffer.h"
#include "sensor_kernels.h"

namespace evsplat {

// Arrays of one value per pixel that are set at the start; null where there is no such effect.
struct PixelSettings {
    const float *on, *off;        // thresholds, never null
    const float* leak;            // log-intensity per second
    const float* phase;           // change at the first picture
    const float* hot_hz;
};

class Sensor {
  public:
    Sensor(int width, int height, const SensorModel& model, const PixelSettings& pixels);
    Sensor(const Sensor&) = delete;

    // Moves to `time_us`, which is later than the last; the events in between wait for `take`. False,
    // with nothing changed, where a value of `luma` is not finite.
    bool step(const float* luma, int64_t time_us, int threads);

    size_t count() const;
    // The waiting events by time, those of the same microsecond by pixel; each array holds count().
    void take(int64_t* t, uint16_t* x, uint16_t* y, int8_t* p) const;

  private:
    float* fill(std::vector<float>& array, const float* values, float otherwise = 0.f);

    int width_;
    size_t pixels_;
    SensorModel model_;
    PixelState state_;
    std::vector<float> signal_, input_, change_, change_rest_, on_, off_, leak_, hot_, hazard_, hazard_rest_;
    std::vector<uint32_t> draws_;
    std::vector<double> last_us_;
    std::vector<GrowingList<RawEvent>> events_;  // of each piece
    bool started_ = false;
    int64_t start_us_ = 0, time_us_ = 0;
};

}  // namespace evsplat
