// Python bindings of what a training step computes between networks, rasteriser and losses.

#include "bindings.h"
#include "finite.h"
#include "isometry.h"
#include "picture.h"
#include "posing.h"
#include "shadow.h"
#include "surface_light.h"

using namespace evsplat;

namespace {

using Rows = Strided;  // (T, N, columns): columns together, rows evenly apart
using Index = Array<const int64_t>;
using Bits = nb::ndarray<const uint8_t, nb::ndim<2>, nb::c_contig, nb::device::cpu>;

double py_sum_of_magnitudes(const std::vector<In>& arrays, int threads) {
    std::vector<Values> values;
    for (const In& array : arrays) values.push_back({array.data(), array.size()});
    nb::gil_scoped_release release;
    return sum_of_magnitudes(values, threads);
}

double py_membership(In share, Bits bits, float lowest, std::optional<Out> slope, int threads) {
    const size_t count = share.size(), bytes = (count + 7) / 8;
    require(bits.shape(0) == 2 && bits.shape(1) == bytes, "the masks");
    require(!slope || slope->size() == count, "the slope");
    nb::gil_scoped_release release;
    return membership({share.data(), bits.data(), bits.data() + bytes, lowest, data_of(slope)}, count, threads);
}

void check_ends(Column<const int64_t> ends, size_t count) {
    int64_t last = 0;
    bool ordered = true;
    for (size_t p = 0; p < ends.size(); last = ends.data()[p++]) ordered &= ends.data()[p] >= last;
    require(ordered && size_t(last) == count, "the pictures' ends");
}

Looked looked_at(Array<const int32_t> pixel, Column<const int64_t> ends, size_t area) {
    check_ends(ends, pixel.size());
    bool inside = true;
    for (size_t i = 0; i < pixel.size(); ++i) inside &= uint32_t(pixel.data()[i]) < area;
    require(inside, "the pixels: outside of the picture");
    return {ends.size(), area, pixel.size(), pixel.data(), ends.data()};
}

template <class Planes>
Before before(const Planes& drawn, const Planes& alpha, Array<const int32_t> pixel, Column<const int64_t> ends, In behind) {
    require(drawn.ndim() == 4 && drawn.shape(0) == ends.size() && drawn.shape(1) == 3 && 3 * alpha.size() == drawn.size(),
            "the drawings");
    require(behind.size() == 3 * pixel.size(), "what is behind");
    const Looked looked = looked_at(pixel, ends, drawn.shape(2) * drawn.shape(3));
    return {looked, drawn.data(), alpha.data(), behind.data()};
}

void py_colours_before(In drawn, In alpha, Array<const int32_t> pixel, Column<const int64_t> ends, In behind, Out colours,
                       int threads) {
    const Before job = before(drawn, alpha, pixel, ends, behind);
    require(colours.size() == behind.size(), "the colours");
    nb::gil_scoped_release release;
    colours_before(job, threads, colours.data());
}

void py_colours_before_backward(Array<const int32_t> pixel, Column<const int64_t> ends, In behind, In above, Out by_drawn,
                                Out by_alpha, int threads) {
    const Before job = before(by_drawn, by_alpha, pixel, ends, behind);
    require(above.size() == behind.size(), "the colours' gradient");
    nb::gil_scoped_release release;
    colours_before_backward(job, above.data(), threads, by_drawn.data(), by_alpha.data());
}

void py_misfit(In colours, Column<const int64_t> ends, In image, In weight, float scale, std::optional<Out> slope, Out sums,
               int threads) {
    const size_t count = weight.size();
    require(colours.size() == 3 * count && image.size() == 3 * count && (!slope || slope->size() == 3 * count), "the colours");
    require(sums.size() == ends.size(), "the sums");
    check_ends(ends, count);
    nb::gil_scoped_release release;
    misfit({ends.size(), ends.data(), colours.data(), image.data(), weight.data(), scale, data_of(slope)}, threads, sums.data());
}

std::array<double, 4> py_map_difference(In map, In reference, float floor, int threads) {
    require(map.size() == reference.size(), "the maps");
    nb::gil_scoped_release release;
    const MapDifference d = map_difference(map.data(), reference.data(), floor, map.size(), threads);
    return {d.scale[0], d.scale[1], d.difference, d.along};
}

void py_map_difference_backward(In map, In reference, const std::array<double, 4>& known, float weight, Out grad,
                                int threads) {
    require(map.size() == reference.size() && grad.size() == map.size(), "the maps");
    nb::gil_scoped_release release;
    map_difference_backward(map.data(), reference.data(), {{known[0], known[1]}, known[2], known[3]}, weight,
                            map.size(), threads, grad.data());
}

constexpr size_t kIsometryWidth[7] = {3, 4, 3, 3, 4, 3, 16};

IsometryInputs isometry_inputs(const Index& rows, size_t times, size_t points) {
    require(rows.ndim() == 2 && rows.shape(1) == 1 + kNeighbours, "the rows");
    for (size_t i = 0; i < rows.size(); ++i)
        require(rows.data()[i] >= 0 && size_t(rows.data()[i]) < points, "the rows: outside of the points");
    IsometryInputs in = {};
    in.samples = rows.shape(0), in.times = times, in.points = points, in.rows = rows.data();
    return in;
}

// `arrays`: means, quaternions, scales_log, posed means, posed quaternions, posed scales, transforms.
template <class T>
void check_isometry(const std::vector<Array<T>>& arrays, size_t times, size_t points) {
    require(arrays.size() == 7, "the arrays");
    for (int i = 0; i < 7; ++i)
        require(i < 3 ? arrays[i].size() >= points * kIsometryWidth[i]
                      : arrays[i].size() == times * points * kIsometryWidth[i],
                "an array");
}

std::pair<double, double> py_isometry(Index rows, const std::vector<In>& arrays, Out gradients, int threads) {
    require(arrays.size() == 7 && arrays[3].ndim() == 3, "the arrays");
    const size_t times = arrays[3].shape(0), points = arrays[3].shape(1);
    check_isometry(arrays, times, points);
    IsometryInputs in = isometry_inputs(rows, times, points);
    require(gradients.size() == in.samples * isometry_floats(times), "the gradients");
    in.means = arrays[0].data(), in.quaternions = arrays[1].data(), in.scales_log = arrays[2].data();
    in.posed_means = arrays[3].data(), in.posed_quaternions = arrays[4].data(), in.posed_scales = arrays[5].data();
    in.transforms = arrays[6].data();
    nb::gil_scoped_release release;
    const IsometryMeans means = isometry(in, threads, gradients.data());
    return {means.centers, means.covariances};
}

void py_isometry_write(Index rows, In gradients, float by_centers, float by_covariances, const std::vector<Out>& grads,
                       int threads) {
    require(grads.size() == 7 && grads[3].ndim() == 3, "the gradients");
    const size_t times = grads[3].shape(0), points = grads[3].shape(1), all = grads[0].size() / 3;
    check_isometry(grads, times, points);
    for (int i = 0; i < 3; ++i) require(grads[i].size() == all * kIsometryWidth[i], "the gradients");
    const IsometryInputs in = isometry_inputs(rows, times, points);
    require(gradients.size() == in.samples * isometry_floats(times), "the gradients");
    const IsometryGrads out = {all,
                               grads[0].data(), grads[1].data(), grads[2].data(), grads[3].data(),
                               grads[4].data(), grads[5].data(), grads[6].data()};
    nb::gil_scoped_release release;
    isometry_write(in, gradients.data(), by_centers, by_covariances, threads, out);
}

void py_view_directions(In positions, std::optional<In> transforms, const std::array<float, 3>& center,
                        const std::array<float, 9>& turn, Out directions, int threads) {
    const size_t points = positions.size() / 3;
    require(positions.size() == points * 3 && directions.size() == positions.size(), "the positions");
    require(!transforms || transforms->size() == points * 16, "the transforms");
    ViewDirections job = {points, positions.data(), data_of(transforms), {}, {}, directions.data()};
    for (int i = 0; i < 3; ++i) job.center[i] = center[i];
    for (int i = 0; i < 9; ++i) job.turn[i] = turn[i];
    nb::gil_scoped_release release;
    view_directions(job, threads);
}

size_t py_rows_in_view(In means, In scales, In k, In pose, int width, int height,
                       Array<int64_t> rows) {
    const size_t points = rows.size();
    require(means.size() == points * 3 && scales.size() == points * 3, "the Gaussians");
    require(k.size() == 9 && pose.size() == 16, "the camera");
    nb::gil_scoped_release release;
    return rows_in_view({points, means.data(), scales.data(), k.data(), pose.data(), width, height}, rows.data());
}

// The columns of `to` are those of `values` and the harmonics, in either order.
void py_sh_rows(In directions, In values, Out to, bool values_first, int threads) {
    const size_t points = directions.size() / 3;
    require(to.ndim() >= 1 && directions.size() == points * 3, "the directions");
    const size_t stride = to.shape(to.ndim() - 1);
    require(stride >= kShValues && to.size() == points * stride, "the rows");
    const size_t columns = stride - kShValues;
    require(values.size() == points * columns, "the values");
    float *basis = to.data() + (values_first ? columns : 0), *beside = to.data() + (values_first ? 0 : kShValues);
    nb::gil_scoped_release release;
    sh_rows({points, directions.data(), values.data(), basis, beside, stride, columns}, threads);
}

OneBlob one_blob_job(const In& positions, size_t encoded, int bins) {
    const size_t points = positions.size() / 3;
    require(bins >= 3 && positions.size() == points * 3 && encoded == positions.size() * bins, "the positions");
    return {points, bins, positions.data()};
}

void py_one_blob(In positions, int bins, Out encoded, int threads) {
    const OneBlob job = one_blob_job(positions, encoded.size(), bins);
    nb::gil_scoped_release release;
    one_blob(job, threads, encoded.data());
}

void py_one_blob_backward(In positions, int bins, In above, Out grad, int threads) {
    const OneBlob job = one_blob_job(positions, above.size(), bins);
    require(grad.size() == positions.size(), "the gradient");
    nb::gil_scoped_release release;
    one_blob_backward(job, above.data(), threads, grad.data());
}

using Joints = std::vector<int32_t>;

// Writes `result`: the weights or, with their gradient `above`, that of the logits.
void py_tree_softmax(In given, const std::array<Joints, 4>& tree, std::optional<In> above, Out result, int threads) {
    require(given.ndim() == 2, "the logits");
    const size_t points = given.shape(0), logits = given.shape(1), joints = tree[0].size();
    const auto& [order, parents, gate, divides] = tree;
    require(parents.size() == joints && gate.size() == joints && divides.size() == joints && joints <= logits, "the tree");
    for (size_t j = 0; j < joints; ++j)
        require(order[j] >= 0 && size_t(order[j]) < joints && parents[j] < int(joints) && gate[j] < int(logits) &&
                    (parents[j] < 0 || gate[parents[j]] >= 0),
                "the tree");
    require(!above || above->size() == points * joints, "the gradient");
    require(result.size() == points * (above ? logits : joints), "the result");
    TreeSoftmax job = {points,       int(joints),   int(logits), order.data(), parents.data(), gate.data(),
                       divides.data(), given.data(), nullptr,    given.data(), nullptr};
    job.above = data_of(above);
    (above ? job.grad : job.weights) = result.data();
    nb::gil_scoped_release release;
    tree_softmax(job, threads);
}

ShapeChange shape_change(const In& changes, const In& means, const In& scales_log, const In& quaternions) {
    require(changes.ndim() == 3 && changes.shape(2) >= size_t(kShapeChanges), "the changes");
    const size_t points = changes.shape(1);
    require(means.size() == points * 3 && scales_log.size() == points * 3 && quaternions.size() == points * 4, "the points");
    return {changes.shape(0), points,            int(changes.shape(2)), changes.data(),
            means.data(),     scales_log.data(), quaternions.data()};
}

void py_change_shape(In changes, In means, In scales_log, In quaternions, Out moved, Out scales, Out rotations, Out feature,
                     int threads) {
    const ShapeChange job = shape_change(changes, means, scales_log, quaternions);
    const size_t rows = job.times * job.points;
    require(moved.size() == rows * 3 && scales.size() == rows * 3 && rotations.size() == rows * 4 &&
                feature.size() == rows * (job.columns - kShapeChanges),
            "the results");
    nb::gil_scoped_release release;
    change_shape(job, threads, moved.data(), scales.data(), rotations.data(), feature.data());
}

void py_change_shape_backward(In changes, In means, In scales_log, In quaternions, In scales,
                              const std::vector<std::optional<Rows>>& above, Out changes_grad, Out means_grad,
                              Out scales_grad, Out quaternions_grad, int threads) {
    const ShapeChange job = shape_change(changes, means, scales_log, quaternions);
    const size_t width[4] = {3, 3, 4, size_t(job.columns - kShapeChanges)};
    require(scales.size() == job.times * job.points * 3, "the scales");
    require(changes_grad.size() == changes.size() && means_grad.size() == means.size() &&
                scales_grad.size() == scales_log.size() && quaternions_grad.size() == quaternions.size(),
            "the gradients");
    require(above.size() == 4, "the results' gradients");
    ShapeGrad grads[4] = {};
    for (int i = 0; i < 4; ++i) {
        if (!above[i]) continue;
        const Rows& a = *above[i];
        require(a.ndim() == 3 && a.shape(0) == job.times && a.shape(1) == job.points && a.shape(2) == width[i] &&
                    (a.shape(2) <= 1 || a.stride(2) == 1) && a.stride(1) >= 0 &&
                    (a.shape(0) == 1 || a.stride(0) == a.stride(1) * int64_t(job.points)),
                "a result's gradient");
        grads[i] = {a.data(), size_t(a.stride(1))};
    }
    nb::gil_scoped_release release;
    change_shape_backward(job, scales.data(), grads, threads, changes_grad.data(), means_grad.data(),
                          scales_grad.data(), quaternions_grad.data());
}

SurfaceLight light_on(const In& transforms, const In& normals, const In& places, const In& coefficients,
                      const std::array<float, 3>& center, float radius, const In& lamps, const In& intensities,
                      const std::optional<In>& lit) {
    require(places.ndim() == 3 && places.shape(2) == 3, "the places");
    const size_t times = places.shape(0), points = places.shape(1), count = lamps.size() / 3;
    require(transforms.size() == times * points * 16 && normals.size() == points * 3, "the surface");
    require(coefficients.size() == size_t(kLightCoefficients), "the coefficients");
    require(lamps.size() == count * 3 && intensities.size() == count * 3 && count <= size_t(kMaxLamps), "the lamps");
    const size_t lit_times = lit && lit->ndim() == 3 ? lit->shape(1) : 1;
    require(!lit || (lit->ndim() == 3 && lit->shape(0) == count && (lit_times == 1 || lit_times == times) &&
                     lit->shape(2) == points),
            "the shares of light");
    return {times, points, transforms.data(), normals.data(), places.data(), coefficients.data(),
            {center[0], center[1], center[2]}, radius, int(count), lamps.data(), intensities.data(), data_of(lit),
            lit_times};
}

void py_surface_light(In transforms, In normals, In places, In coefficients, const std::array<float, 3>& center,
                      float radius, In lamps, In intensities, std::optional<In> lit, Out factors, int threads) {
    const SurfaceLight job =
        light_on(transforms, normals, places, coefficients, center, radius, lamps, intensities, lit);
    require(factors.size() == places.size(), "the factors");
    nb::gil_scoped_release release;
    surface_light(job, threads, factors.data());
}

void py_surface_light_backward(In transforms, In normals, In places, In coefficients,
                               const std::array<float, 3>& center, float radius, In lamps, In intensities,
                               std::optional<In> lit, In above, Out sums, std::optional<Out> lit_grad, int threads) {
    const SurfaceLight job =
        light_on(transforms, normals, places, coefficients, center, radius, lamps, intensities, lit);
    require(above.size() == places.size() && sums.size() == light_sums(job.lamps), "the gradients");
    require(!lit_grad || (lit && lit_grad->size() == lit->size()), "the gradient of the shares of light");
    float* to = data_of(lit_grad);
    nb::gil_scoped_release release;
    surface_light_backward(job, above.data(), threads, sums.data(), to);
}

}  // namespace

void evsplat::bind_step(nb::module_& m) {
    m.def("colours_before", &py_colours_before, nb::arg("drawn"), nb::arg("alpha"), nb::arg("pixel"), nb::arg("ends"),
          nb::arg("behind"), nb::arg("colours"), nb::arg("threads"),
          "Colours of drawings before what is behind them, where pictures are looked at.");
    m.def("colours_before_backward", &py_colours_before_backward, nb::arg("pixel"), nb::arg("ends"), nb::arg("behind"),
          nb::arg("above"), nb::arg("by_drawn"), nb::arg("by_alpha"), nb::arg("threads"));
    m.def("misfit", &py_misfit, nb::arg("colours"), nb::arg("ends"), nb::arg("image"), nb::arg("weight"), nb::arg("scale"),
          nb::arg("slope").none(), nb::arg("sums"), nb::arg("threads"),
          "How far colours are from those of pictures: sums of each, and the slopes.");
    m.def("sum_of_magnitudes", &py_sum_of_magnitudes, nb::arg("arrays"), nb::arg("threads"),
          "The sum of the magnitudes of all values, NaN or infinite if one of them is: arrays of any shape.");
    m.def("membership", &py_membership, nb::arg("share"), nb::arg("bits"), nb::arg("lowest"), nb::arg("slope").none(),
          nb::arg("threads"), "Sum of the logarithms of what pixels surely are, by two bit masks, and its slope.");
    m.def("map_difference", &py_map_difference, nb::arg("map"), nb::arg("reference"), nb::arg("floor"),
          nb::arg("threads"), "What map_difference_backward wants of two normalised maps; the third is their distance.");
    m.def("map_difference_backward", &py_map_difference_backward, nb::arg("map"), nb::arg("reference"),
          nb::arg("known"), nb::arg("weight"), nb::arg("grad"), nb::arg("threads"));
    m.def("isometry_floats", &isometry_floats, nb::arg("times"), "Of the gradients of one sample.");
    m.def("isometry", &py_isometry, nb::arg("rows"), nb::arg("arrays"), nb::arg("gradients"), nb::arg("threads"),
          "Mean change of neighbours' distances and covariances; writes the gradients by sample.");
    m.def("isometry_write", &py_isometry_write, nb::arg("rows"), nb::arg("gradients"), nb::arg("by_centers"),
          nb::arg("by_covariances"), nb::arg("grads"), nb::arg("threads"), "The arrays' gradients, from the samples'.");
    m.def("view_directions", &py_view_directions, nb::arg("positions"), nb::arg("transforms").none(),
          nb::arg("center"), nb::arg("turn"), nb::arg("directions"), nb::arg("threads"),
          "Unit vectors from a centre, turned back by transforms and then by one matrix.");
    m.def("rows_in_view", &py_rows_in_view, nb::arg("means"), nb::arg("scales"), nb::arg("K"),
          nb::arg("world_to_camera"), nb::arg("width"), nb::arg("height"), nb::arg("rows"),
          "Writes the rows of Gaussians that a picture may show and returns their number.");
    m.def("sh_rows", &py_sh_rows, nb::arg("directions"), nb::arg("values"), nb::arg("to"), nb::arg("values_first"),
          nb::arg("threads"), "Rows of spherical harmonics of degrees 1 to 3 beside other values.");
    m.def("one_blob", &py_one_blob, nb::arg("positions"), nb::arg("bins"), nb::arg("encoded"), nb::arg("threads"),
          "A bump per coordinate, integrated over equal bins of [0, 1].");
    m.def("one_blob_backward", &py_one_blob_backward, nb::arg("positions"), nb::arg("bins"), nb::arg("above"),
          nb::arg("grad"), nb::arg("threads"));
    m.def("tree_softmax", &py_tree_softmax, nb::arg("logits"), nb::arg("tree"), nb::arg("above").none(),
          nb::arg("result"), nb::arg("threads"), "Weights over the joints of a tree, or the gradient of its logits.");
    m.def("surface_light", &py_surface_light, nb::arg("transforms"), nb::arg("normals"), nb::arg("places"),
          nb::arg("coefficients"), nb::arg("center"), nb::arg("radius"), nb::arg("lamps"), nb::arg("intensities"),
          nb::arg("lit").none(), nb::arg("factors"), nb::arg("threads"), "Light on a surface, a factor on its colours.");
    m.def("surface_light_backward", &py_surface_light_backward, nb::arg("transforms"), nb::arg("normals"),
          nb::arg("places"), nb::arg("coefficients"), nb::arg("center"), nb::arg("radius"), nb::arg("lamps"),
          nb::arg("intensities"), nb::arg("lit").none(), nb::arg("above"), nb::arg("sums"), nb::arg("lit_grad").none(),
          nb::arg("threads"), "Gradients of coefficients, lamps and intensities in a row, and of the shares.");
    m.def("change_shape", &py_change_shape, nb::arg("changes"), nb::arg("means"), nb::arg("scales_log"),
          nb::arg("quaternions"), nb::arg("moved"), nb::arg("scales"), nb::arg("rotations"), nb::arg("feature"),
          nb::arg("threads"), "Moves, scales and turns Gaussians by what a network says.");
    m.def("change_shape_backward", &py_change_shape_backward, nb::arg("changes"), nb::arg("means"),
          nb::arg("scales_log"), nb::arg("quaternions"), nb::arg("scales"), nb::arg("above"), nb::arg("changes_grad"),
          nb::arg("means_grad"), nb::arg("scales_grad"), nb::arg("quaternions_grad"), nb::arg("threads"));
}
