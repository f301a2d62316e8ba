// The pixels of an event camera: what each remembers, and one step of all of them.
//
// A pixel low-passes the log-intensity of the light it sees and sends an event whenever the result has
// moved by a threshold since its last crossing; between two pictures everything is linear in time, so
// crossings have exact times. Leak is a steady drift, noise a Poisson process in continuous time.
#pragma once

#include <stddef.h>
#include <stdint.h>

#include "list.h"

namespace evsplat {

// One event of a step: microseconds since the step's start; pixel * 2 + (1 if brighter).
struct RawEvent {
    uint32_t offset_us, pixel_and_sign;
};

// What all pixels share.
struct SensorModel {
    bool lin_log = false;       // straight below kLinLogKnee of 255 instead of log(Y + eps)
    float eps = 1e-3f;
    float cutoff_hz = 0.f;      // bandwidth at full scale; 0: no low-pass
    float shot_hz = 0.f;        // in the dark
    double refractory_us = 0.0;
    uint64_t seed = 0;
};

// One value per pixel; null where the model has no such effect.
struct PixelState {
    float* signal = nullptr;       // filtered log-intensity at the last picture
    float* input = nullptr;        // unfiltered, if there is a low-pass
    float* change = nullptr;       // of the signal since the last crossing
    float* change_rest = nullptr;  // digits below the last of `change`, if there is leak
    const float *on = nullptr, *off = nullptr;  // thresholds
    const float* leak = nullptr;   // log-intensity per second
    const float* hot_hz = nullptr;
    float* hazard = nullptr;       // noise events to be expected until the next one, or null
    float* hazard_rest = nullptr;
    uint32_t* draws = nullptr;     // random numbers used so far
    double* last_us = nullptr;     // last event sent, if there is a dead time
};

// Pixels [begin, end) over one step. The arrays of the state may be read up to kSensorPad beyond.
struct SensorPiece {
    const SensorModel* model;
    const PixelState* state;
    const float* luma;            // linear light, 1 = full scale
    uint32_t begin, end;
    double start_us, duration_us;
    bool first;                   // only look: no events
    List<RawEvent>* events;
};

constexpr uint32_t kSensorPad = 16;
constexpr float kLinLogKnee = 20.f;

// Number `counter` of the sequence of a pixel, uniform in (0, 1).
inline double uniform_number(uint64_t seed, uint32_t pixel, uint32_t counter) {
    uint64_t z = seed + ((uint64_t(pixel) << 32) | counter) * 0x9e3779b97f4a7c15ull;
    for (int round = 0; round < 2; ++round) {  // the finaliser of splitmix64
        z = (z ^ (z >> 30)) * 0xbf58476d1ce4e5b9ull;
        z = (z ^ (z >> 27)) * 0x94d049bb133111ebull;
        z ^= z >> 31;
    }
    return (double(z >> 11) + 0.5) * 0x1p-53;
}

}  // namespace evsplat
