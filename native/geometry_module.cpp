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

}  // namespace

void bind_geometry(nb::module_& m) {
    m.def("fill_triangles", &py_fill_triangles, nb::arg("pixels"), nb::arg("in_front"), nb::arg("faces"),
          nb::arg("mask"), "Sets the pixels whose centre lies in a projected triangle.");
    m.def("spread_points", &py_spread_points, nb::arg("points"), nb::arg("chosen"),
          "Writes rows of points, each the farthest from those before it.");
}

}  // namespace evsplat
