// The SIMD levels of this CPU and the kernels in use.
#pragma once

#include <string>
#include <vector>

#include "kernels.h"

namespace evsplat {

// Kernels of the best level this CPU has, or of the one that EVSPLAT_ISA names. Throws
// std::runtime_error where the named level is unknown or the CPU lacks it.
const Kernels& select_kernels();

// Best first.
std::vector<std::string> available_levels();

}  // namespace evsplat
