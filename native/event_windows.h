// What a recording says of the change of brightness between instants, and how a rendered change differs from it.
#pragma once

#include <stddef.h>
#include <stdint.h>

namespace evsplat {

// Ascending in time; pixels lie within (height, width).
struct EventColumnsIn {
    size_t count;
    const int64_t* t;
    const uint16_t *x, *y;
    const int8_t* p;
    size_t height, width;
};

// Adds to maps (times - 1, 2, H, W) the events of each window between neighbouring times, the end exclusive, ON (or
// without polarity) first. With `reach` above 0 the share of a pixel's next event that has come about by an instant
// counts before it instead of after: between two events of one polarity at most so far apart, evenly in time.
void window_counts(const EventColumnsIn&, const int64_t* times, size_t count, int64_t reach, float* maps);

// Of `windows` between neighbouring pictures of `pixels`: the differences d = change - on maps_on + off maps_off.
struct WindowDifference {
    size_t windows, pixels;
    const float* brightness;        // (windows + 1, pixels)
    const float* maps;              // (windows, 2, pixels)
    const float* drift;             // (windows, pixels): slope of the reported change by the clock's lag; may be null
    const float* sound;             // (pixels), weight of a pixel
    const float* weight;            // (windows), of a window
    float whole;                    // weight of the sum of all windows
    float on, off;                  // thresholds
};

struct WindowSums {
    double value, on, off, lag;     // the weighted sum of sizes of d, and its slopes
};

// `slope` (windows + 1, pixels) takes the derivative by brightness.
WindowSums window_difference(const WindowDifference&, int threads, float* slope);

}  // namespace evsplat
