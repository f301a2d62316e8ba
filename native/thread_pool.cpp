#include "thread_pool.h"

#include <atomic>
#include <condition_variable>
#include <exception>
#include <mutex>
#include <thread>
#include <vector>

#if !defined(_WIN32)
#include <unistd.h>
#endif

namespace evsplat {
namespace {

// A thread that sleeps takes tens of microseconds to be woken, as long as many a call here takes: for about that
// long both sides look before they sleep.
constexpr int kLooks = 1000;

template <class Condition>
void look_for(Condition holds) {
    for (int i = 0; i < kLooks && !holds(); ++i) {
#if defined(__x86_64__) || defined(__i386__)
        __builtin_ia32_pause();
#elif defined(__aarch64__)
        asm volatile("yield");
#endif
    }
}

class Pool {
  public:
    void run(int threads, size_t count, const std::function<void(size_t)>& task) {
        {
            std::lock_guard<std::mutex> lock(mutex_);
            while (int(workers_.size()) < threads - 1) {
                const int id = int(workers_.size());
                workers_.emplace_back([this, id] { work(id); });
            }
            task_ = &task, count_ = count, next_ = 0;
            helpers_ = threads - 1;
            ++generation_;
        }
        wake_.notify_all();
        take(task, count);
        // Helpers that have not started by now are not waited for: on a busy machine one may get its
        // first time slice only milliseconds later.
        std::unique_lock<std::mutex> lock(mutex_);
        task_ = nullptr;
        lock.unlock();
        look_for([this] { return running_ == 0; });
        lock.lock();
        done_.wait(lock, [this] { return running_ == 0; });
    }

    std::mutex& in_use() { return in_use_; }

  private:
    void take(const std::function<void(size_t)>& task, size_t count) {
        for (size_t i; (i = next_.fetch_add(1, std::memory_order_relaxed)) < count;) task(i);
    }

    void work(int id) {
        uint64_t seen = 0;
        for (;;) {
            look_for([&] { return generation_ != seen; });
            std::unique_lock<std::mutex> lock(mutex_);
            wake_.wait(lock, [&] { return generation_ != seen; });
            seen = generation_;
            if (id >= helpers_ || !task_) continue;
            const auto& task = *task_;
            const size_t count = count_;
            ++running_;
            lock.unlock();
            take(task, count);
            lock.lock();
            if (--running_ == 0) done_.notify_one();
        }
    }

    std::mutex in_use_, mutex_;
    std::condition_variable wake_, done_;
    std::vector<std::thread> workers_;
    const std::function<void(size_t)>* task_ = nullptr;
    size_t count_ = 0;
    std::atomic<size_t> next_{0};
    int helpers_ = 0;
    std::atomic<int> running_{0};  // changed under the lock
    std::atomic<uint64_t> generation_{0};
};

// Never destroyed: joining threads while the process or the interpreter goes down can hang. A forked
// child has none of its parent's threads and starts its own pool.
Pool& pool() {
    static std::mutex guard;
    static Pool* current = nullptr;
#if defined(_WIN32)
    const long process = 0;
#else
    const long process = long(getpid());
#endif
    static long owner = -1;
    std::lock_guard<std::mutex> lock(guard);
    if (owner != process) {
        current = new Pool;
        owner = process;
    }
    return *current;
}

}  // namespace

void parallel_for(int threads, size_t count, const std::function<void(size_t)>& task) {
    if (threads <= 1 || count <= 1) {
        for (size_t i = 0; i < count; ++i) task(i);
        return;
    }
    Pool& p = pool();
    std::lock_guard<std::mutex> lock(p.in_use());
    p.run(threads, count, task);
}

void run(int threads, size_t count, const std::function<void(size_t)>& task) {
    std::exception_ptr error;
    std::atomic<bool> failed{false};
    parallel_for(threads, count, [&](size_t i) {
        if (failed.load(std::memory_order_relaxed)) return;
        try {
            task(i);
        } catch (...) {
            if (!failed.exchange(true)) error = std::current_exception();
        }
    });
    if (error) std::rethrow_exception(error);
}

}  // namespace evsplat
