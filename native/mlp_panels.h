// Networks on panel matrices, for one block of points. Included by the kernels of networks only, inside
// their namespace, behind simd.h; nothing here may have external linkage.

constexpr int kTileRows = W == 16 ? 8 : 4;  // with two panels: half of the registers hold sums
constexpr int R = kMlpRows;
constexpr size_t kPanel = size_t(R) * W;
static_assert(R % kTileRows == 0, "a block is a whole number of tiles");

template <int n>
struct Count {
    static constexpr int value = n;
};

// Hidden values of one block in the two layouts that products want: `columns` as the left side of x W,
// `rows` as either side of y^T x. They may be one and the same.
template <class Element>
struct Hidden {
    Element *columns, *rows;
};

// What a product is made of: `per` values along the summed axis in one element. Of float32 one, and both
// layouts of hidden values are the same panels.
struct Single {
    typedef float Element;
    static constexpr int per = 1;
    static F load(const float* p) { F v; __builtin_memcpy(&v, p, sizeof v); return v; }
    static F add(F sum, float a, F b) { return sum + splat(a) * b; }
    static F add_values(F sum, F b) { return sum + b; }

    // Where a layer's values go: to `own`, and on to `kept` if it is there.
    static Hidden<float> place(float* own, float* kept) { return {own, kept ? kept : own}; }
    // A matrix in `memory`.
    static Hidden<float> matrix(float* memory, int) { return {memory, memory}; }
    // The same of panels that are there already.
    static Hidden<float> from_panels(float* panels, float*, int) { return {panels, panels}; }

    // Rows (row, row + 1) of panel p, to a matrix and from its `rows`; `keep_rows` to what forward keeps.
    static void keep_rows(const Hidden<float>& to, int p, int row, F a, F b) {
        const size_t at = p * kPanel + row * W;
        store(to.columns + at, a), store(to.columns + at + W, b);
        if (to.rows != to.columns) stream(to.rows + at, a), stream(to.rows + at + W, b);
    }
    static void store_rows(const Hidden<float>& to, int p, int row, F a, F b) {
        float* at = to.rows + p * kPanel + row * W;
        store(at, a), store(at + W, b);
    }
    static void load_rows(const float* rows, int p, int row, F& a, F& b) {
        const float* at = rows + p * kPanel + row * W;
        a = load(at), b = load(at + W);
    }
};

// sums[p][i] += sum over k of a(i, k) * b(k, panel p). Element a(i, k) is at
// a + (k / inner) * outer_step + (k % inner) * k_step + i * i_step.
template <class Kind, int panels, int i_step, int k_step>
INLINE void multiply(F (&sums)[2][kTileRows], const typename Kind::Element* a, size_t outer_step, int inner, int count,
                     const typename Kind::Element* b, size_t b_step) {
    for (int done = 0; done < count; done += inner, a += outer_step) {
        const int n = count - done < inner ? count - done : inner;
        for (int k = 0; k < n; ++k, b += W) {
            const auto b0 = Kind::load(b), b1 = Kind::load(panels == 2 ? b + b_step : b);
#pragma GCC unroll 8
            for (int i = 0; i < kTileRows; ++i) {
                const auto x = a[k * k_step + i * i_step];
                sums[0][i] = Kind::add(sums[0][i], x, b0);
                if (panels == 2) sums[1][i] = Kind::add(sums[1][i], x, b1);
            }
        }
    }
}

// For every tile of a (rows, columns) result: start(p, row) -> F, then the product, then
// end(p, row, F, F) for two rows. `x` (R, count) in panels times `w` (panels of the result, count, lanes).
template <class Kind, class Start, class End>
INLINE void rows_times(const typename Kind::Element* x, int count, const typename Kind::Element* w, int panels,
                       Start start, End end) {
    constexpr int inner = W / Kind::per;
    const size_t step = size_t(count) * W;
    const auto tile = [&](auto together, int p, int row) {
        constexpr int n = decltype(together)::value;
        F sums[2][kTileRows];
        for (int q = 0; q < n; ++q)
#pragma GCC unroll 8
            for (int i = 0; i < kTileRows; ++i) sums[q][i] = start(p + q, row + i);
        multiply<Kind, n, inner, 1>(sums, x + size_t(row) * inner, kPanel / Kind::per, inner, count, w + p * step, step);
        for (int q = 0; q < n; ++q)
#pragma GCC unroll 4
            for (int i = 0; i < kTileRows; i += 2) end(p + q, row + i, sums[q][i], sums[q][i + 1]);
    };
    int p = 0;
    for (; p + 2 <= panels; p += 2)
        for (int row = 0; row < R; row += kTileRows) tile(Count<2>{}, p, row);
    if (p < panels)
        for (int row = 0; row < R; row += kTileRows) tile(Count<1>{}, p, row);
}

// An end of rows_times: the result to panels.
INLINE auto to_panels(float* to) {
    return [to](int p, int row, F a, F b) {
        store(to + p * kPanel + row * W, a);
        store(to + p * kPanel + row * W + W, b);
    };
}

// sum (x panels, y columns, lanes) += y^T x over the rows of both; y has `y_panels`.
template <class Kind>
INLINE void add_outer(const typename Kind::Element* y, int y_panels, const typename Kind::Element* x, int x_panels,
                      float* sum) {
    constexpr int rows = R / Kind::per;
    constexpr size_t panel = kPanel / Kind::per;
    const int columns = y_panels * W;
    const auto tile = [&](auto together, int p, int column) {
        constexpr int n = decltype(together)::value;
        F sums[2][kTileRows];
        float* c = sum + (size_t(p) * columns + column) * W;
        const size_t step = size_t(columns) * W;
        for (int q = 0; q < n; ++q)
#pragma GCC unroll 8
            for (int i = 0; i < kTileRows; ++i) sums[q][i] = load(c + q * step + i * W);
        multiply<Kind, n, 1, W>(sums, y + (column / W) * panel + column % W, 0, rows, rows, x + p * panel, panel);
        for (int q = 0; q < n; ++q)
#pragma GCC unroll 8
            for (int i = 0; i < kTileRows; ++i) store(c + q * step + i * W, sums[q][i]);
    };
    int p = 0;
    for (; p + 2 <= x_panels; p += 2)
        for (int column = 0; column < columns; column += kTileRows) tile(Count<2>{}, p, column);
    if (p < x_panels)
        for (int column = 0; column < columns; column += kTileRows) tile(Count<1>{}, p, column);
}

template <class Kind>
INLINE void add_column_sums(const typename Kind::Element* x, int panels, float* sum) {
    for (int p = 0; p < panels; ++p, x += kPanel / Kind::per) {
        F total = load(sum + p * W);
        for (int r = 0; r < R / Kind::per; ++r) total = Kind::add_values(total, Kind::load(x + r * W));
        store(sum + p * W, total);
    }
}

INLINE F leaky(F v, F slope) { return select(v > 0.f, v, v * slope); }

// Back through the leaky ReLU that gave `activation`, which has the sign of its input.
INLINE F leaky_slope(F activation, F v, F slope) { return select(activation > 0.f, v, v * slope); }

// Rows [first, first + R) of (rows, columns) to panels; rows and columns beyond the end are zero.
void pack(const float* from, size_t first, size_t rows, int columns, int panels, float* to) {
    const size_t have = rows - first < size_t(R) ? rows - first : R;
    for (int p = 0; p < panels; ++p) {
        const int n = columns - p * W < W ? columns - p * W : W;
        float* panel = to + p * kPanel;
        for (size_t r = 0; r < have; ++r) {
            const float* source = from + (first + r) * columns + p * W;
            float* target = panel + r * W;
            if (n == W) {
                store(target, load(source));
            } else {
                for (int l = 0; l < n; ++l) target[l] = source[l];
                for (int l = n; l < W; ++l) target[l] = 0.f;
            }
        }
        for (size_t r = have; r < size_t(R); ++r) store(panel + r * W, F{});
    }
}

void unpack(const float* from, size_t first, size_t rows, int columns, float* to) {
    const size_t have = rows - first < size_t(R) ? rows - first : R;
    for (int p = 0; p * W < columns; ++p) {
        const int n = columns - p * W < W ? columns - p * W : W;
        for (size_t r = 0; r < have; ++r) {
            const float* source = from + p * kPanel + r * W;
            float* target = to + (first + r) * columns + p * W;
            if (n == W) {
                store(target, load(source));
            } else {
                for (int l = 0; l < n; ++l) target[l] = source[l];
            }
        }
    }
}

// The gradient `y` of the first layer at one time, to its bias and to what is given per point and time.
INLINE void to_first_layer(const MlpShape& s, const MlpBackward& job, size_t first, size_t t, const float* y,
                           float* both, const MlpSums& sums) {
    const MlpForward& f = job.forward;
    add_column_sums<Single>(y, s.width_panels, sums.bias + t * s.width_panels * W);
    if (!f.both) return;
    const size_t offset = t * s.points * s.per_both;
    pack(f.both + offset, first, s.points, s.per_both, s.both_panels, both);
    add_outer<Single>(y, s.width_panels, both, s.both_panels, sums.both_weight);
    if (!job.both_grad) return;
    const auto zero = [](int, int) { return F{}; };
    rows_times<Single>(y, s.width, f.both_weight.backward, s.both_panels, zero, to_panels(both));
    unpack(both, first, s.points, s.per_both, job.both_grad + offset);
}

// The sum `y` of that gradient over the times, to what is given per point; `point` holds that.
INLINE void to_points(const MlpShape& s, const MlpBackward& job, size_t first, const float* y, float* point,
                      const MlpSums& sums) {
    add_outer<Single>(y, s.width_panels, point, s.point_panels, sums.point_weight);
    if (!job.point_grad) return;
    const auto zero = [](int, int) { return F{}; };
    rows_times<Single>(y, s.width, job.forward.point_weight.backward, s.point_panels, zero, to_panels(point));
    unpack(point, first, s.points, s.per_point, job.point_grad);
}

// One block of points through all layers. The first layer is in float32 whatever the Kind.
template <class Kind>
void forward(const MlpShape& s, const MlpForward& job, size_t block, float* scratch) {
    typedef typename Kind::Element Element;
    const size_t first = block * R, matrix = s.width_panels * kPanel / Kind::per;
    const F slope = splat(s.slope);
    float* point = scratch;
    float* both = point + s.point_panels * kPanel;
    float* shared = both + s.both_panels * kPanel;
    float* result = shared + s.width_panels * kPanel;
    Element* turns = (Element*)(result + s.out_panels * kPanel);  // two matrices, used in turn

    pack(job.point, first, s.points, s.per_point, s.point_panels, point);
    const auto zero = [](int, int) { return F{}; };
    rows_times<Single>(point, s.per_point, job.point_weight.forward, s.width_panels, zero, to_panels(shared));
    for (size_t t = 0; t < s.times; ++t) {
        Element* kept = s.keep ? (Element*)(job.activations + (block * s.times + t) * s.kept()) : nullptr;
        const auto place = [&](int layer) {
            return Kind::place(turns + layer % 2 * matrix, kept ? kept + layer * matrix : nullptr);
        };
        const auto into = [&](int layer) {
            return [to = place(layer), slope](int p, int r, F a, F b) {
                Kind::keep_rows(to, p, r, leaky(a, slope), leaky(b, slope));
            };
        };
        const float* bias = job.bias + t * s.width_panels * W;
        const auto start = [&](int p, int r) { return load(shared + p * kPanel + r * W) + load(bias + p * W); };
        if (job.both) {
            pack(job.both + t * s.points * s.per_both, first, s.points, s.per_both, s.both_panels, both);
            rows_times<Single>(both, s.per_both, job.both_weight.forward, s.width_panels, start, into(0));
        } else {
            for (int p = 0; p < s.width_panels; ++p)
                for (int r = 0; r < R; r += 2) into(0)(p, r, start(p, r), start(p, r + 1));
        }
        const int count = (s.width + Kind::per - 1) / Kind::per;
        for (int l = 0; l < s.layers; ++l) {
            const MlpWeight& w = job.layer[l];
            const Element* weight = (const Element*)w.forward;
            const auto from_bias = [&](int p, int) { return load(w.bias + p * W); };
            if (l + 1 == s.layers)
                rows_times<Kind>(place(l).columns, count, weight, s.out_panels, from_bias, to_panels(result));
            else
                rows_times<Kind>(place(l).columns, count, weight, s.width_panels, from_bias, into(l + 1));
        }
        unpack(result, first, s.points, s.out, job.output + t * s.points * s.out);
    }
}

// The gradient of one block.
template <class Kind>
void backward(const MlpShape& s, const MlpBackward& job, size_t block, const MlpSums& sums, float* scratch) {
    typedef typename Kind::Element Element;
    const MlpForward& f = job.forward;
    const size_t first = block * R, matrix = s.width_panels * kPanel;
    const F slope = splat(s.slope);
    float* point = scratch;
    float* both = point + s.point_panels * kPanel;
    float* above = both + s.both_panels * kPanel;
    float* top = above + s.out_panels * kPanel;
    float* flow = top + s.out_panels * kPanel;  // at the first layer
    float* over_times = flow + matrix;
    float* turns = over_times + matrix;         // two matrices, used in turn

    const auto zero = [](int, int) { return F{}; };
    pack(f.point, first, s.points, s.per_point, s.point_panels, point);
    for (size_t t = 0; t < s.times; ++t) {
        const Element* kept = (const Element*)(f.activations + (block * s.times + t) * s.kept());
        pack(job.output_grad + t * s.points * s.out, first, s.points, s.out, s.out_panels, above);
        Hidden<Element> y = Kind::from_panels(above, top, s.out_panels);
        for (int l = s.layers - 1; l >= 0; --l) {
            const Element* x = kept + l * matrix / Kind::per;
            const Hidden<Element> next = Kind::matrix(turns + l % 2 * matrix, s.width_panels);
            add_outer<Kind>(y.rows, s.panels(l), x, s.width_panels, sums.weight[l]);
            add_column_sums<Kind>(y.rows, s.panels(l), sums.layer_bias[l]);
            const auto end = [&](int p, int r, F a, F b) {
                F seen_a, seen_b;
                Kind::load_rows(x, p, r, seen_a, seen_b);
                a = leaky_slope(seen_a, a, slope), b = leaky_slope(seen_b, b, slope);
                if (l)
                    Kind::store_rows(next, p, r, a, b);
                else
                    to_panels(flow)(p, r, a, b);
            };
            const int count = (s.columns(l) + Kind::per - 1) / Kind::per;
            rows_times<Kind>(y.columns, count, (const Element*)f.layer[l].backward, s.width_panels, zero, end);
            y = next;
        }
        to_first_layer(s, job, first, t, flow, both, sums);
        for (size_t i = 0; i < matrix; i += W)
            store(over_times + i, t ? load(over_times + i) + load(flow + i) : load(flow + i));
    }
    to_points(s, job, first, over_times, point, sums);
}
