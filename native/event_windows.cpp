#include "event_windows.h"

#include <algorithm>
#include <vector>

#include "levels.h"
#include "thread_pool.h"

namespace evsplat {

static constexpr size_t kPixels = 8192;  // of a piece; fixes the order of sums over pixels

void window_counts(const EventColumnsIn& e, const int64_t* times, size_t count, int64_t reach, float* maps) {
    struct Last {
        int64_t t = 0;
        int32_t row = -1;  // instants at or before the event; none yet
        int8_t p = 0;
    };
    const size_t pixels = e.height * e.width, windows = count - 1;
    std::vector<Last> last(reach > 0 ? pixels : 0);
    size_t row = 0;
    for (size_t i = 0; i < e.count; ++i) {
        while (row < count && times[row] <= e.t[i]) ++row;
        const size_t pixel = size_t(e.y[i]) * e.width + e.x[i];
        float* map = maps + (e.p[i] < 0 ? pixels : 0) + pixel;
        if (row > 0 && row <= windows) map[(row - 1) * 2 * pixels] += 1.f;
        if (reach <= 0) continue;
        Last& before = last[pixel];
        const int64_t gap = e.t[i] - before.t;
        if (before.row >= 0 && before.row < int32_t(row) && before.p == e.p[i] && gap <= reach)
            for (size_t r = size_t(before.row); r < row; ++r) {
                const float share = float(double(times[r] - before.t) / double(gap));
                if (r > 0) map[(r - 1) * 2 * pixels] += share;
                if (r < windows) map[r * 2 * pixels] -= share;
            }
        before = {e.t[i], int32_t(row), e.p[i]};
    }
}

WindowSums window_difference(const WindowDifference& job, int threads, float* slope) {
    const auto kernel = select_kernels().window_difference;
    std::vector<WindowSums> parts((job.pixels + kPixels - 1) / kPixels);
    in_pieces(threads, job.pixels, kPixels, [&](size_t begin, size_t end) {
        parts[begin / kPixels] = kernel(job, begin, end, slope);
    });
    WindowSums total = {};
    for (const WindowSums& part : parts) {
        total.value += part.value, total.on += part.on;
        total.off += part.off, total.lag += part.lag;
    }
    return total;
}

}  // namespace evsplat
