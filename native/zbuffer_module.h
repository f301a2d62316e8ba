#pragma once

#include <nanobind/nanobind.h>

// Adds the z-buffer renderer's classes to the module.
void bind_zbuffer(nanobind::module_&);
