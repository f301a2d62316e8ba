#include "levels.h"

#include <algorithm>
#include <cstdlib>
#include <stdexcept>

namespace evsplat {

std::vector<std::string> available_levels() {
    std::vector<std::string> levels;
#ifdef EVSPLAT_X86
    __builtin_cpu_init();
    if (__builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512dq") &&
        __builtin_cpu_supports("avx512bw") && __builtin_cpu_supports("avx512vl"))
        levels.push_back("avx512");
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
#ifdef EVSPLAT_X86
    if (level == "avx512") return avx512::kernels;
    if (level == "avx2") return avx2::kernels;
#endif
    return portable::kernels;
}

}  // namespace evsplat
