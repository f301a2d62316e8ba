// Python bindings of geometry.h, which evsplat/body and evsplat/neighbours call.

#include "bindings.h"
#include "geometry.h"

namespace evsplat {
namespace {

using Rows = nb::ndarray<const int64_t, nb::ndim<2>, nb::c_contig, nb::device::cpu>;
using Points = nb::ndarray<const double, nb::ndim<2>, nb::c_contig, nb::device::cpu>;
using Mask = nb::ndarray<uint8_t, nb::ndim<2>, nb::c_contig, nb::device::cpu>;

void py_fill_triangles(Points pixels, Column<const uint8_t> in_front, Rows faces, Mask mask) {
    const size_t vertices = pixels.shape(0);
    require(pixels.shape(1) == 2 && in_front.size() == vertices && faces.shape(1) == 3, "the mesh");
    for (size_t i = 0; i < faces.size(); ++i)
        require(faces.data()[i] >= 0 && size_t(faces.data()[i]) < vertices, "the faces: outside of the vertices");
    nb::gil_scoped_release release;
    fill_triangles({pixels.data(), in_front.data(), faces.data(), faces.shape(0)}, mask.data(), mask.shape(0),
                   mask.shape(1));
}

void py_spread_points(In points, Column<int64_t> chosen) {
    require(points.ndim() == 2 && points.shape(1) == 3 && points.shape(0) > 0, "the points");
    nb::gil_scoped_release release;
    spread_points(points.data(), points.shape(0), chosen.data(), chosen.size());
}

TurnedNormals turned_normals(In linear, In normals, In light) {
    require(linear.ndim() == 4 && linear.shape(2) == 3 && linear.shape(3) == 3, "the matrices");
    require(normals.ndim() == 2 && normals.shape(0) == linear.shape(1) && normals.shape(1) == 3, "the normals");
    require(light.ndim() == 1 && light.shape(0) == 8, "the light");
    return {linear.data(), normals.data(), light.data(), linear.shape(0), linear.shape(1)};
}

void py_shade_normals(In linear, In normals, In light, Out brightness) {
    const TurnedNormals given = turned_normals(linear, normals, light);
    require(brightness.size() == given.times * given.count, "the brightness");
    nb::gil_scoped_release release;
    shade_normals(given, brightness.data());
}

void py_shade_normals_backward(In linear, In normals, In light, In above, std::optional<Out> by_linear, Out by_light) {
    const TurnedNormals given = turned_normals(linear, normals, light);
    require(above.size() == given.times * given.count && by_light.size() == 8, "the gradients");
    require(!by_linear || by_linear->size() == linear.size(), "the matrices' gradient");
    nb::gil_scoped_release release;
    shade_normals_backward(given, above.data(), by_linear ? by_linear->data() : nullptr, by_light.data());
}

}  // namespace

void bind_geometry(nb::module_& m) {
    m.def("fill_triangles", &py_fill_triangles, nb::arg("pixels"), nb::arg("in_front"), nb::arg("faces"),
          nb::arg("mask"), "Sets the pixels whose centre lies in a projected triangle.");
    m.def("spread_points", &py_spread_points, nb::arg("points"), nb::arg("chosen"),
          "Writes rows of points, each the farthest from those before it.");
    m.def("shade_normals", &py_shade_normals, nb::arg("linear"), nb::arg("normals"), nb::arg("light"),
          nb::arg("brightness"), "Brightness of turned normals by harmonics of first and second order.");
    m.def("shade_normals_backward", &py_shade_normals_backward, nb::arg("linear"), nb::arg("normals"),
          nb::arg("light"), nb::arg("above"), nb::arg("by_linear").none(), nb::arg("by_light"));
}

}  // namespace evsplat
