// Uninitialised, aligned arrays whose memory is kept for the next call.
//
// A fresh page costs more than filling it; a training step asks for the same sizes again and again.
#pragma once

#include <cstdint>
#include <cstdlib>
#include <cstring>
#include <mutex>
#include <new>
#include <utility>
#include <vector>

#if !defined(_WIN32)
#include <sys/mman.h>
#endif

#include "list.h"

namespace evsplat {

class BlockCache {
  public:
    static BlockCache& instance() {
        static BlockCache* cache = new BlockCache;  // outlives every Record held by the interpreter
        return *cache;
    }

    // At least `bytes`; `bytes` becomes what the block holds.
    void* take(size_t& bytes) {
        {
            std::lock_guard<std::mutex> lock(mutex_);
            size_t best = free_.size();
            for (size_t i = 0; i < free_.size(); ++i)
                if (free_[i].bytes >= bytes && free_[i].bytes <= 4 * bytes + 65536 &&
                    (best == free_.size() || free_[i].bytes < free_[best].bytes))
                    best = i;
            if (best < free_.size()) {
                const Block block = free_[best];
                free_.erase(free_.begin() + best);
                held_ -= block.bytes;
                bytes = block.bytes;
                return block.data;
            }
        }
        // Head-room, because the number of intersections changes a little from step to step.
        bytes = (bytes + bytes / 4 + 4095) / 4096 * 4096;
        // In pages of 2 MB where the system has them: what streams through many small ones waits for their addresses.
        const bool huge = bytes >= 2 * kHugePage;
        if (huge) bytes = (bytes + kHugePage - 1) / kHugePage * kHugePage;
        void* data = std::aligned_alloc(huge ? kHugePage : 64, bytes);
        if (!data) throw std::bad_alloc();
#if defined(MADV_HUGEPAGE)
        if (huge) madvise(data, bytes, MADV_HUGEPAGE);
#endif
        return data;
    }

    void give(void* data, size_t bytes) {
        std::lock_guard<std::mutex> lock(mutex_);
        free_.push_back({data, bytes});
        held_ += bytes;
        while (free_.size() > kMaxBlocks || (held_ > kMaxBytes && free_.size() > 1)) {
            held_ -= free_.front().bytes;
            std::free(free_.front().data);
            free_.erase(free_.begin());
        }
    }

  private:
    struct Block {
        void* data;
        size_t bytes;
    };
    static constexpr size_t kHugePage = size_t(2) << 20;
    static constexpr size_t kMaxBlocks = 256, kMaxBytes = size_t(512) << 20;
    std::mutex mutex_;
    std::vector<Block> free_;  // oldest first
    size_t held_ = 0;
};

template <class T>
class Buffer {
  public:
    Buffer() = default;
    explicit Buffer(size_t count) { reset(count); }
    Buffer(Buffer&& o) noexcept : data_(o.data_), bytes_(o.bytes_), size_(o.size_) { o.data_ = nullptr; }
    Buffer& operator=(Buffer&&) = delete;
    ~Buffer() { release(); }

    // New size; the content is lost.
    void reset(size_t count) {
        release();
        if (count > SIZE_MAX / sizeof(T) / 2) throw std::bad_alloc();
        bytes_ = count * sizeof(T) + 64;
        data_ = static_cast<T*>(BlockCache::instance().take(bytes_));
        size_ = count;
    }

    void swap(Buffer& o) {
        std::swap(data_, o.data_);
        std::swap(bytes_, o.bytes_);
        std::swap(size_, o.size_);
    }

    T* data() { return data_; }
    const T* data() const { return data_; }
    size_t size() const { return size_; }
    size_t bytes() const { return data_ ? bytes_ : 0; }
    T& operator[](size_t i) { return data_[i]; }
    const T& operator[](size_t i) const { return data_[i]; }

  private:
    void release() {
        if (data_) BlockCache::instance().give(data_, bytes_);
        data_ = nullptr;
    }

    T* data_ = nullptr;
    size_t bytes_ = 0, size_ = 0;
};

// A list that doubles its memory where it is full.
template <class T>
struct GrowingList : List<T> {
    GrowingList() {
        this->grow = [](List<T>& list) {
            Buffer<T>& memory = static_cast<GrowingList&>(list).memory;
            Buffer<T> larger(list.capacity ? 2 * list.capacity : 2048);
            if (list.size) std::memcpy(larger.data(), list.data, list.size * sizeof(T));
            memory.swap(larger);
            list.data = memory.data(), list.capacity = memory.size();
        };
    }
    GrowingList(const GrowingList&) = delete;

    void swap(GrowingList& o) {
        memory.swap(o.memory);
        std::swap<List<T>>(*this, o);
    }

    Buffer<T> memory;
};

}  // namespace evsplat
