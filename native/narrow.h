// Compositing in vectors of four and eight lanes, of which a patch's pixels are one.
//
// Included by kernels.cpp only. What limits such a core is the number of its vector operations: where
// multiply-adds are mixed with others, a Zen 3 does two of them a cycle, whatever waits for what. So a step
// here has fewer of them than that of 16 lanes, whose masks are cheap and whose registers are many: centres
// are folded into two offsets per Gaussian and tile, alpha is tested before 2^e is taken, and what a pixel
// looked like when it stopped is only kept when one stops. Runs of entries are long, and lie close together
// with their values, since the end of a patch's run is guessed wrong and memory far away is waited for.

constexpr uint32_t kRun = 64;  // entries of a tile handled together, at most the bits of a word
constexpr uint32_t kLook = 16;  // entries after which the backward pass looks anew at which patches are open
constexpr float kLog2MinAlpha = -7.9943534f;

template <int C>
struct Run {
    static constexpr int stride = C ? (C + 3) / 4 * 4 : kMaxChannels;

    Projected projected[kRun];  // with u and v at the tile's corner in place of x and y
    float values[kRun * stride];
    int32_t still[kRun];        // all bits or none
    uint32_t count;
};

template <int C>
INLINE void fill_run(const ForwardJob& job, const Tile& tile, const Entry* entries, uint32_t from, uint32_t to,
                     Run<C>& run) {
    run.count = to - from;
    for (uint32_t j = 0; j < run.count; ++j) {
        const uint32_t gaussian = entries[from + j].gaussian;
        const Found found = find(job, gaussian);
        Projected g = *found.projected;
        const float dx = float(tile.x0) - g.x, dy = float(tile.y0) - g.y;
        g.x = g.l11 * dx + g.l12 * dy, g.y = g.l22 * dy;
        run.projected[j] = g;
        float* values = run.values + j * Run<C>::stride;
        if (C) {
            __builtin_memcpy(values, found.values, C * sizeof(float));
        } else {
            for (int k = 0; k < job.channels; ++k) values[k] = found.values[k];
        }
        run.still[j] = -int32_t(gaussian >= job.split);
    }
}

// Asks for a tile's rows of a plane.
template <int write>
INLINE void prefetch_rows(const float* first, ptrdiff_t sy) {
    for (int y = 0; y < kTile; ++y) __builtin_prefetch(first + y * sy, write);
}

#if defined(__AVX2__) && EVSPLAT_LANES == 8
// halves[2 * p] bit j: bit p of masks[j], of 32.
INLINE void transpose_bits(const uint32_t* masks, uint32_t* halves) {
    const __m256i order = _mm256_setr_epi8(0, 4, 8, 12, 1, 5, 9, 13, 2, 6, 10, 14, 3, 7, 11, 15,  //
                                           0, 4, 8, 12, 1, 5, 9, 13, 2, 6, 10, 14, 3, 7, 11, 15);
    __m256i rows[4];
    for (int i = 0; i < 4; ++i) {
        const __m128i low = _mm_loadu_si128((const __m128i*)(masks + 4 * i));
        const __m128i high = _mm_loadu_si128((const __m128i*)(masks + 16 + 4 * i));
        rows[i] = _mm256_shuffle_epi8(_mm256_set_m128i(high, low), order);
    }
    const __m256i ab = _mm256_unpacklo_epi32(rows[0], rows[1]), cd = _mm256_unpacklo_epi32(rows[2], rows[3]);
    const __m256i ab2 = _mm256_unpackhi_epi32(rows[0], rows[1]), cd2 = _mm256_unpackhi_epi32(rows[2], rows[3]);
    // The first, second, third and fourth byte of all masks.
    __m256i bytes[4] = {_mm256_unpacklo_epi64(ab, cd), _mm256_unpackhi_epi64(ab, cd),
                        _mm256_unpacklo_epi64(ab2, cd2), _mm256_unpackhi_epi64(ab2, cd2)};
    for (int bit = 7; bit >= 0; --bit)
        for (int b = 0; b < 4; ++b) {
            halves[2 * (8 * b + bit)] = uint32_t(_mm256_movemask_epi8(bytes[b]));
            bytes[b] = _mm256_add_epi8(bytes[b], bytes[b]);
        }
}
#endif

// Bit j of halves[2 * p], and of the one behind it for later entries: entry j of the run reaches patch p.
INLINE void transpose_run(const Entry* entries, uint32_t count, uint32_t* halves) {
#if defined(__AVX2__) && EVSPLAT_LANES == 8
    uint32_t masks[kRun];
    for (uint32_t j = 0; j < kRun; ++j) masks[j] = j < count ? uint32_t(entries[j].patches) : 0u;
    transpose_bits(masks, halves);
    transpose_bits(masks + 32, halves + 1);
#else
    for (int i = 0; i < 2 * kPatches; ++i) halves[i] = 0;
    for (uint32_t j = 0; j < count; ++j)
        for (uint64_t mask = entries[j].patches; mask; mask &= mask - 1)
            halves[2 * __builtin_ctzll(mask) + j / 32] |= uint32_t(1) << j % 32;
#endif
}

// e to the nearest whole number, and that number in the place of a float's exponent.
INLINE void nearest(F e, F& whole, I& exponent) {
#if defined(__AVX__) && EVSPLAT_LANES == 8
    whole = (F)_mm256_round_ps((__m256)e, _MM_FROUND_TO_NEAREST_INT | _MM_FROUND_NO_EXC);
    exponent = (I)_mm256_cvtps_epi32((__m256)e) << 23;
#else
    const F magic = splat(12582912.f), shifted = e + magic;  // -ffast-math would break it
    whole = shifted - magic;
    exponent = (I)shifted << 23;
#endif
}

// At pixel centres x, y from the tile's corner; `raw` means nothing where alpha is below 1/255. In place
// of exp2's bound there is the test of e.
INLINE Alpha alpha_in_tile(const Projected& g, F x, F y) {
    Alpha a;
    a.v = g.l22 * y + g.y;
    a.u = g.l11 * x + (g.l12 * y + g.x);
    const F e = g.log2_opacity - a.v * a.v - a.u * a.u;
    F whole;
    I exponent;
    nearest(e, whole, exponent);
    a.raw = (F)((I)exp2_fraction(e - whole) + exponent);
    a.value = select(e >= kLog2MinAlpha, min(a.raw, splat(kMaxAlpha)), F{});
    return a;
}

// A tile's pixels front to back. `live` begins as 0 outside the image, `final` as 1; `last` becomes an entry behind
// which a pixel stopped, or one that comes after all.
template <int C, bool Lit>
APART void composite(const ForwardJob& job, const TileWork& work, const Tile& tile, const Pixels& pixels,
                     Front at) {
    const View& view = job.view;
    const int channels = C ? C : job.channels;
    prefetch_entries(job, work.entries, 0, least(kRun, work.count));
    if (tile.columns == kTile && tile.rows == kTile) {
        const size_t plane = size_t(view.width) * view.height, corner = size_t(tile.y0) * view.width + tile.x0;
        for (int k = 0; k < channels; ++k)
            prefetch_rows<1>(job.image + work.times[0] * job.image_t + k * plane + corner, view.width);
        prefetch_rows<1>(job.alpha + work.times[0] * job.alpha_t + corner, view.width);
    }
    const I never = I{} + INT32_MAX;
    constexpr uint32_t everyone = (uint32_t(1) << W) - 1;
    uint64_t open = 0;
    uint32_t stopped[kPatches];  // a bit per lane
    for (int p = 0; p < kPatches; ++p) {
        work.patch_end[p] = work.count;
        stopped[p] = uint32_t(bits(~pixels.inside[p]));
        at.last[p] = pixels.inside[p] ? never : at.last[p];
        open |= uint64_t(bits(pixels.inside[p]) != 0) << p;
    }
    Run<C> run;
    for (uint32_t first = 0; first < work.count && open; first += kRun) {
        const uint32_t stop = least(first + kRun, work.count);
        fill_run<C>(job, tile, work.entries, first, stop, run);
        prefetch_entries(job, work.entries, stop, least(stop + kRun, work.count));
        uint32_t halves[2 * kPatches];
        transpose_run(work.entries + first, run.count, halves);
        for (uint64_t left = open; left; left &= left - 1) {
            const int p = __builtin_ctzll(left);
            uint64_t word = halves[2 * p] | uint64_t(halves[2 * p + 1]) << 32;
            if (!word) continue;
            const F x = pixels.x[p], y = pixels.y[p];
            F t = at.live[p];
            uint32_t out_of = stopped[p];
            F* out = at.colour + p * channels;
            F c[C ? C : 1];
            for (int k = 0; k < C; ++k) c[k] = out[k];
            for (; word; word &= word - 1) {
                const int j = __builtin_ctzll(word);
                const F alpha = alpha_in_tile(run.projected[j], x, y).value;
                F weight = t * alpha, next = t - weight;
                if (__builtin_expect(bits(next <= kMinTransmittance) != out_of, 0)) {
                    const I stops = (next <= kMinTransmittance) & (t > 0.f);
                    at.final[p] = select(stops, t, at.final[p]);
                    at.last[p] = stops ? I{} + (int32_t(first) + j - 1) : at.last[p];
                    weight = select(stops, F{}, weight), next = select(stops, F{}, next);
                    out_of = uint32_t(bits(next <= 0.f));
                    if (out_of == everyone) {
                        t = next;
                        open &= ~(uint64_t(1) << p);
                        work.patch_end[p] = first + j;
                        break;
                    }
                }
                t = next;
                const F lit = Lit ? weight * select(I{} + run.still[j], at.light[p], splat(1.f)) : weight;
                const float* value = run.values + j * Run<C>::stride;
                add_values<C, Lit>(C ? c : out, channels, weight, lit, value);
            }
            for (int k = 0; k < C; ++k) out[k] = c[k];
            at.live[p] = t, stopped[p] = out_of;
        }
    }
    for (int p = 0; p < kPatches; ++p) at.final[p] = select(at.live[p] > 0.f, at.live[p], at.final[p]);
}

// Entries [from, to) with the slots of their gradients.
INLINE void prefetch_backward(const BackwardJob& back, const Entry* entries, int stride, uint32_t from, uint32_t to) {
    prefetch_entries(back.forward, entries, from, to);
    for (uint32_t i = from; i < to; ++i) __builtin_prefetch(back.slots + size_t(entries[i].slot) * stride, 1);
}

// What `backward` reads first of a tile: its last entries, and the gradients of the one on its right.
INLINE void prefetch_tile(const BackwardJob& back, const TileWork& work, const Tile& tile, int stride) {
    if (work.count)
        prefetch_backward(back, work.entries, stride, (work.count - 1) / kRun * kRun, work.count);
    const int x = tile.x0 + kTile;
    if (x + kTile > back.forward.view.width || tile.rows < kTile) return;
    const auto prefetch = [&](const PlaneGrad& plane) {
        if (plane.data && plane.right == 1) prefetch_rows<0>(plane.data + tile.y0 * plane.down + x, plane.down);
    };
    for (int k = 0; back.image_grad && k < back.forward.channels; ++k)
        prefetch(back.image_grad[work.times[0] * back.image_grad_t + k]);
    if (back.alpha_grad) prefetch(back.alpha_grad[work.times[0] * back.alpha_grad_t]);
}

// A bit per patch that is not opaque before entry `index`.
INLINE uint64_t open_at(const uint32_t* patch_end, uint32_t index) {
    uint64_t open = 0;
    for (int p = 0; p < kPatches; p += W) {
        I end;
        __builtin_memcpy(&end, patch_end + p, sizeof end);
        open |= bits(end > I{} + int32_t(index)) << p;
    }
    return open;
}

// All entries of a tile back to front, each one's sums into its slot.
template <int C, bool Lit>
APART void composite_backward(const BackwardJob& back, const TileWork& work, const Tile& tile, const Pixels& pixels,
                              int stride, bool add, Behind at) {
    const ForwardJob& job = back.forward;
    const int channels = C ? C : job.channels;
    Run<C> run;
    for (uint32_t stop = work.count; stop > 0;) {
        const uint32_t first = (stop - 1) / kRun * kRun;
        fill_run<C>(job, tile, work.entries, first, stop, run);
        prefetch_backward(back, work.entries, stride, first ? first - kRun : 0, first);
        stop = first;
        uint64_t open = 0;
        for (uint32_t j = run.count; j-- > 0;) {
            if (j + 1 == run.count || j % kLook == kLook - 1) open = open_at(work.patch_end, first + j / kLook * kLook);
            const Entry& entry = work.entries[first + j];
            const Projected g = run.projected[j];
            const float* colour = run.values + j * Run<C>::stride;
            const int32_t index_in_tile = int32_t(first + j);
            F slot[kMoments + (C ? C : kMaxChannels)];
            for (int k = 0; k < kMoments + channels; ++k) slot[k] = F{};
            for (uint64_t left = entry.patches & open; left; left &= left - 1) {
                const int p = __builtin_ctzll(left);
                const Alpha a = alpha_in_tile(g, pixels.x[p], pixels.y[p]);
                const F alpha = select(I{} + index_in_tile > at.last[p], F{}, a.value);
                add_gradient<C, Lit>(at, p, channels, a, alpha, run.still[j], colour, slot);
            }
            sums(slot, kMoments + channels, back.slots + size_t(entry.slot) * stride,
                 add && entry.gaussian >= job.split);
        }
    }
}
