// What the files of Python bindings share.
#pragma once

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/array.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/pair.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/tuple.h>
#include <nanobind/stl/unique_ptr.h>
#include <nanobind/stl/vector.h>

#include <optional>
#include <stdexcept>
#include <string>

namespace nb = nanobind;

namespace evsplat {

template <class T>
using Array = nb::ndarray<T, nb::c_contig, nb::device::cpu>;
template <class T>
using Column = nb::ndarray<T, nb::ndim<1>, nb::c_contig, nb::device::cpu>;
using In = Array<const float>;
using Out = Array<float>;
using Strided = nb::ndarray<const float, nb::device::cpu>;

// Shapes of arrays; Python has checked the meaning, this guards memory.
inline void require(bool ok, const char* what) {
    if (!ok) throw std::invalid_argument(std::string("evsplat._native: bad shape of ") + what);
}

inline const float* data_of(const std::optional<In>& array) { return array ? array->data() : nullptr; }
inline float* data_of(const std::optional<Out>& array) { return array ? array->data() : nullptr; }

void bind_events(nb::module_&);
void bind_geometry(nb::module_&);
void bind_sensor(nb::module_&);
void bind_shadow(nb::module_&);
void bind_step(nb::module_&);
void bind_zbuffer(nb::module_&);

}  // namespace evsplat
