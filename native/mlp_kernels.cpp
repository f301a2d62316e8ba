// Networks in float32, compiled once per SIMD level.

#include "kernels.h"
#if defined(__x86_64__)
#include <immintrin.h>
#endif

namespace evsplat {
namespace EVSPLAT_LEVEL {
namespace {

#include "simd.h"

#include "mlp_panels.h"

}  // namespace

const MlpKernels mlp_kernels = {W, Single::per, forward<Single>, backward<Single>};

}  // namespace EVSPLAT_LEVEL
}  // namespace evsplat
