// The SIMD levels of this CPU and the kernels in use.
#pragma once

#include <string>
#include <vector>

#include "kernels.h"

namespace evsplat {

// Kernels of the best level this CPU has, or of the one that EVSPLAT_ISA names. Throws
// std::runtime_error where the named level is unknown or the CPU lacks it.
const Kernels& select_kernels();

// Whether the kernels in use have networks in bfloat16, and these or the usual ones. Throws
// std::runtime_error where bfloat16 is asked for and not there.
bool has_bf16();
const MlpKernels& select_mlp(bool bf16);

// Best first.
std::vector<std::string> available_levels();

}  // namespace evsplat
