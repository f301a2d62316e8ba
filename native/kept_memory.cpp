#include "kept_memory.h"

#include <cstdint>
#include <cstdlib>

#if defined(__GLIBC__)
#include <malloc.h>
#include <sys/mman.h>
#endif

namespace evsplat {

#if defined(__GLIBC__)

static constexpr int kKept = 512 << 20;
// The most that the heap may hold as one array, as it would be by itself in the end; larger ones, which leave gaps
// that the next does not fit, come from the system and go back.
static constexpr int kLargest = 32 << 20;

// What the heap grows by is freed again and stays at its end, unused and so without memory, until it is asked for.
static void grow_in_huge_pages() {
#if defined(MADV_HUGEPAGE)
    constexpr uintptr_t kHugePage = uintptr_t(2) << 20;
    constexpr size_t kBlock = kLargest - (1 << 20);
    void* blocks[kKept / kLargest] = {};
    for (void*& block : blocks) {
        block = std::malloc(kBlock);
        if (!block) break;
        const uintptr_t at = reinterpret_cast<uintptr_t>(block);
        const uintptr_t begin = (at + kHugePage - 1) / kHugePage * kHugePage, end = (at + kBlock) / kHugePage * kHugePage;
        madvise(reinterpret_cast<void*>(begin), end - begin, MADV_HUGEPAGE);
    }
    for (void* block : blocks) std::free(block);
#endif
}

static bool keep() {
    // By itself it gives the end of its heap back to the system as soon as 64 MB are free there, and the next step
    // gets them again page by page.
    if (!mallopt(M_MMAP_THRESHOLD, kLargest) || !mallopt(M_TRIM_THRESHOLD, kKept)) return false;
    grow_in_huge_pages();
    return true;
}

bool keep_freed_memory() {
    static const bool kept = keep();
    return kept;
}

#else

bool keep_freed_memory() { return false; }

#endif

}  // namespace evsplat
