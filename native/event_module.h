// Python bindings of the event decoders; evsplat/events/formats/native.py calls them.
#pragma once

#include <nanobind/nanobind.h>

namespace evsplat {

void bind_events(nanobind::module_& m);

}  // namespace evsplat
