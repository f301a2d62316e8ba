// Binding of the event sensor; evsplat/events/simulator/sensor.py calls it.
#pragma once

#include <nanobind/nanobind.h>

void bind_sensor(nanobind::module_& m);
