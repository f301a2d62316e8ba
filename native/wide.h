// Compositing in vectors of 16 lanes, of which a patch's pixels are one; see narrow.h for fewer.
//
// Included by kernels.cpp only.

constexpr uint32_t kChunk = 32;  // entries of a tile handled together

// A run of entries with what compositing reads, copied close together.
struct Chunk {
    Projected projected[kChunk];
    const float* values[kChunk];
    bool still[kChunk];
    uint32_t count;
};

// Copies entries [from, to) of a tile and asks for the memory of the chunk that comes next: behind it,
// or, going back, before it.
INLINE void fill_chunk(const ForwardJob& job, const Entry* entries, uint32_t from, uint32_t to, uint32_t next,
                       uint32_t next_end, Chunk& chunk) {
    chunk.count = to - from;
    for (uint32_t j = 0; j < chunk.count; ++j) {
        const Found found = find(job, entries[from + j].gaussian);
        chunk.projected[j] = *found.projected;
        chunk.values[j] = found.values;
        chunk.still[j] = entries[from + j].gaussian >= job.split;
    }
    prefetch_entries(job, entries, next, next_end);
}

INLINE Alpha alpha_at(const Projected& g, F x, F y) {
    Alpha a;
    const F dx = x - g.x, dy = y - g.y;
    a.u = g.l11 * dx + g.l12 * dy;
    a.v = g.l22 * dy;
    a.raw = exp2(g.log2_opacity - a.u * a.u - a.v * a.v);
    a.value = select(a.raw >= kMinAlpha, min(a.raw, splat(kMaxAlpha)), F{});
    return a;
}

// words[p] bit j: entry j of the chunk reaches patch p.
INLINE void transpose_masks(const Entry* entries, uint32_t count, uint32_t* words) {
    U lane, word[kPatches / W] = {};
    for (int l = 0; l < W; ++l) lane[l] = l;
    for (uint32_t j = 0; j < count; ++j) {
        const U mask = U{} + uint32_t(entries[j].patches);
        for (int k = 0; k < kPatches / W; ++k) word[k] |= ((mask >> (lane + uint32_t(k * W))) & 1u) << j;
    }
    __builtin_memcpy(words, word, sizeof word);
}

// A tile's pixels front to back. `live` begins as 0 outside the image, `final` as 1; `last` becomes the last entry
// before the stop.
template <int C, bool Lit>
APART void composite(const ForwardJob& job, const TileWork& work, const Tile&, const Pixels& pixels, Front at) {
    const int channels = C ? C : job.channels;
    uint64_t open = 0;
    for (int p = 0; p < kPatches; ++p) {
        work.patch_end[p] = work.count;
        open |= uint64_t(bits(pixels.inside[p]) != 0) << p;
    }
    Chunk chunk;
    for (uint32_t first = 0; first < work.count && open; first += kChunk) {
        const uint32_t stop = least(first + kChunk, work.count);
        fill_chunk(job, work.entries, first, stop, stop, least(stop + kChunk, work.count), chunk);
        uint32_t words[kPatches];
        transpose_masks(work.entries + first, chunk.count, words);
        for (uint64_t left = open; left; left &= left - 1) {
            const int p = __builtin_ctzll(left);
            uint32_t word = words[p];
            if (!word) continue;
            const F x = pixels.x[p], y = pixels.y[p];
            F t = at.live[p], t_final = at.final[p];
            I t_last = at.last[p];
            F* out = at.colour + p * channels;
            F c[C ? C : 1];
            for (int k = 0; k < C; ++k) c[k] = out[k];
            for (; word; word &= word - 1) {
                const int j = __builtin_ctz(word);
                const F alpha = alpha_at(chunk.projected[j], x, y).value;
                const F next = t - t * alpha;
                const I go = next > kMinTransmittance;
                const F weight = select(go, t * alpha, F{});
                t_final = select(go, next, t_final);
                t_last = go ? I{} + int32_t(first + j) : t_last;
                t = select(go, next, F{});
                const F lit = Lit && chunk.still[j] ? weight * at.light[p] : weight;
                const float* value = chunk.values[j];
                add_values<C, Lit>(C ? c : out, channels, weight, lit, value);
            }
            for (int k = 0; k < C; ++k) out[k] = c[k];
            at.live[p] = t, at.final[p] = t_final, at.last[p] = t_last;
            if (bits_at_most(t, F{}) == (uint64_t(1) << W) - 1) {
                open &= ~(uint64_t(1) << p);
                work.patch_end[p] = first + chunk.count;
            }
        }
    }
}

// All entries of a tile back to front, each one's sums into its slot.
template <int C, bool Lit>
APART void composite_backward(const BackwardJob& back, const TileWork& work, const Tile&, const Pixels& pixels,
                              int stride, bool add, Behind at) {
    const ForwardJob& job = back.forward;
    const int channels = C ? C : job.channels;
    Chunk chunk;
    for (uint32_t stop = work.count; stop > 0;) {
        const uint32_t first = (stop - 1) / kChunk * kChunk;
        uint64_t open = 0;
        for (int p = 0; p < kPatches; ++p) open |= uint64_t(first < work.patch_end[p]) << p;
        fill_chunk(job, work.entries, first, stop, first ? first - kChunk : 0, first, chunk);
        for (uint32_t j = 0; j < chunk.count; ++j)
            __builtin_prefetch(back.slots + size_t(work.entries[first + j].slot) * stride, 1);
        stop = first;
        for (uint32_t j = chunk.count; j-- > 0;) {
            const Entry& entry = work.entries[first + j];
            const Projected g = chunk.projected[j];
            // Copied, as for all the compiler knows the stores below could change it.
            float colour[C ? C : kMaxChannels];
            for (int k = 0; k < channels; ++k) colour[k] = chunk.values[j][k];
            const int32_t index_in_tile = int32_t(first + j);
            F slot[kMoments + (C ? C : kMaxChannels)];
            for (int k = 0; k < kMoments + channels; ++k) slot[k] = F{};
            for (uint64_t left = entry.patches & open; left; left &= left - 1) {
                const int p = __builtin_ctzll(left);
                const Alpha a = alpha_at(g, pixels.x[p], pixels.y[p]);
                const F alpha = select(at.last[p] >= index_in_tile, a.value, F{});
                add_gradient<C, Lit>(at, p, channels, a, alpha, chunk.still[j], colour, slot);
            }
            sums(slot, kMoments + channels, back.slots + size_t(entry.slot) * stride,
                 add && entry.gaussian >= job.split);
        }
    }
}
