// A list that kernels append to, in memory of the driver.
#pragma once

#include <stddef.h>

namespace evsplat {

template <class T>
struct List {
    T* data = nullptr;
    size_t size = 0, capacity = 0;
    void (*grow)(List&) = nullptr;
};

}  // namespace evsplat
