// Networks on AMX tiles, for one block of points. Only levels.cpp decides whether this may run.

#include <immintrin.h>

#include "tile_mlp_kernels.h"

namespace evsplat {
namespace amx {
namespace {

#define INLINE_MEMBER inline __attribute__((always_inline))
#define INLINE static INLINE_MEMBER

constexpr int R = kTileStrip;
constexpr int kRowTiles = R / kTileSide;          // tiles below each other in a strip
constexpr int kRowSteps = R / kTilePairs;         // steps of a product over the points
constexpr size_t kPanel = size_t(R) * kTileSide;  // floats of a panel of a result
constexpr size_t kStep = size_t(R) * kTilePairs;  // values of a step of a left side
constexpr size_t kTileBytes = kTileValues * sizeof(uint16_t);
constexpr size_t kTileFloats = size_t(kTileSide) * kTileSide;

// --- Numbers as two bfloat16 ---

// The upper half of each number is the bfloat16, what stands below does not count.
struct Split {
    __m512i high, low;
};

// Rounded to nearest in both, so that 16 digits are left. Of what is no number the low part is none either.
INLINE Split split(__m512 v) {
    const __m512i half = _mm512_set1_epi32(0x8000), upper = _mm512_set1_epi32(int(0xffff0000));
    const __m512i high = _mm512_and_si512(_mm512_add_epi32(_mm512_castps_si512(v), half), upper);
    const __m512 rest = _mm512_sub_ps(v, _mm512_castsi512_ps(high));
    return {high, _mm512_add_epi32(_mm512_castps_si512(rest), half)};
}

// 32 bfloat16 of two vectors, one behind the other.
INLINE __m512i behind(__m512i a, __m512i b) {
    const __m512i odd = _mm512_set_epi16(63, 61, 59, 57, 55, 53, 51, 49, 47, 45, 43, 41, 39, 37, 35, 33,  //
                                         31, 29, 27, 25, 23, 21, 19, 17, 15, 13, 11, 9, 7, 5, 3, 1);
    return _mm512_permutex2var_epi16(a, odd, b);
}

// 32 bfloat16 of two rows, value by value, the even row's first.
INLINE __m512i beside(__m512i even, __m512i odd) {
    const __m512i upper = _mm512_set1_epi32(int(0xffff0000));
    return _mm512_ternarylogic_epi32(_mm512_srli_epi32(even, 16), odd, upper, 0xf8);  // a | (b & c)
}

// A matrix of R rows as the left side of a product: (steps, R, 32) of high values, and of low ones behind.
struct Left {
    uint16_t* high;
    int steps;

    uint16_t* low() const { return high + steps * kStep; }
    // 32 columns of a row.
    INLINE_MEMBER void store(int step, int row, const Split& a, const Split& b) const {
        const size_t at = step * kStep + size_t(row) * kTilePairs;
        _mm512_store_si512(high + at, behind(a.high, b.high));
        _mm512_store_si512(low() + at, behind(a.low, b.low));
    }
};

// --- Products ---

// What was stored is in memory: GCC does not know what loads of tiles and of their shapes read.
INLINE void settle() { __asm__ volatile("" ::: "memory"); }

// The shapes of the tile registers, whole tiles all, for as long as this lives.
class Tiles {
  public:
    INLINE_MEMBER Tiles() {
        struct alignas(64) {
            uint8_t palette = 1, start_row = 0, reserved[14] = {};
            uint16_t column_bytes[16] = {};
            uint8_t rows[16] = {};
        } shapes;
        for (int t = 0; t < 8; ++t) shapes.column_bytes[t] = 2 * kTilePairs, shapes.rows[t] = kTileSide;
        __asm__ volatile("" ::"r"(&shapes) : "memory");
        _tile_loadconfig(&shapes);
    }
    INLINE_MEMBER ~Tiles() { _tile_release(); }
};

// One side of a product: the high and the low values of its tiles, by bytes from one to the next.
struct Side {
    const uint16_t *high, *low;
    size_t tile, step;

    const uint8_t* at(const uint16_t* values, int t, int s) const {
        return (const uint8_t*)values + t * tile + s * step;
    }
};

// m x n tiles of floats at `to`, which are added to with `add`.
template <int m, int n>
INLINE void product(const Side& a, int a_first, const Side& b, int b_first, int steps, float* to, size_t down,
                    size_t right, bool add) {
    if (add) {
        _tile_loadd(0, to, 64);
        if (n == 2) _tile_loadd(1, to + right, 64);
        if (m == 2) _tile_loadd(2, to + down, 64);
        if (m == 2 && n == 2) _tile_loadd(3, to + down + right, 64);
    } else {
        _tile_zero(0);
        if (n == 2) _tile_zero(1);
        if (m == 2) _tile_zero(2);
        if (m == 2 && n == 2) _tile_zero(3);
    }
#define EVSPLAT_LEFT(values)                                         \
    _tile_loadd(4, a.at(values, a_first, s), 64);                    \
    if (m == 2) _tile_loadd(5, a.at(values, a_first + 1, s), 64)
#define EVSPLAT_RIGHT(values)                                        \
    _tile_loadd(6, b.at(values, b_first, s), 64);                    \
    if (n == 2) _tile_loadd(7, b.at(values, b_first + 1, s), 64)
#define EVSPLAT_MULTIPLY                                             \
    _tile_dpbf16ps(0, 4, 6);                                         \
    if (n == 2) _tile_dpbf16ps(1, 4, 7);                             \
    if (m == 2) _tile_dpbf16ps(2, 5, 6);                             \
    if (m == 2 && n == 2) _tile_dpbf16ps(3, 5, 7)
    for (int s = 0; s < steps; ++s) {
        EVSPLAT_LEFT(a.low);
        EVSPLAT_RIGHT(b.high);
        EVSPLAT_MULTIPLY;
        EVSPLAT_LEFT(a.high);
        EVSPLAT_MULTIPLY;
        EVSPLAT_RIGHT(b.low);
        EVSPLAT_MULTIPLY;
    }
    _tile_stored(0, to, 64);
    if (n == 2) _tile_stored(1, to + right, 64);
    if (m == 2) _tile_stored(2, to + down, 64);
    if (m == 2 && n == 2) _tile_stored(3, to + down + right, 64);
}

// All tiles of a product, two by two where there are two, added to the result, whose tile (i, j) is at
// `to` + i * 256 + j * right.
INLINE void add_products(const Side& a, int a_tiles, const Side& b, int b_tiles, int steps, float* to, size_t right) {
    settle();
    for (int j = 0; j < b_tiles; j += 2)
        for (int i = 0; i < a_tiles; i += 2) {
            float* c = to + i * kTileFloats + j * right;
            const bool low = i + 1 < a_tiles, wide = j + 1 < b_tiles;
            if (low && wide) product<2, 2>(a, i, b, j, steps, c, kTileFloats, right, true);
            else if (low) product<2, 1>(a, i, b, j, steps, c, kTileFloats, right, true);
            else if (wide) product<1, 2>(a, i, b, j, steps, c, kTileFloats, right, true);
            else product<1, 1>(a, i, b, j, steps, c, kTileFloats, right, true);
        }
}

// 32 rows of a result, at most 32 columns: column `step` * 32 on, rows from `row` on.
struct Piece {
    int step, row;
    bool wide;           // more than 16 columns
    const float* values; // (1 or 2, 32, 16)

    INLINE_MEMBER __m512 at(int r, int panel) const {
        return panel && !wide ? _mm512_setzero_ps()
                              : _mm512_load_ps(values + 2 * kTileFloats * panel + r * kTileSide);
    }
};

// x (R, in) times a packed weight, piece by piece to each(Piece) while that is in the first cache. Doing a piece's work
// beside the next piece's products gains nothing.
template <class Each>
INLINE void rows_times(const Left& x, const uint16_t* weight, int columns, Each each) {
    const Side a = {x.high, x.low(), kTileBytes, kStep * sizeof(uint16_t)};
    const Side b = {weight, weight + kTileValues, x.steps * 2 * kTileBytes, 2 * kTileBytes};
    alignas(64) float result[4 * kTileFloats];
    const int panels = tile_panels(columns);
    for (int j = 0; j < panels; j += 2)
        for (int i = 0; i < kRowTiles; i += 2) {
            const bool wide = j + 1 < panels;
            settle();
            if (wide) product<2, 2>(a, i, b, j, x.steps, result, kTileFloats, 2 * kTileFloats, false);
            else product<2, 1>(a, i, b, j, x.steps, result, kTileFloats, 2 * kTileFloats, false);
            settle();
            each(Piece{j / 2, i * kTileSide, wide, result});
        }
}

// --- Sums over the points ---

// A product y^T x over the points, `kTileSlots` steps of 32 points at a time. Both sides are (panels, slots, high and
// low, a tile); of the left side a row of a tile is a column of y, of the right one it is two points.
struct Outer {
    uint16_t *y, *x;
    int y_panels, x_panels;
    float* sum;  // (x panels, y panels * 16, 16), added to
    int filled;  // slots

    // The tile of high values of one of both sides that has a row of the strip that is next.
    INLINE_MEMBER uint16_t* tile(uint16_t* side, int panel, int row) const {
        return side + (size_t(panel) * kTileSlots + filled + row / kTilePairs) * 2 * kTileValues;
    }
    INLINE_MEMBER void add() {
        const auto all = [](const uint16_t* side) {
            return Side{side, side + kTileValues, kTileSlots * 2 * kTileBytes, 2 * kTileBytes};
        };
        if (filled) add_products(all(y), y_panels, all(x), x_panels, filled, sum, size_t(y_panels) * kTileFloats);
        filled = 0;
    }
    // Room for a strip.
    INLINE_MEMBER void make_room() {
        if (filled + kRowSteps > kTileSlots) add();
    }
};

// Rows of 16 dwords to columns.
INLINE void transpose(__m512i (&v)[16]) {
    __m512i t[16];
#pragma GCC unroll 8
    for (int i = 0; i < 16; i += 2) {
        t[i] = _mm512_unpacklo_epi32(v[i], v[i + 1]);
        t[i + 1] = _mm512_unpackhi_epi32(v[i], v[i + 1]);
    }
#pragma GCC unroll 4
    for (int i = 0; i < 16; i += 4) {
        v[i] = _mm512_unpacklo_epi64(t[i], t[i + 2]);
        v[i + 1] = _mm512_unpackhi_epi64(t[i], t[i + 2]);
        v[i + 2] = _mm512_unpacklo_epi64(t[i + 1], t[i + 3]);
        v[i + 3] = _mm512_unpackhi_epi64(t[i + 1], t[i + 3]);
    }
#pragma GCC unroll 4
    for (int i = 0; i < 4; ++i) {
        const __m512i a = _mm512_shuffle_i32x4(v[i], v[i + 4], 0x88), b = _mm512_shuffle_i32x4(v[i], v[i + 4], 0xdd);
        const __m512i c = _mm512_shuffle_i32x4(v[i + 8], v[i + 12], 0x88);
        const __m512i d = _mm512_shuffle_i32x4(v[i + 8], v[i + 12], 0xdd);
        t[i] = _mm512_shuffle_i32x4(a, c, 0x88), t[i + 8] = _mm512_shuffle_i32x4(a, c, 0xdd);
        t[i + 4] = _mm512_shuffle_i32x4(b, d, 0x88), t[i + 12] = _mm512_shuffle_i32x4(b, d, 0xdd);
    }
#pragma GCC unroll 16
    for (int i = 0; i < 16; ++i) v[i] = t[i];
}

// A gradient to the left sides of the next product and of the one over the points.
struct Spread {
    Left left;
    Outer* outer;

    // 32 rows of a step, of which at(row, panel) gives 16 columns.
    template <class At>
    INLINE_MEMBER void take(int step, int row, bool wide, At at) const {
        __m512i pairs[2][2][kTileSide];  // of both panels high and low
        for (int k = 0; k < kTileSide; ++k) {
            Split even[2], odd[2];
            for (int q = 0; q < 2; ++q) {
                even[q] = split(at(2 * k, q)), odd[q] = split(at(2 * k + 1, q));
                pairs[q][0][k] = beside(even[q].high, odd[q].high);
                pairs[q][1][k] = beside(even[q].low, odd[q].low);
            }
            left.store(step, row + 2 * k, even[0], even[1]);
            left.store(step, row + 2 * k + 1, odd[0], odd[1]);
        }
        for (int q = 0; q < 1 + wide; ++q)
            for (int part = 0; part < 2; ++part) {
                transpose(pairs[q][part]);
                uint16_t* tile = outer->tile(outer->y, 2 * step + q, row) + part * kTileValues;
#pragma GCC unroll 16
                for (int k = 0; k < kTileSide; ++k) _mm512_store_si512(tile + k * kTilePairs, pairs[q][part][k]);
            }
    }
};

// An activation to the left side of the next product and to the right side of the one over the points; either may be
// missing.
struct Activation {
    Left left;
    Outer* outer;

    // Two rows of a step.
    INLINE_MEMBER void store(int step, int row, const Split (&even)[2], const Split (&odd)[2]) const {
        if (left.high) {
            left.store(step, row, even[0], even[1]);
            left.store(step, row + 1, odd[0], odd[1]);
        }
        if (!outer) return;
        for (int q = 0; q < 2 && 2 * step + q < outer->x_panels; ++q) {
            uint16_t* to = outer->tile(outer->x, 2 * step + q, row) + row % kTilePairs * kTileSide;
            _mm512_store_si512(to, beside(even[q].high, odd[q].high));
            _mm512_store_si512(to + kTileValues, beside(even[q].low, odd[q].low));
        }
    }
    // Lanes of a row that are not positive, as in what a leaky ReLU was given.
    INLINE_MEMBER __mmask16 falls(int step, int row, int q) const {
        const uint16_t* tile = outer->tile(outer->x, 2 * step + q, row);
        const __m512i pair = _mm512_load_si512(tile + row % kTilePairs / 2 * kTilePairs);
        const __m512i value = row % 2 ? _mm512_srai_epi32(pair, 16) : _mm512_slli_epi32(pair, 16);
        return _mm512_cmple_epi32_mask(value, _mm512_setzero_si512());
    }
};

// --- Rows in and out ---

INLINE __mmask16 first_lanes(int count) { return count >= kTileSide ? __mmask16(0xffff) : __mmask16((1 << count) - 1); }

struct Rows {
    size_t first, have;  // of the strip; rows behind them are zero
};

INLINE Rows rows_of(size_t first, size_t points) {
    return {first, points - first < size_t(R) ? points - first : size_t(R)};
}

// 16 columns of a row of the strip of (points, columns) floats, zeros behind.
struct Given {
    const float* from;
    Rows rows;
    int columns;

    INLINE_MEMBER __m512 at(int row, int panel) const {
        const int left = columns - panel * kTileSide;
        if (size_t(row) >= rows.have || left <= 0) return _mm512_setzero_ps();
        return _mm512_maskz_loadu_ps(first_lanes(left), from + (rows.first + row) * columns + panel * kTileSide);
    }
};

INLINE void pack(const Given& given, const Activation& to) {
    for (int step = 0; step < to.left.steps; ++step)
        for (int r = 0; r < R; r += 2) {
            const auto row = [&](int r, Split (&both)[2]) {
                for (int q = 0; q < 2; ++q) both[q] = split(given.at(r, 2 * step + q));
            };
            Split even[2], odd[2];
            row(r, even), row(r + 1, odd);
            to.store(step, r, even, odd);
        }
}

// A piece of a result to rows of (points, columns), with `bias` (panels, 16) unless that is null.
INLINE void write(const Piece& piece, const Rows& rows, int columns, const float* bias, float* to) {
    const int end = int(rows.have) - piece.row < kTilePairs ? int(rows.have) - piece.row : kTilePairs;
    for (int q = 0; q < 1 + piece.wide; ++q) {
        const int panel = 2 * piece.step + q;
        const __mmask16 lanes = first_lanes(columns - panel * kTileSide);
        const __m512 add = bias ? _mm512_loadu_ps(bias + panel * kTileSide) : _mm512_setzero_ps();
        float* at = to + (rows.first + piece.row) * columns + panel * kTileSide;
        for (int r = 0; r < end; ++r, at += columns)
            _mm512_mask_storeu_ps(at, lanes, _mm512_add_ps(piece.at(r, q), add));
    }
}

// --- Layers ---

// The slope is at most 1.
INLINE __m512 leaky(__m512 v, __m512 slope) { return _mm512_max_ps(_mm512_mul_ps(v, slope), v); }

// Takes pieces of a block's scratch one behind the other.
struct Scratch {
    uint8_t* next;

    template <class T>
    T* take(size_t count) {
        T* taken = (T*)next;
        next += count * sizeof(T);
        return taken;
    }
    float* floats(int columns) { return take<float>(tile_steps(columns) * 2 * kPanel); }
    Left left(int columns) { return {take<uint16_t>(tile_steps(columns) * 2 * kStep), tile_steps(columns)}; }
    uint16_t* side(int columns) { return take<uint16_t>(tile_panels(columns) * size_t(kTileSlots) * 2 * kTileValues); }
    Outer outer(int y, int x, float* sum) { return {side(y), side(x), tile_panels(y), tile_panels(x), sum, 0}; }
};

// A strip on its way forward: what is the same at all times, and the activations at one of them.
struct Strip {
    const TileJob& job;
    Rows rows;
    float* shared;  // (panels, R, 16), what the points alone give to the first layer
    Activation point, both, hidden[kMlpLayers];

    Strip(const TileJob& j, Scratch& scratch) : job(j) {
        shared = scratch.floats(j.width);
        point = {scratch.left(j.per_point), nullptr}, both = {scratch.left(j.per_both), nullptr};
        for (int l = 0; l < j.layers; ++l) hidden[l] = {l < 2 ? scratch.left(j.width) : hidden[l - 2].left, nullptr};
    }

    INLINE_MEMBER void start(size_t first) {
        rows = rows_of(first, job.points);
        pack({job.point, rows, job.per_point}, point);
        rows_times(point.left, job.point_weight.forward, job.width, [&](const Piece& piece) {
            float* to = shared + 2 * piece.step * kPanel + size_t(piece.row) * kTileSide;
            for (int r = 0; r < kTilePairs; ++r)
                for (int q = 0; q < 2; ++q) _mm512_store_ps(to + q * kPanel + r * kTileSide, piece.at(r, q));
        });
    }

    // The activations at a time; those of the last hidden layer are the last.
    INLINE_MEMBER void hide(size_t t) const {
        const __m512 slope = _mm512_set1_ps(job.slope);
        const int panels = tile_panels(job.width);
        const float* first_bias = job.bias + t * panels * kTileSide;
        const auto activate = [&](const Activation& to, const float* bias, int step, int row, auto at) {
            __m512 add[2];
            for (int q = 0; q < 2; ++q) {
                const int panel = 2 * step + q;
                add[q] = panel < panels ? _mm512_loadu_ps(bias + panel * kTileSide) : _mm512_setzero_ps();
            }
            for (int k = 0; k < kTileSide; ++k) {
                Split even[2], odd[2];
                for (int q = 0; q < 2; ++q) {
                    even[q] = split(leaky(_mm512_add_ps(at(2 * k, q), add[q]), slope));
                    odd[q] = split(leaky(_mm512_add_ps(at(2 * k + 1, q), add[q]), slope));
                }
                to.store(step, row + 2 * k, even, odd);
            }
        };
        const auto of_point = [&](int step, int row, int q) {
            return _mm512_load_ps(shared + (2 * step + q) * kPanel + size_t(row) * kTileSide);
        };
        if (job.both) {
            pack({job.both + t * job.points * job.per_both, rows, job.per_both}, both);
            rows_times(both.left, job.both_weight.forward, job.width, [&](const Piece& p) {
                activate(hidden[0], first_bias, p.step, p.row,
                         [&](int r, int q) { return _mm512_add_ps(p.at(r, q), of_point(p.step, p.row + r, q)); });
            });
        } else {
            for (int step = 0; step < tile_steps(job.width); ++step)
                for (int row = 0; row < R; row += kTilePairs)
                    activate(hidden[0], first_bias, step, row,
                             [&](int r, int q) { return of_point(step, row + r, q); });
        }
        for (int l = 0; l + 1 < job.layers; ++l)
            rows_times(hidden[l].left, job.layer[l].forward, job.width, [&](const Piece& p) {
                activate(hidden[l + 1], job.layer[l].bias, p.step, p.row,
                         [&](int r, int q) { return p.at(r, q); });
            });
    }
};

void forward(const TileJob& j, size_t block, uint8_t* memory, float* output) {
    const Tiles tiles;
    Scratch scratch = {memory};
    Strip strip(j, scratch);
    const int last = j.layers - 1;
    for (size_t first = block * kTileBlock; first < j.points && first < (block + 1) * kTileBlock; first += R) {
        strip.start(first);
        for (size_t t = 0; t < j.times; ++t) {
            strip.hide(t);
            rows_times(strip.hidden[last].left, j.layer[last].forward, j.out, [&](const Piece& p) {
                write(p, strip.rows, j.out, j.layer[last].bias, output + t * j.points * j.out);
            });
        }
    }
}

// 16 sums over rows, added to: of 32 rows of a strip at(row).
template <class At>
INLINE void add_rows(float* sums, At at) {
    __m512 total = _mm512_setzero_ps();
    for (int r = 0; r < kTilePairs; ++r) total = _mm512_add_ps(total, at(r));
    _mm512_storeu_ps(sums, _mm512_add_ps(_mm512_loadu_ps(sums), total));
}

void backward(const TileJob& j, const MlpBackward& wanted, size_t block, const MlpSums& sums, uint8_t* memory) {
    const Tiles tiles;
    Scratch scratch = {memory};
    // What the way forward left is made anew: that takes a third of the time of writing and reading it.
    Strip strip(j, scratch);
    const int last = j.layers - 1;
    float* over_times = scratch.floats(j.width);
    const Left lefts[2] = {scratch.left(j.width > j.out ? j.width : j.out), scratch.left(j.width)};
    Outer outer[kMlpLayers];
    for (int l = 0; l < j.layers; ++l) {
        outer[l] = scratch.outer(j.columns(l), j.width, sums.weight[l]);
        strip.hidden[l].outer = &outer[l];
    }
    strip.hidden[last].left.high = nullptr;
    Outer of_both = scratch.outer(j.width, j.per_both, sums.both_weight);
    Outer of_point = scratch.outer(j.width, j.per_point, sums.point_weight);
    strip.both.outer = &of_both, strip.point.outer = &of_point;
    const __m512 slope = _mm512_set1_ps(j.slope);
    const int panels = tile_panels(j.width);

    for (size_t first = block * kTileBlock; first < j.points && first < (block + 1) * kTileBlock; first += R) {
        of_point.make_room();
        strip.start(first);
        for (size_t t = 0; t < j.times; ++t) {
            for (int l = 0; l < j.layers; ++l) outer[l].make_room();
            of_both.make_room();
            strip.hide(t);
            Spread y = {{lefts[0].high, tile_steps(j.out)}, &outer[last]};
            const Given above = {wanted.output_grad + t * j.points * j.out, strip.rows, j.out};
            for (int step = 0; step < y.left.steps; ++step)
                for (int row = 0; row < R; row += kTilePairs) {
                    const bool wide = 2 * step + 1 < tile_panels(j.out);
                    const auto at = [&](int r, int q) { return above.at(row + r, 2 * step + q); };
                    y.take(step, row, wide, at);
                    for (int q = 0; q < 1 + wide; ++q)
                        add_rows(sums.layer_bias[last] + (2 * step + q) * kTileSide, [&](int r) { return at(r, q); });
                }
            for (int l = last; l >= 0; --l) {
                const Activation& x = strip.hidden[l];
                // To the layer below, or to what is given per point and time; behind the last time to the points.
                Outer* below = l ? &outer[l - 1] : j.both ? &of_both : nullptr;
                const Spread next = {{lefts[(last - l + 1) % 2].high, tile_steps(j.width)}, below};
                float* bias = l ? sums.layer_bias[l - 1] : sums.bias + t * panels * kTileSide;
                rows_times(y.left, j.layer[l].backward, j.width, [&](const Piece& p) {
                    const auto at = [&](int r, int q) {
                        const __m512 v = p.at(r, q);
                        return _mm512_mask_mul_ps(v, x.falls(p.step, p.row + r, q), v, slope);
                    };
                    if (below) next.take(p.step, p.row, p.wide, at);
                    for (int q = 0; q < 1 + p.wide; ++q) {
                        const int panel = 2 * p.step + q;
                        add_rows(bias + panel * kTileSide, [&](int r) { return at(r, q); });
                        if (l) continue;
                        float* to = over_times + panel * kPanel + size_t(p.row) * kTileSide;
                        for (int r = 0; r < kTilePairs; ++r, to += kTileSide)
                            _mm512_store_ps(to, t ? _mm512_add_ps(_mm512_load_ps(to), at(r, q)) : at(r, q));
                    }
                });
                outer[l].filled += kRowSteps;
                y = next;
            }
            if (!j.both) continue;
            of_both.filled += kRowSteps;
            if (wanted.both_grad)
                rows_times(y.left, j.both_weight.backward, j.per_both, [&](const Piece& p) {
                    write(p, strip.rows, j.per_both, nullptr, wanted.both_grad + t * j.points * j.per_both);
                });
        }
        const Spread y = {{lefts[0].high, tile_steps(j.width)}, &of_point};
        for (int step = 0; step < y.left.steps; ++step)
            for (int row = 0; row < R; row += kTilePairs) {
                const auto at = [&](int r, int q) {
                    const int panel = 2 * step + q;
                    return panel < panels ? _mm512_load_ps(over_times + panel * kPanel + size_t(row + r) * kTileSide)
                                          : _mm512_setzero_ps();
                };
                y.take(step, row, 2 * step + 1 < panels, at);
            }
        of_point.filled += kRowSteps;
        if (wanted.point_grad)
            rows_times(y.left, j.point_weight.backward, j.per_point, [&](const Piece& p) {
                write(p, strip.rows, j.per_point, nullptr, wanted.point_grad);
            });
    }
    for (int l = 0; l < j.layers; ++l) outer[l].add();
    of_both.add(), of_point.add();
}

// Value (k, n) at weight[k * k_step + n * n_step], zero behind.
void pack_weight(const float* weight, int rows, int columns, size_t k_step, size_t n_step, uint16_t* to) {
    const __m512i lanes = _mm512_mullo_epi32(
        _mm512_setr_epi32(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15), _mm512_set1_epi32(int(n_step)));
    for (int p = 0; p < tile_panels(columns); ++p)
        for (int s = 0; s < tile_steps(rows); ++s, to += 2 * kTileValues) {
            const auto row = [&](int k) {
                if (k >= rows) return split(_mm512_setzero_ps());
                const float* at = weight + k * k_step + p * kTileSide * n_step;
                const __mmask16 there = first_lanes(columns - p * kTileSide);
                return split(_mm512_mask_i32gather_ps(_mm512_setzero_ps(), there, lanes, at, sizeof(float)));
            };
            for (int k = 0; k < kTileSide; ++k) {
                const Split even = row(s * kTilePairs + 2 * k), odd = row(s * kTilePairs + 2 * k + 1);
                _mm512_store_si512(to + k * kTilePairs, beside(even.high, odd.high));
                _mm512_store_si512(to + kTileValues + k * kTilePairs, beside(even.low, odd.low));
            }
        }
}

}  // namespace

const TileKernels tile_kernels = {forward, backward, pack_weight};

}  // namespace amx
}  // namespace evsplat
