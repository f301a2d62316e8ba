#include "levels.h"

#include <algorithm>
#include <cstdlib>
#include <stdexcept>

#include "tile_mlp_kernels.h"

#ifdef EVSPLAT_AMX
#include <cpuid.h>
#include <sys/syscall.h>
#include <unistd.h>
#endif

namespace evsplat {

#ifdef EVSPLAT_AMX
// Of the processor and, since tiles are eight kilobytes of state that a process must ask for, of the kernel.
static bool has_amx() {
    constexpr unsigned kBf16 = 1u << 22, kTiles = 1u << 24;
    constexpr long kAskForState = 0x1023, kTileData = 18;  // ARCH_REQ_XCOMP_PERM, XFEATURE_XTILEDATA
    unsigned a, b, c, d;
    if (!__get_cpuid_count(7, 0, &a, &b, &c, &d) || (d & (kBf16 | kTiles)) != (kBf16 | kTiles)) return false;
    return syscall(SYS_arch_prctl, kAskForState, kTileData) == 0;
}

// Those of AVX-512 but for the networks.
static Kernels amx_kernels() {
    Kernels kernels = avx512::kernels;
    kernels.name = "amx", kernels.tiles = &amx::tile_kernels;
    return kernels;
}
#endif

std::vector<std::string> available_levels() {
    std::vector<std::string> levels;
#ifdef EVSPLAT_X86
    __builtin_cpu_init();
    if (__builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512dq") &&
        __builtin_cpu_supports("avx512bw") && __builtin_cpu_supports("avx512vl")) {
#ifdef EVSPLAT_AMX
        if (has_amx()) levels.push_back("amx");
#endif
        levels.push_back("avx512");
    }
    if (__builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma") && __builtin_cpu_supports("bmi") &&
        __builtin_cpu_supports("bmi2"))
        levels.push_back("avx2");
#endif
    levels.push_back("portable");
    return levels;
}

const Kernels& select_kernels() {
    static const std::vector<std::string> levels = available_levels();
    const char* asked = std::getenv("EVSPLAT_ISA");
    const std::string level = asked && *asked ? asked : levels.front();
    if (std::find(levels.begin(), levels.end(), level) == levels.end()) {
        std::string known;
        for (const std::string& name : levels) known += (known.empty() ? "" : ", ") + name;
        throw std::runtime_error("EVSPLAT_ISA=" + level + " cannot run here; this CPU and build have " + known);
    }
#ifdef EVSPLAT_AMX
    static const Kernels amx = amx_kernels();
    if (level == "amx") return amx;
#endif
#ifdef EVSPLAT_X86
    if (level == "avx512") return avx512::kernels;
    if (level == "avx2") return avx2::kernels;
#endif
    return portable::kernels;
}

}  // namespace evsplat
