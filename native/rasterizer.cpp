#include "rasterizer.h"

#include <algorithm>
#include <atomic>
#include <cstring>
#include <exception>
#include <stdexcept>

#include "levels.h"
#include "thread_pool.h"

namespace evsplat {
namespace {

// Entries of a tile per run of the insertion sort before the general sort takes over.
constexpr uint32_t kSmallTile = 48;

// Depth as an unsigned integer of the same order (drawn depths are positive).
uint32_t depth_key(float depth) {
    uint32_t key;
    std::memcpy(&key, &depth, sizeof key);
    return key;
}

struct Keyed {
    uint32_t key, index;
    bool operator<(const Keyed& o) const { return key != o.key ? key < o.key : index < o.index; }
};

// Insertion sort that gives up after `budget` moves.
bool insertion_sort(Keyed* a, uint32_t n, uint64_t budget) {
    for (uint32_t i = 1; i < n; ++i) {
        const Keyed item = a[i];
        uint32_t j = i;
        for (; j > 0 && item.key < a[j - 1].key; --j) a[j] = a[j - 1];
        a[j] = item;
        if (i - j > budget) return false;
        budget -= i - j;
    }
    return true;
}

// Order of a tile: by depth, equal depths by the Gaussians' order (which `index` carries).
struct TileSorter {
    std::vector<Keyed> items, spare;
    std::vector<Entry> moved;

    void sort(Entry* entries, const Projected* projected, uint32_t n) {
        if (n < 2) return;
        if (items.size() < n) items.resize(n), spare.resize(n), moved.resize(n);
        uint32_t all = ~0u, any = 0;
        for (uint32_t i = 0; i < n; ++i) {
            const uint32_t key = depth_key(projected[entries[i].gaussian].depth);
            items[i] = {key, i};
            all &= key, any |= key;
        }
        Keyed* sorted = items.data();
        if (n > kSmallTile) {
            // Two counting passes over the 16 highest bits that differ leave little to insert.
            const uint32_t differ = all ^ any;
            const int high = differ ? 32 - __builtin_clz(differ) : 0;
            const int low = std::max(0, high - 16);
            pass(items.data(), spare.data(), n, low);
            pass(spare.data(), items.data(), n, low + 8);
        }
        if (!insertion_sort(sorted, n, n > kSmallTile ? 8 * uint64_t(n) : ~0ull)) std::sort(sorted, sorted + n);
        for (uint32_t i = 0; i < n; ++i) moved[i] = entries[sorted[i].index];
        std::memcpy(entries, moved.data(), n * sizeof(Entry));
    }

    static void pass(const Keyed* from, Keyed* to, uint32_t n, int shift) {
        uint32_t start[256] = {};
        for (uint32_t i = 0; i < n; ++i) ++start[from[i].key >> shift & 255];
        uint32_t total = 0;
        for (uint32_t& s : start) {
            const uint32_t count = s;
            s = total;
            total += count;
        }
        for (uint32_t i = 0; i < n; ++i) to[start[from[i].key >> shift & 255]++] = from[i];
    }
};

// Slots that one block of Gaussians makes, in memory from the cache.
struct BlockSlots : SlotList {
    Buffer<Slot> memory;

    void take(BlockSlots& other) {
        memory.swap(other.memory);
        data = memory.data();
        size = other.size;
    }

    void start(size_t expected) {
        memory.reset(expected);
        data = memory.data();
        size = 0;
        capacity = memory.size();
        grow = [](SlotList& list) {
            auto& self = static_cast<BlockSlots&>(list);
            Buffer<Slot> larger(2 * self.capacity);
            std::memcpy(larger.data(), self.data, self.size * sizeof(Slot));
            self.memory.swap(larger);
            self.data = self.memory.data();
            self.capacity = self.memory.size();
        };
    }
};

// Runs tasks that may throw on threads that must not.
void run(int threads, size_t count, const std::function<void(size_t)>& task) {
    std::exception_ptr error;
    std::atomic<bool> failed{false};
    parallel_for(threads, count, [&](size_t i) {
        if (failed.load(std::memory_order_relaxed)) return;
        try {
            task(i);
        } catch (...) {
            if (!failed.exchange(true)) error = std::current_exception();
        }
    });
    if (error) std::rethrow_exception(error);
}

Gaussians gaussians_at(const Scene& s, size_t t) {
    const auto at = [t](const Field& f) { return f.data ? f.data + t * f.step : nullptr; };
    return {at(s.means), at(s.quats), at(s.scales), at(s.opacities), at(s.linear), at(s.offset), s.count};
}

ForwardJob forward_job(const Scene& s, const Drawn& d, size_t t, int first_channel, int channels, float* image,
                       float* alpha) {
    const size_t pixels = size_t(s.view.width) * s.view.height;
    ForwardJob job = {};
    job.view = s.view;
    job.channels = channels;
    job.projected = d.projected.data();
    job.values = s.values.data + t * s.values.step + first_channel;
    job.value_stride = s.channels;
    job.entries = d.entries.data();
    job.tile_begin = d.tile_begin.data();
    if (s.background.data) {
        job.background = s.background.data + first_channel;
        job.background_c = 1;
        job.background_x = s.background_is_image ? s.channels : 0;
        job.background_y = job.background_x * s.view.width;
    }
    if (image) {  // not for the backward pass
        job.image = image + (t * s.channels + first_channel) * pixels;
        job.alpha = alpha + t * pixels;
    }
    job.final_t = const_cast<float*>(d.final_t.data());
    job.last = const_cast<int32_t*>(d.last.data());
    job.patch_end = const_cast<uint32_t*>(d.patch_end.data());
    return job;
}

// Projects all Gaussians of one time and sorts their intersections into tiles.
void project_and_bin(const Kernels& kernels, const Scene& s, size_t t, int threads, Drawn& d, int32_t* radii) {
    const Gaussians g = gaussians_at(s, t);
    const size_t tiles = size_t(s.view.tiles_x) * s.view.tiles_y;
    const size_t blocks = (size_t(s.count) + kBlock - 1) / kBlock;
    d.projected.reset(s.count);
    d.first_slot.reset(size_t(s.count) + 1);
    d.tile_begin.reset(tiles + 1);
    d.patch_end.reset(tiles * kernels.patches);
    d.final_t.reset(tiles * kTilePixels);
    d.last.reset(tiles * kTilePixels);

    std::vector<BlockSlots> slots(blocks);
    run(threads, blocks, [&](size_t b) {
        const uint32_t begin = uint32_t(b * kBlock), end = std::min(begin + kBlock, s.count);
        BlockSlots list;  // on this thread's stack: its size changes with every slot
        list.start(3 * kBlock);
        kernels.project(s.view, g, begin, end, d.projected.data(), radii, d.first_slot.data(), list);
        slots[b].take(list);
    });
    std::vector<size_t> base(blocks + 1, 0);
    for (size_t b = 0; b < blocks; ++b) base[b + 1] = base[b] + slots[b].size;
    if (base[blocks] > 0xffffffffull)
        throw std::runtime_error("more than 2^32 tile intersections in one image");
    d.first_slot[s.count] = uint32_t(base[blocks]);
    d.entries.reset(base[blocks]);

    // Each part counts and then places its slots; within a tile, parts and slots keep the Gaussians'
    // order, whatever the number of parts.
    const size_t parts = std::max<size_t>(1, std::min<size_t>(threads, blocks));
    Buffer<uint32_t> place(parts * tiles);
    const auto for_part = [&](size_t part, auto&& f) {
        for (size_t b = blocks * part / parts; b < blocks * (part + 1) / parts; ++b) f(b);
    };
    run(threads, parts, [&](size_t part) {
        uint32_t* count = place.data() + part * tiles;
        std::memset(count, 0, tiles * sizeof *count);
        for_part(part, [&](size_t b) {
            const Slot* list = slots[b].data;
            for (size_t i = 0; i < slots[b].size; ++i) ++count[list[i].tile];
        });
    });
    uint32_t total = 0;
    for (size_t tile = 0; tile < tiles; ++tile) {
        d.tile_begin[tile] = total;
        for (size_t part = 0; part < parts; ++part) {
            uint32_t& p = place[part * tiles + tile];
            const uint32_t count = p;
            p = total;
            total += count;
        }
    }
    d.tile_begin[tiles] = total;
    run(threads, parts, [&](size_t part) {
        uint32_t* next = place.data() + part * tiles;
        for_part(part, [&](size_t b) {
            const Slot* list = slots[b].data;
            for (size_t i = 0; i < slots[b].size; ++i)
                d.entries[next[list[i].tile]++] = {list[i].gaussian, uint32_t(base[b] + i), list[i].patches};
            const uint32_t begin = uint32_t(b * kBlock), end = std::min(begin + kBlock, s.count);
            for (uint32_t i = begin; i < end; ++i) d.first_slot[i] += uint32_t(base[b]);
        });
    });
}

constexpr size_t kTilesPerTask = 4;

}  // namespace

size_t Record::bytes() const {
    size_t total = 0;
    for (const Drawn& d : times)
        total += d.projected.bytes() + d.first_slot.bytes() + d.entries.bytes() + d.tile_begin.bytes() +
                 d.patch_end.bytes() + d.final_t.bytes() + d.last.bytes();
    return total;
}

std::unique_ptr<Record> render_forward(const Scene& s, int threads, float* image, float* alpha, int32_t* radii) {
    const Kernels& kernels = select_kernels();
    auto record = std::make_unique<Record>();
    record->kernels = &kernels;
    record->times.resize(s.times);
    const size_t tiles = size_t(s.view.tiles_x) * s.view.tiles_y;
    for (int t = 0; t < s.times; ++t) {
        Drawn& d = record->times[t];
        project_and_bin(kernels, s, t, threads, d, radii + size_t(t) * s.count);
        run(threads, (tiles + kTilesPerTask - 1) / kTilesPerTask, [&](size_t task) {
            thread_local TileSorter sorter;
            for (size_t i = task * kTilesPerTask; i < std::min(tiles, (task + 1) * kTilesPerTask); ++i) {
                const uint32_t tile = uint32_t(i), begin = d.tile_begin[tile];
                sorter.sort(d.entries.data() + begin, d.projected.data(), d.tile_begin[tile + 1] - begin);
                for (int c = 0; c < s.channels; c += kMaxChannels)
                    kernels.forward(
                        forward_job(s, d, t, c, std::min(kMaxChannels, s.channels - c), image, alpha), tile);
            }
        });
    }
    return record;
}

void render_backward(const Scene& s, const Record& record, int threads, const OutputGrads& out,
                     const InputGrads& in) {
    const Kernels& kernels = *record.kernels;
    const size_t tiles = size_t(s.view.tiles_x) * s.view.tiles_y;
    const size_t blocks = (size_t(s.count) + kBlock - 1) / kBlock;
    std::vector<double> view_total(12, 0.0), background_total(s.channels, 0.0);
    Buffer<float> slots, view_parts(blocks * 12), background_parts(tiles * kMaxChannels);
    for (int t = 0; t < s.times; ++t) {
        const Drawn& d = record.times[t];
        const size_t needed = d.entries.size() * slot_stride(std::min(s.channels, kMaxChannels));
        if (slots.size() < needed) slots.reset(needed);
        // Gradients of the channels' blocks add up, for the geometry too: the image is linear in the
        // channels. The alpha gradient goes with the first block.
        for (int c = 0; c < s.channels; c += kMaxChannels) {
            BackwardJob job = {};
            const int channels = std::min(kMaxChannels, s.channels - c);
            job.forward = forward_job(s, d, t, c, channels, nullptr, nullptr);
            if (out.image_data) {
                job.image_grad = out.image_data + t * out.image[0] + c * out.image[3];
                job.image_grad_y = out.image[1], job.image_grad_x = out.image[2], job.image_grad_c = out.image[3];
            }
            if (out.alpha_data && c == 0) {
                job.alpha_grad = out.alpha_data + t * out.alpha[0];
                job.alpha_grad_y = out.alpha[1], job.alpha_grad_x = out.alpha[2];
            }
            job.slots = slots.data();
            job.background_is_image = s.background_is_image;
            if (in.background) job.background_grad = s.background_is_image ? in.background + c : background_parts.data();
            run(threads, (tiles + kTilesPerTask - 1) / kTilesPerTask, [&](size_t task) {
                for (size_t i = task * kTilesPerTask; i < std::min(tiles, (task + 1) * kTilesPerTask); ++i)
                    kernels.backward(job, uint32_t(i));
            });
            if (in.background && !s.background_is_image)
                for (size_t i = 0; i < tiles; ++i)
                    for (int k = 0; k < channels; ++k) background_total[c + k] += background_parts[i * channels + k];

            const Gaussians g = gaussians_at(s, t);
            const auto at = [t](const GradField& f) { return f.data ? f.data + t * f.step : nullptr; };
            GaussianGrads grads = {};
            grads.means = at(in.means), grads.quats = at(in.quats), grads.scales = at(in.scales);
            grads.opacities = at(in.opacities), grads.linear = at(in.linear), grads.offset = at(in.offset);
            grads.values = in.values.data ? at(in.values) + c : nullptr;
            grads.value_stride = s.channels;
            grads.view = in.view ? view_parts.data() : nullptr;
            run(threads, blocks, [&](size_t b) {
                const uint32_t begin = uint32_t(b * kBlock), end = std::min(begin + kBlock, s.count);
                kernels.project_backward(s.view, g, begin, end, d.projected.data(), d.first_slot.data(),
                                         slots.data(), channels, grads);
            });
            if (in.view)
                for (size_t b = 0; b < blocks; ++b)
                    for (int k = 0; k < 12; ++k) view_total[k] += view_parts[b * 12 + k];
        }
    }
    if (in.view)
        for (int k = 0; k < 12; ++k) in.view[k] = float(view_total[k]);
    if (in.background && !s.background_is_image)
        for (int k = 0; k < s.channels; ++k) in.background[k] = float(background_total[k]);
}

}  // namespace evsplat
