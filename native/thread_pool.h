// Threads that stay alive between calls and take work in small pieces.
#pragma once

#include <algorithm>
#include <functional>

namespace evsplat {

// Calls task(i) for every i < count on up to `threads` threads, the caller among them. Which thread
// takes which i is left open, so tasks must not depend on it. One call runs at a time.
void parallel_for(int threads, size_t count, const std::function<void(size_t)>& task);

// The same for tasks that may throw; the first exception comes out of here.
void run(int threads, size_t count, const std::function<void(size_t)>& task);

// Calls work(begin, end) for pieces of [0, count) of `size` each, as `parallel_for` does.
template <class Work>
void in_pieces(int threads, size_t count, size_t size, const Work& work) {
    parallel_for(threads, (count + size - 1) / size, [&](size_t piece) {
        work(piece * size, std::min(count, (piece + 1) * size));
    });
}

}  // namespace evsplat
