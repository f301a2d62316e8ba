// The nearest points of a set, by a k-d tree.
#pragma once

#include <stddef.h>
#include <stdint.h>

namespace evsplat {

// Points are rows of three finite numbers. `index` (queries, k): the nearest of `points`, nearest first;
// `square`: their squared distances. Without `queries` they are the points, and none is its own neighbour.
struct Neighbours {
    const float *points, *queries;
    size_t count, query_count;
    int k;
    int64_t* index;
    float* square;
};

void find_neighbours(const Neighbours&, int threads);

}  // namespace evsplat
