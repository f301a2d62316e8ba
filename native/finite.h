// Whether arrays hold a value that is not finite.
#pragma once

#include <stddef.h>

#include <vector>

namespace evsplat {

struct Values {
    const float* first;
    size_t count;
};

// The sum of the magnitudes of all values: NaN or infinite exactly if one of them is, or if those of
// one piece overflow together. All threads share one pass over all arrays.
double sum_of_magnitudes(const std::vector<Values>&, int threads);

}  // namespace evsplat
