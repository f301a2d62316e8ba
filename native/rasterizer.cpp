#include "rasterizer.h"

#include <algorithm>
#include <chrono>
#include <cstring>
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

    // `projected` is that of Gaussian 0.
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

// Moving and still entries of a tile, both in order, to one list in order: `merged` starts with the
// moving ones and has room for all. Equal depths: the moving ones come first.
void merge(Entry* merged, uint32_t moving, const Projected* projected, const Entry* still, uint32_t count,
           const Projected* still_projected) {
    Entry* end = merged + moving + count;
    while (count) {
        const Entry& back = still[count - 1];
        if (moving && projected[merged[moving - 1].gaussian].depth > still_projected[back.gaussian].depth)
            *--end = merged[--moving];
        else
            *--end = back, --count;
    }
}

// Adds the time since its start or the last lap to a stage.
class Lap {
  public:
    explicit Lap(const Record& r) : record_(r) {}
    void end(Stage stage) {
        const auto now = std::chrono::steady_clock::now();
        record_.nanoseconds[stage] += std::chrono::nanoseconds(now - since_).count();
        since_ = now;
    }

  private:
    const Record& record_;
    std::chrono::steady_clock::time_point since_ = std::chrono::steady_clock::now();
};

Gaussians gaussians_at(const Layer& l, size_t t) {
    return {l.means.at(t), l.quaternions.at(t), l.scales.at(t), l.opacities.at(t), l.linear.at(t), l.offset.at(t), l.count};
}

// Projects a layer at one time and sorts its intersections into tiles. Gaussian 0 is called `first`.
// In every tile that it touches, room is left for the entries that `still` has there.
void project_and_bin(const Record& r, const View& view, const Gaussians& g, uint32_t first, const Binned* still,
                     int threads, Binned& d, int32_t* radii) {
    const size_t tiles = size_t(view.tiles_x) * view.tiles_y;
    const size_t blocks = (size_t(g.count) + kBlock - 1) / kBlock;
    d.projected.reset(g.count);
    d.first_slot.reset(size_t(g.count) + 1);
    d.tile_begin.reset(tiles + 1);

    std::vector<GrowingList<Slot>> slots(blocks);
    run(threads, blocks, [&](size_t b) {
        const uint32_t begin = uint32_t(b * kBlock), end = std::min(begin + kBlock, g.count);
        Lap lap(r);
        GrowingList<Slot> list;  // on this thread's stack: its size changes with every slot
        r.kernels->project(view, g, begin, end, d.projected.data(), radii, d.first_slot.data(), list);
        slots[b].swap(list);
        lap.end(kProject);
    });
    std::vector<size_t> base(blocks + 1, 0);
    for (size_t b = 0; b < blocks; ++b) base[b + 1] = base[b] + slots[b].size;
    d.slots = base[blocks];
    d.first_slot[g.count] = uint32_t(d.slots);

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
    size_t total = 0;
    for (size_t tile = 0; tile < tiles; ++tile) {
        d.tile_begin[tile] = uint32_t(total);
        for (size_t part = 0; part < parts; ++part) {
            uint32_t& p = place[part * tiles + tile];
            const uint32_t count = p;
            p = uint32_t(total);
            total += count;
        }
        if (still && total > d.tile_begin[tile]) total += still->in_tile(tile);
    }
    if (total > 0xffffffffull || d.slot_base + d.slots > 0xffffffffull)
        throw std::runtime_error("more than 2^32 tile intersections in one render");
    d.tile_begin[tiles] = uint32_t(total);
    d.entries.reset(total);
    run(threads, parts, [&](size_t part) {
        Lap lap(r);
        uint32_t* next = place.data() + part * tiles;
        for_part(part, [&](size_t b) {
            const Slot* list = slots[b].data;
            const size_t slot = d.slot_base + base[b];
            for (size_t i = 0; i < slots[b].size; ++i)
                d.entries[next[list[i].tile]++] = {first + list[i].gaussian, uint32_t(slot + i), list[i].patches};
            const uint32_t begin = uint32_t(b * kBlock), end = std::min(begin + kBlock, g.count);
            for (uint32_t i = begin; i < end; ++i) d.first_slot[i] += uint32_t(base[b]);
        });
        lap.end(kSort);
    });
}

// Calls f(work) for each different picture of a tile: first the one without anything moving.
template <class F>
void for_pictures(const Record& r, uint32_t tile, F f) {
    thread_local std::vector<uint32_t> bare;
    bare.clear();
    for (uint32_t t = 0; t < r.moving.size(); ++t)
        if (!r.moving[t].in_tile(tile)) bare.push_back(t);
    size_t picture = r.picture[tile];
    const auto work = [&](const Binned& d, const uint32_t* times, size_t count) {
        TileWork w = {};
        w.index = tile;
        w.bare = &d == &r.still->binned;
        w.entries = d.entries.data() + d.tile_begin[tile];
        w.count = d.in_tile(tile);
        w.times = times, w.time_count = uint32_t(count);
        w.final_t = const_cast<float*>(r.final_t.data()) + picture * kTilePixels;
        w.last = const_cast<int32_t*>(r.last.data()) + picture * kTilePixels;
        w.patch_end = const_cast<uint32_t*>(r.patch_end.data()) + picture * r.kernels->patches;
        ++picture;
        f(w);
    };
    if (!bare.empty()) work(r.still->binned, bare.data(), bare.size());
    for (uint32_t t = 0; t < r.moving.size(); ++t)
        if (r.moving[t].in_tile(tile)) work(r.moving[t], &t, 1);
}

template <class F>
void for_entries(const Record& r, F f) {
    for (uint32_t tile = 0; tile + 1 < r.picture.size(); ++tile)
        for_pictures(r, tile, [&](const TileWork& w) {
            for (uint32_t i = 0; i < w.count; ++i) f(w.entries[i]);
        });
}

// Projected Gaussians and values of both layers; those of the moving one at `time`.
ForwardJob forward_job(const Scene& s, const Record& r, size_t time, int first_channel, int channels) {
    ForwardJob job = {};
    job.view = s.view;
    job.channels = channels;
    job.split = s.moving.count;
    job.projected[0] = r.moving[time].projected.data(), job.projected[1] = r.still->binned.projected.data();
    job.values[0] = s.moving.values.data ? s.moving.values.at(time) + first_channel : nullptr;
    job.values[1] = s.still.values.data ? s.still.values.data + first_channel : nullptr;
    job.value_stride = s.channels;
    if (s.background) {
        job.background = s.background + first_channel;
        job.background_c = 1;
        job.background_x = s.background_is_image ? s.channels : 0;
        job.background_y = job.background_x * s.view.width;
    }
    return job;
}

constexpr size_t kTilesPerTask = 4;

// Calls f(first, end) for ranges of tiles.
template <class F>
void for_tiles(int threads, size_t tiles, F f) {
    run(threads, (tiles + kTilesPerTask - 1) / kTilesPerTask, [&](size_t task) {
        f(uint32_t(task * kTilesPerTask), uint32_t(std::min(tiles, (task + 1) * kTilesPerTask)));
    });
}

// Puts the entries of a tile into the order of compositing.
void sort_tile(const Scene& s, Record& r, uint32_t tile) {
    thread_local TileSorter sorter;
    Binned& all_still = r.still->binned;
    const Projected* still_projected = all_still.projected.data() - s.moving.count;
    Entry* still = all_still.entries.data() + all_still.tile_begin[tile];
    const uint32_t still_count = all_still.in_tile(tile);
    if (!r.still->sorted[tile]) sorter.sort(still, still_projected, still_count);
    r.still->sorted[tile] = 1;
    for (Binned& d : r.moving)
        if (const uint32_t all = d.in_tile(tile)) {
            Entry* entries = d.entries.data() + d.tile_begin[tile];
            sorter.sort(entries, d.projected.data(), all - still_count);
            merge(entries, all - still_count, d.projected.data(), still, still_count, still_projected);
        }
}

// Copies a tile of `planes` planes.
void copy_tile(const View& view, uint32_t tile, size_t planes, const float* from, float* to) {
    const size_t width = view.width, x = tile % view.tiles_x * kTile, y = tile / view.tiles_x * kTile;
    const size_t columns = std::min<size_t>(kTile, width - x), rows = std::min<size_t>(kTile, view.height - y);
    for (size_t plane = 0; plane < planes; ++plane)
        for (size_t row = y; row < y + rows; ++row) {
            const size_t at = (plane * view.height + row) * width + x;
            std::memcpy(to + at, from + at, columns * sizeof(float));
        }
}

LightTile lit(const Scene& s, const Record& r, float* image) {
    return {&s.view, s.channels, s.light, r.unlit.data(), image};
}

size_t bytes_of(const Binned& d) {
    return d.projected.bytes() + d.first_slot.bytes() + d.entries.bytes() + d.tile_begin.bytes();
}

std::shared_ptr<Still> project_still(const Record& r, const Scene& s, bool keep, int threads, int32_t* radii) {
    const size_t tiles = size_t(s.view.tiles_x) * s.view.tiles_y, pixels = size_t(s.view.width) * s.view.height;
    auto still = std::make_shared<Still>();
    project_and_bin(r, s.view, gaussians_at(s.still, 0), s.moving.count, nullptr, threads, still->binned, radii);
    still->sorted.reset(tiles);
    std::fill_n(still->sorted.data(), tiles, uint8_t(0));
    if ((still->kept = keep)) {
        still->drawn.reset(tiles);
        std::fill_n(still->drawn.data(), tiles, uint8_t(0));
        still->radii.reset(s.still.count);
        std::copy_n(radii, s.still.count, still->radii.data());
        still->image.reset(s.channels * pixels);
        still->alpha.reset(pixels);
    }
    return still;
}

}  // namespace

size_t Still::bytes() const {
    return bytes_of(binned) + sorted.bytes() + drawn.bytes() + radii.bytes() + image.bytes() + alpha.bytes();
}

size_t Record::bytes() const {
    size_t total = still->bytes() + unlit.bytes() + picture.bytes() + final_t.bytes() + last.bytes() + patch_end.bytes();
    for (const Binned& d : moving) total += bytes_of(d);
    return total;
}

size_t Record::intersections() const {
    size_t total = 0;
    for_entries(*this, [&](const Entry&) { ++total; });
    return total;
}

size_t Record::patch_steps() const {
    size_t total = 0;
    for_entries(*this, [&](const Entry& e) { total += __builtin_popcountll(e.patches); });
    return total;
}

std::unique_ptr<Record> render_forward(const Scene& s, int threads, bool keep, std::shared_ptr<Still> earlier,
                                       float* image, float* alpha, int32_t* radii, int32_t* still_radii) {
    const Kernels& kernels = select_kernels();
    const size_t tiles = size_t(s.view.tiles_x) * s.view.tiles_y, pixels = size_t(s.view.width) * s.view.height;
    auto record = std::make_unique<Record>();
    Record& r = *record;
    r.kernels = &kernels;
    r.moving.resize(s.times);
    if (earlier) {
        r.still = std::move(earlier);
        std::copy_n(r.still->radii.data(), s.still.count, still_radii);
    } else {
        r.still = project_still(r, s, keep, threads, still_radii);
    }
    Still& still = *r.still;
    size_t slots = still.binned.slots;
    for (int t = 0; t < s.times; ++t) {
        Binned& d = r.moving[t];
        d.slot_base = slots;
        project_and_bin(r, s.view, gaussians_at(s.moving, t), 0, &still.binned, threads, d,
                        radii + size_t(t) * s.moving.count);
        slots += d.slots;
    }
    r.picture.reset(tiles + 1);
    uint32_t pictures = 0;
    for (size_t tile = 0; tile < tiles; ++tile) {
        r.picture[tile] = pictures;
        uint32_t touched = 0;
        for (const Binned& d : r.moving) touched += d.in_tile(tile) > 0;
        pictures += touched + (touched < r.moving.size());
    }
    r.picture[tiles] = pictures;
    r.final_t.reset(size_t(pictures) * kTilePixels);
    r.last.reset(size_t(pictures) * kTilePixels);
    r.patch_end.reset(size_t(pictures) * kernels.patches);
    r.unlit.reset(s.light ? kLitChannels * pixels : 0);

    const auto draw = [&](uint32_t tile) {
        for_pictures(r, tile, [&](const TileWork& work) {
            const bool kept = still.kept && work.bare;
            if (kept && still.drawn[tile]) {
                for (uint32_t i = 0; i < work.time_count; ++i) {
                    const size_t t = work.times[i];
                    copy_tile(s.view, tile, s.channels, still.image.data(), image + t * s.channels * pixels);
                    copy_tile(s.view, tile, 1, still.alpha.data(), alpha + t * pixels);
                }
                if (s.light) r.kernels->light_tile(lit(s, r, image), work);
                return;
            }
            for (int c = 0; c < s.channels; c += kMaxChannels) {
                ForwardJob job = forward_job(s, r, work.times[0], c, std::min(kMaxChannels, s.channels - c));
                job.image = image + c * pixels, job.image_t = s.channels * pixels;
                job.alpha = alpha, job.alpha_t = pixels;
                job.light = s.light && !work.bare ? s.light + work.times[0] * pixels : nullptr;
                kernels.forward(job, work);
            }
            if (kept) {
                const size_t t = work.times[0];
                copy_tile(s.view, tile, s.channels, image + t * s.channels * pixels, still.image.data());
                copy_tile(s.view, tile, 1, alpha + t * pixels, still.alpha.data());
                still.drawn[tile] = 1;
            }
            if (s.light && work.bare) {
                copy_tile(s.view, tile, kLitChannels, image + work.times[0] * s.channels * pixels, r.unlit.data());
                r.kernels->light_tile(lit(s, r, image), work);
            }
        });
    };
    for_tiles(threads, tiles, [&](uint32_t first, uint32_t end) {
        Lap lap(r);
        for (uint32_t tile = first; tile < end; ++tile) sort_tile(s, r, tile);
        lap.end(kSort);
        for (uint32_t tile = first; tile < end; ++tile) draw(tile);
        lap.end(kComposite);
    });
    return record;
}

void render_backward(const Scene& s, const Record& r, int threads, const OutputGrads& out, const InputGrads& in) {
    if (r.still->kept) throw std::runtime_error("a render whose still layer is kept has no backward pass");
    if (s.light && s.background && in.background)
        throw std::runtime_error("a background under a light has no gradient");
    const size_t pixels = size_t(s.view.width) * s.view.height;
    const Kernels& kernels = *r.kernels;
    const size_t tiles = size_t(s.view.tiles_x) * s.view.tiles_y;
    const auto blocks_of = [](const Layer& l) { return (size_t(l.count) + kBlock - 1) / kBlock; };
    std::vector<double> view_total(12, 0.0);
    const size_t slot_count = r.moving.back().slot_base + r.moving.back().slots;
    Buffer<float> slots(slot_count * slot_stride(std::min(s.channels, kMaxChannels)));
    Buffer<float> view_parts(std::max(blocks_of(s.moving), blocks_of(s.still)) * 12);
    Buffer<float> background_parts(tiles * kMaxChannels);
    // Gradients of the channels' blocks add up, for the geometry too: the image is linear in the
    // channels. The alpha gradient goes with the first block.
    for (int c = 0; c < s.channels; c += kMaxChannels) {
        const int channels = std::min(kMaxChannels, s.channels - c);
        std::fill_n(background_parts.data(), tiles * channels, 0.f);
        const auto draw_backward = [&](uint32_t tile) {
            bool add = false;
            for_pictures(r, tile, [&](const TileWork& work) {
                BackwardJob job = {};
                job.forward = forward_job(s, r, work.times[0], c, channels);
                if (!out.image.empty()) job.image_grad = out.image.data() + c, job.image_grad_t = s.channels;
                if (!out.alpha.empty() && c == 0) job.alpha_grad = out.alpha.data(), job.alpha_grad_t = 1;
                job.slots = slots.data();
                job.background_is_image = s.background_is_image;
                if (in.background)
                    job.background_grad = s.background_is_image ? in.background + c : background_parts.data();
                TileWork seen = work;
                PlaneGrad summed[kMaxChannels + 1];
                if (s.light && work.bare) {
                    thread_local std::vector<float> grads;
                    grads.resize(size_t(s.channels + 1) * kTilePixels);
                    float* alpha = grads.data() + s.channels * kTilePixels;
                    const LightTileGrads to = {job.image_grad, job.alpha_grad, grads.data(), alpha, in.light};
                    kernels.light_tile_backward(lit(s, r, nullptr), to, work);
                    const ptrdiff_t first = tile / s.view.tiles_x * kTile * kTile + tile % s.view.tiles_x * kTile;
                    for (int k = 0; k < channels; ++k) summed[k] = {grads.data() + k * kTilePixels - first, kTile, 1};
                    summed[channels] = {alpha - first, kTile, 1};
                    job.image_grad = summed, job.alpha_grad = summed + channels;
                    job.image_grad_t = job.alpha_grad_t = 0;
                    seen.time_count = 1;
                } else if (s.light) {
                    job.forward.light = s.light + work.times[0] * pixels;
                    job.light_grad = in.light ? in.light + work.times[0] * pixels : nullptr;
                }
                kernels.backward(job, seen, add);
                add = true;
            });
        };
        for_tiles(threads, tiles, [&](uint32_t first, uint32_t end) {
            Lap lap(r);
            for (uint32_t tile = first; tile < end; ++tile) draw_backward(tile);
            lap.end(kCompositeBackward);
        });
        if (in.background && !s.background_is_image)
            for (int k = 0; k < channels; ++k) {
                double total = 0.0;
                for (size_t i = 0; i < tiles; ++i) total += background_parts[i * channels + k];
                in.background[c + k] = float(total);
            }

        const auto to_fields = [&](const Layer& layer, const LayerGrads& to, const Binned& d, size_t t) {
            GaussianGrads grads = {};
            grads.means = to.means.at(t), grads.quaternions = to.quaternions.at(t), grads.scales = to.scales.at(t);
            grads.opacities = to.opacities.at(t), grads.linear = to.linear.at(t), grads.offset = to.offset.at(t);
            grads.values = to.values.data ? to.values.at(t) + c : nullptr;
            grads.value_stride = s.channels;
            grads.view = in.view ? view_parts.data() : nullptr;
            const Gaussians g = gaussians_at(layer, t);
            const float* first = slots.data() + d.slot_base * slot_stride(channels);
            run(threads, blocks_of(layer), [&](size_t b) {
                const uint32_t begin = uint32_t(b * kBlock), end = std::min(begin + kBlock, layer.count);
                Lap lap(r);
                kernels.project_backward(s.view, g, begin, end, d.projected.data(), d.first_slot.data(), first,
                                         channels, grads);
                lap.end(kProjectBackward);
            });
            if (in.view)
                for (size_t b = 0; b < blocks_of(layer); ++b)
                    for (int k = 0; k < 12; ++k) view_total[k] += view_parts[b * 12 + k];
        };
        to_fields(s.still, in.still, r.still->binned, 0);
        for (int t = 0; t < s.times; ++t) to_fields(s.moving, in.moving, r.moving[t], t);
    }
    if (in.view)
        for (int k = 0; k < 12; ++k) in.view[k] = float(view_total[k]);
}

}  // namespace evsplat
