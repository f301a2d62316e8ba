// Losses on whole pictures, beside the similarity of ssim.h: passes over planes of pixels.
#pragma once

#include <stddef.h>
#include <stdint.h>

namespace evsplat {

constexpr int kMostPictures = 256;

// Natural logarithm of the luminance of pictures of `count` pixels:
// log(sum_c weight_c max(coded_c, darkest)^gamma + eps). Its slope by a channel is zero below `darkest`; where
// `keeps_hue` it is that of the mean over channels of log(max(coded_c, darkest)^gamma + eps), which pulls at all of
// them alike.
struct LogBrightness {
    int pictures;
    const float* coded[kMostPictures];  // (3, count) each
    size_t count;
    float weight[3];
    float gamma, darkest, eps;
    bool keeps_hue;
    bool change;  // not of each picture: of the second of two less that of the first
};

// (pictures, count), or (count) of a change; back from its gradient `above` it writes those of the pictures, (3, count).
void log_brightness(const LogBrightness&, int threads, float* value);
void log_brightness_backward(const LogBrightness&, const float* above, int threads, float* const* grads);

// value = max(from, 0)^exponent for an exponent above 1, over `count` values; `slope` is null or takes the
// derivative. Both are zero below 1e-6.
struct Power {
    const float* from;
    float exponent;
    float *value, *slope;
};

void power(const Power&, size_t count, int threads);

// The mean over pictures of max(coded, 0)^exponent, of their three planes of `count` pixels; zero below 1e-6. Back it
// writes the pictures' gradients from that of the mean.
struct PowerMean {
    int pictures;
    const float* coded[kMostPictures];  // (3, count) each
    float exponent;
    size_t count;
    float* mean;                        // (3, count)
};

void power_mean(const PowerMean&, int threads);
void power_mean_backward(const PowerMean&, const float* above, int threads, float* const* grads);

// Pictures (times, height, width) twice or more as large in each direction, linear between the places of their pixels,
// the first size (times, to_height, to_width) of it; as F.interpolate(..., "bilinear") has it.
struct Enlarge {
    size_t times;
    int height, width, to_height, to_width, factor;
};

void enlarge(const Enlarge&, const float* from, int threads, float* to);
void enlarge_backward(const Enlarge&, const float* above, int threads, float* grad);

// `count` values of 8 bits as shares of their range, [0, 1].
void share_of_range(const uint8_t* levels, size_t count, int threads, float* shares);

// grad = by_difference * sign(image - reference) + scale * grad, over `count` values.
void add_sign(const float* image, const float* reference, float by_difference, float scale, size_t count,
              int threads, float* grad);

// How well `count` pixels' share of the person fits to what each surely is: the natural logarithm of the
// share, held within [lowest, 1 - lowest], where `inside` has its bit, of 1 - share where `outside` has
// it, and nothing elsewhere. Masks have their first pixel in a byte's highest bit. `slope` is null or
// takes the derivative of the sum.
struct Membership {
    const float* share;
    const uint8_t *inside, *outside;
    float lowest;
    float* slope;
};

double membership(const Membership&, size_t count, int threads);

// The pixels of pictures that are looked at: of picture p the `pixel`s up to ends[p].
struct Looked {
    size_t pictures, area, count;  // of pixels in each, and looked at in all
    const int32_t* pixel;          // (count), in its picture
    const int64_t* ends;           // (pictures), the last one is count
};

// Their colours (count, 3) where drawings, planes (pictures, 3, area) and (pictures, area), are before what is `behind`,
// (count, 3): drawn + (1 - alpha) behind.
struct Before {
    Looked looked;
    const float *drawn, *alpha, *behind;
};
void colours_before(const Before&, int threads, float* colours);
void colours_before_backward(const Before&, const float* above, int threads, float* by_drawn, float* by_alpha);

// How far they are from pictures' colours: of each picture the sum of weight log(1 + scale |colour - image|^2).
// `slope` is null or takes the derivatives by the colours.
struct Misfit {
    size_t pictures;
    const int64_t* ends;                    // as above
    const float *colours, *image, *weight;  // (count, 3) twice, and (count)
    float scale;
    float* slope;
};
void misfit(const Misfit&, int threads, float* sums);

// Two maps of `count` pixels, each divided by sqrt(sum of squares + count floor^2).
struct MapDifference {
    double scale[2];     // one over the divisors
    double difference;   // sum of absolute differences
    double along;        // sum of their signs times the first map
};

MapDifference map_difference(const float* map, const float* reference, float floor, size_t count, int threads);

// Gradient of `weight * difference` by the first map.
void map_difference_backward(const float* map, const float* reference, const MapDifference&, float weight,
                             size_t count, int threads, float* grad);

}  // namespace evsplat
