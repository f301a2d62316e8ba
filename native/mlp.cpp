#include "mlp.h"

#include <algorithm>
#include <functional>
#include <stdexcept>
#include <utility>

#include "levels.h"
#include "thread_pool.h"

namespace evsplat {
namespace {

constexpr size_t kBlocksPerGroup = 4;  // consecutive blocks share their sums
constexpr size_t kMostGroups = 32;

int panels_of(int columns, int lanes) { return (columns + lanes - 1) / lanes; }

// Matrix (rows, columns), element (r, c) at from[r * row_step + c * column_step], to panels of columns.
void to_panels(const float* from, int rows, int columns, int row_step, int column_step, int lanes, float* to) {
    for (int p = 0; p < panels_of(columns, lanes); ++p)
        for (int r = 0; r < rows; ++r)
            for (int l = 0; l < lanes; ++l, ++to) {
                const int c = p * lanes + l;
                *to = c < columns ? from[size_t(r) * row_step + size_t(c) * column_step] : 0.f;
            }
}

// Copies of matrices that wait for each other's places to be known: made one by one they leave all threads but one idle
// for as long as a small network takes.
using Copies = std::vector<std::function<void()>>;

void make(const Copies& copies, int threads) {
    parallel_for(threads, copies.size(), [&](size_t i) { copies[i](); });
}

// Hands out consecutive pieces of one buffer; without one it counts their floats.
struct Pieces {
    float* buffer = nullptr;
    size_t taken = 0;

    float* take(size_t count) {
        taken += count;
        return buffer ? buffer + taken - count : nullptr;
    }
};

size_t weight_floats(int out, int in, int lanes) {
    return size_t(panels_of(out, lanes)) * lanes * (in + 1) + size_t(panels_of(in, lanes)) * lanes * out;
}

MlpWeight pack_weight(const float* weight, const float* bias, int out, int in, int lanes, Pieces& pieces, Copies& copies) {
    float* forward = pieces.take(size_t(panels_of(out, lanes)) * lanes * in);
    float* backward = pieces.take(size_t(panels_of(in, lanes)) * lanes * out);
    float* padded = pieces.take(size_t(panels_of(out, lanes)) * lanes);
    copies.push_back([=] { to_panels(weight, in, out, 1, in, lanes, forward); });
    copies.push_back([=] { to_panels(weight, out, in, in, 1, lanes, backward); });
    if (bias) to_panels(bias, 1, out, 0, 1, lanes, padded);
    return {forward, backward, padded};
}

MlpSums sums_in(const MlpShape& s, Pieces& pieces) {
    const size_t width = size_t(s.width_panels) * s.lanes;
    MlpSums sums = {};
    sums.point_weight = pieces.take(width * s.point_panels * s.lanes);
    sums.both_weight = pieces.take(width * s.both_panels * s.lanes);
    sums.bias = pieces.take(s.times * width);
    for (int l = 0; l < s.layers; ++l) {
        const size_t rows = size_t(s.panels(l)) * s.lanes;
        sums.weight[l] = pieces.take(rows * width);
        sums.layer_bias[l] = pieces.take(rows);
    }
    return sums;
}

// Sums (in panels, padded out rows, lanes) to a gradient (out, in).
void from_panels(const float* from, int out, int in, int lanes, float* to) {
    const int rows = panels_of(out, lanes) * lanes;
    for (int o = 0; o < out; ++o)
        for (int i = 0; i < in; i += lanes)
            std::copy_n(from + (size_t(i / lanes) * rows + o) * lanes, std::min(lanes, in - i), to + size_t(o) * in + i);
}

}  // namespace

Mlp::Mlp(const MlpInputs& inputs, bool keep, int threads)
    : in_(inputs), threads_(threads), kernels_(select_kernels()), shape_() {
    if (in_.weights.size() > kMlpLayers) throw std::runtime_error("an MLP of more than 16 layers");
    MlpShape& s = shape_;
    const size_t rows = kernels_.tiles ? kTileBlock : kMlpRows;
    s.points = in_.points, s.times = in_.times, s.blocks = (in_.points + rows - 1) / rows;
    s.lanes = kernels_.lanes, s.layers = int(in_.weights.size());
    s.per_point = in_.per_point, s.per_both = in_.both ? in_.per_both : 0;
    s.width = in_.width, s.out = in_.out;
    s.point_panels = panels_of(s.per_point, s.lanes), s.both_panels = panels_of(s.per_both, s.lanes);
    s.width_panels = panels_of(s.width, s.lanes), s.out_panels = panels_of(s.out, s.lanes);
    s.slope = in_.slope, s.keep = keep;
}

// The weights as the kernels take them, for both directions.
static MlpForward pack_weights(const MlpInputs& in, const MlpShape& s, int threads, Buffer<float>& packed) {
    size_t floats = weight_floats(s.width, s.per_point, s.lanes) + weight_floats(s.width, s.per_both, s.lanes) +
                    s.times * s.width_panels * s.lanes;
    for (int l = 0; l < s.layers; ++l) floats += weight_floats(s.columns(l), s.width, s.lanes);
    packed.reset(floats);
    Pieces pieces{packed.data()};
    Copies copies;
    MlpForward job = {};
    job.point = in.point, job.both = in.both;
    job.point_weight = pack_weight(in.point_weight, nullptr, s.width, s.per_point, s.lanes, pieces, copies);
    job.both_weight = pack_weight(in.both_weight, nullptr, s.width, s.per_both, s.lanes, pieces, copies);
    for (int l = 0; l < s.layers; ++l)
        job.layer[l] = pack_weight(in.weights[l], in.biases[l], s.columns(l), s.width, s.lanes, pieces, copies);
    make(copies, threads);
    float* bias = pieces.take(s.times * s.width_panels * s.lanes);
    for (size_t t = 0; t < s.times; ++t)
        to_panels(in.bias + t * s.width, 1, s.width, 0, 1, s.lanes, bias + t * s.width_panels * s.lanes);
    job.bias = bias;
    return job;
}

// The weights as AMX takes them, behind them the biases.
static TileJob pack_tiles(const MlpInputs& in, const MlpShape& s, const TileKernels& kernels, Buffer<uint16_t>& tiles,
                          Buffer<float>& biases) {
    const auto values = [](int out, int in) {
        const size_t forward = size_t(tile_panels(out)) * tile_steps(in);
        return 2 * kTileValues * (forward + size_t(tile_panels(in)) * tile_steps(out));
    };
    size_t count = values(s.width, s.per_point) + values(s.width, s.per_both);
    size_t floats = s.times * s.width_panels * s.lanes;
    for (int l = 0; l < s.layers; ++l)
        count += values(s.columns(l), s.width), floats += size_t(s.panels(l)) * s.lanes;
    tiles.reset(count), biases.reset(floats);

    uint16_t* to = tiles.data();
    const auto pack = [&](const float* weight, int out, int in) {
        TileWeight packed = {to, nullptr, nullptr};
        kernels.pack_weight(weight, in, out, 1, in, to);
        to += 2 * kTileValues * tile_panels(out) * tile_steps(in);
        packed.backward = to;
        kernels.pack_weight(weight, out, in, in, 1, to);
        to += 2 * kTileValues * tile_panels(in) * tile_steps(out);
        return packed;
    };
    float* bias = biases.data();
    const auto pad = [&](const float* from, int columns) {
        to_panels(from, 1, columns, 0, 1, s.lanes, bias);
        return std::exchange(bias, bias + size_t(panels_of(columns, s.lanes)) * s.lanes);
    };
    TileJob job = {s};
    job.point = in.point, job.both = in.both;
    job.point_weight = pack(in.point_weight, s.width, s.per_point);
    job.both_weight = pack(in.both_weight, s.width, s.per_both);
    for (int l = 0; l < s.layers; ++l) {
        job.layer[l] = pack(in.weights[l], s.columns(l), s.width);
        job.layer[l].bias = pad(in.biases[l], s.columns(l));
    }
    job.bias = bias;
    for (size_t t = 0; t < s.times; ++t) pad(in.bias + t * s.width, s.width);
    return job;
}

void Mlp::forward(float* output) {
    if (kernels_.tiles) {
        tile_job_ = pack_tiles(in_, shape_, *kernels_.tiles, tiles_, packed_);
        parallel_for(threads_, shape_.blocks, [&](size_t block) {
            Buffer<uint8_t> scratch(tile_scratch(tile_job_));
            kernels_.tiles->forward(tile_job_, block, scratch.data(), output);
        });
        return;
    }
    job_ = pack_weights(in_, shape_, threads_, packed_);
    if (shape_.keep) activations_.reset(shape_.blocks * shape_.times * shape_.kept());
    job_.activations = activations_.data(), job_.output = output;
    parallel_for(threads_, shape_.blocks, [&](size_t block) {
        Buffer<float> scratch(mlp_scratch(shape_));
        kernels_.mlp_forward(shape_, job_, block, scratch.data());
    });
}

void Mlp::backward(const float* output_grad, const MlpGrads& grads) {
    const MlpShape& s = shape_;
    if (!s.keep) throw std::runtime_error("backward of an MLP that kept nothing");
    const MlpBackward job = {job_, output_grad, grads.point, grads.both};

    // On AMX as many points a group, since blocks are twice as large.
    const size_t per_group = kernels_.tiles ? kBlocksPerGroup / 2 : kBlocksPerGroup;
    size_t groups = std::max<size_t>(1, std::min(kMostGroups, s.blocks / per_group));
    if (groups > 4) groups -= groups % 4;  // as many for each of two or four threads
    Pieces counted;
    sums_in(s, counted);
    const size_t floats = counted.taken;
    Buffer<float> sums(groups * floats);
    parallel_for(threads_, groups, [&](size_t group) {
        Buffer<float> scratch(kernels_.tiles ? tile_scratch(tile_job_) / sizeof(float) : mlp_scratch(s));
        Pieces mine{sums.data() + group * floats};
        std::fill_n(mine.buffer, floats, 0.f);
        const MlpSums parts = sums_in(s, mine);
        for (size_t block = s.blocks * group / groups; block < s.blocks * (group + 1) / groups; ++block)
            if (kernels_.tiles)
                kernels_.tiles->backward(tile_job_, job, block, parts, reinterpret_cast<uint8_t*>(scratch.data()));
            else
                kernels_.mlp_backward(s, job, block, parts, scratch.data());
    });
    // Pieces of the vector of sums, each over the groups in order.
    in_pieces(threads_, floats, 4096, [&](size_t begin, size_t end) {
        for (size_t group = 1; group < groups; ++group)
            for (size_t i = begin; i < end; ++i) sums[i] += sums[group * floats + i];
    });
    Pieces first{sums.data()};
    const MlpSums total = sums_in(s, first);
    Copies copies;
    const auto copy = [&](const float* from, int out, int in, float* to) {
        copies.push_back([=, &s] { from_panels(from, out, in, s.lanes, to); });
    };
    copy(total.point_weight, s.width, s.per_point, grads.point_weight);
    if (in_.both) copy(total.both_weight, s.width, s.per_both, grads.both_weight);
    for (size_t t = 0; t < s.times; ++t)
        std::copy_n(total.bias + t * s.width_panels * s.lanes, s.width, grads.bias + t * s.width);
    for (int l = 0; l < s.layers; ++l) {
        copy(total.weight[l], s.columns(l), s.width, grads.weights[l]);
        std::copy_n(total.layer_bias[l], s.columns(l), grads.biases[l]);
    }
    make(copies, threads_);
}

}  // namespace evsplat
