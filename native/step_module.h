// Bindings of what a training step does beside networks and rasteriser: losses on pictures, isometry, posing.
#pragma once

#include <nanobind/nanobind.h>

void bind_step(nanobind::module_& m);
