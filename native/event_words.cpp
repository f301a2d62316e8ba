#include "event_words.h"

#include <string.h>

namespace evsplat {
namespace {

constexpr size_t kMaxPerWord = 32;

template <class Word>
Word load(const uint8_t* data) {
    Word word;
    memcpy(&word, data, sizeof word);  // little-endian, as every machine that we build for
    return word;
}

int8_t sign(uint32_t bit) { return int8_t(2 * int(bit & 1) - 1); }

// A cursor over the columns, kept by value: stores through int8_t* might change anything else.
class Writer {
  public:
    explicit Writer(const EventColumns& out) : t_(out.t), x_(out.x), y_(out.y), p_(out.p), capacity_(out.capacity) {}
    bool full() const { return count_ + kMaxPerWord > capacity_; }
    size_t count() const { return count_; }

    void put(int64_t t, uint32_t x, uint32_t y, int8_t p) {
        t_[count_] = t;
        x_[count_] = uint16_t(x);
        y_[count_] = uint16_t(y);
        p_[count_] = p;
        ++count_;
    }

    // One event per set bit, from x on.
    void put_vector(int64_t t, uint32_t x, uint32_t y, int8_t p, uint32_t bits) {
        for (; bits; bits &= bits - 1) put(t, x + uint32_t(__builtin_ctz(bits)), y, p);
    }

  private:
    int64_t* t_;
    uint16_t *x_, *y_;
    int8_t* p_;
    size_t capacity_, count_ = 0;
};

struct Taken {
    size_t bytes, events;
};

void unknown_word(EventState& s, size_t at) {
    if (!s.unknown++) s.unknown_at = int64_t(at);
}

// The counter with the periods it went through: it began again where it falls by more than half of its range.
void set_time_high(EventState& s, int64_t counter, int bits) {
    const int64_t period = int64_t(1) << bits, before = s.time_high & (period - 1);
    s.time_high += counter - before + (s.time_known && before - counter > period / 2 ? period : 0);
    s.time_known = 1;
}

// EVT 2 and 2.1: a type of 4 bits, 6 bits of time, 11 of x, 11 of y; 2.1 adds 32 bits, one per pixel from x on.
template <class Word, bool kSwapped>
Taken evt2(const uint8_t* data, size_t bytes, EventState& state, Writer out) {
    EventState s = state;
    size_t at = 0;
    for (; at + sizeof(Word) <= bytes && !out.full(); at += sizeof(Word)) {
        const Word word = load<Word>(data + at);
        uint32_t head, bits = 1;
        if constexpr (sizeof(Word) == 8) {
            head = uint32_t(kSwapped ? word : word >> 32);
            bits = uint32_t(kSwapped ? word >> 32 : word);
        } else {
            head = word;
        }
        switch (head >> 28) {
            case 0x0: case 0x1:
                if (!s.time_known)
                    s.untimed += __builtin_popcount(bits);
                else if constexpr (sizeof(Word) == 8)
                    out.put_vector(s.time_us + (head >> 22 & 63), head >> 11 & 2047, head & 2047, sign(head >> 28), bits);
                else
                    out.put(s.time_us + (head >> 22 & 63), head >> 11 & 2047, head & 2047, sign(head >> 28));
                break;
            case 0x8:
                set_time_high(s, head & 0xfffffff, 28);
                s.time_us = s.time_high * 64;
                break;
            case 0xa: case 0xe: case 0xf: break;
            default: unknown_word(s, at);
        }
    }
    state = s;
    return {at, out.count()};
}

// EVT 3: each word of 16 bits changes one part of what is known; x alone is an event, a vector is one per set bit.
Taken evt3(const uint8_t* data, size_t bytes, EventState& state, Writer out) {
    EventState s = state;
    size_t at = 0;
    int64_t t = s.time_us + s.time_low;
    uint32_t x = uint32_t(s.x), y = uint32_t(s.y);
    int8_t p = int8_t(s.p);
    const auto vector = [&](uint32_t bits, uint32_t length) {
        if (s.time_known)
            out.put_vector(t, x, y, p, bits);
        else
            s.untimed += __builtin_popcount(bits);
        x = (x + length) & 0xffff;
    };
    while (at + 2 <= bytes && !out.full()) {
        uint32_t word = load<uint16_t>(data + at);
        // Time, row and column usually follow each other: tested in this order, each guess is mostly right, where one
        // jump by type is mostly wrong.
        if (word >> 12 == 0x6) {
            s.time_low = word & 0xfff;
            t = s.time_us + s.time_low;
            if ((at += 2) + 2 > bytes) break;
            word = load<uint16_t>(data + at);
        }
        if (word >> 12 == 0x0) {
            y = word & 0x7ff;
            if ((at += 2) + 2 > bytes) break;
            word = load<uint16_t>(data + at);
        }
        const uint32_t value = word & 0xfff;
        if (word >> 12 == 0x2) {
            if (s.time_known)
                out.put(t, value & 0x7ff, y, sign(value >> 11));
            else
                ++s.untimed;
            at += 2;
            continue;
        }
        switch (word >> 12) {
            case 0x0: case 0x6: continue;  // again, or out of the usual order: from the top
            case 0x3: x = value & 0x7ff, p = sign(value >> 11); break;
            case 0x4: vector(value, 12); break;
            case 0x5: vector(value & 0xff, 8); break;
            case 0x8: {
                const int64_t before = s.time_high;
                set_time_high(s, value, 12);
                // The low bits of the new period come in a word of their own: until then, its beginning.
                if (s.time_high != before) s.time_low = 0;
                s.time_us = s.time_high * 4096;
                t = s.time_us + s.time_low;
                break;
            }
            case 0x7: case 0xa: case 0xe: case 0xf: break;
            default: unknown_word(s, at);
        }
        at += 2;
    }
    s.x = x, s.y = y, s.p = p;
    state = s;
    return {at, out.count()};
}

// Event Stream 2: a byte with the time since the last event and the polarity, x, y of 16 bits each. Full time bits are
// no event but more time; ATIS has two bits of type, of which the lower one marks its exposure measurements.
template <int kTypeBits>
Taken event_stream(const uint8_t* data, size_t bytes, EventState& state, Writer out) {
    EventState s = state;
    constexpr uint32_t kFull = 0xff >> kTypeBits, kType = (1 << kTypeBits) - 1;
    size_t at = 0;
    while (at < bytes && !out.full()) {
        const uint32_t head = data[at], since = head >> kTypeBits, type = head & kType;
        if (since == kFull) {
            s.time_us += int64_t(kFull) * type;
            ++at;
            continue;
        }
        if (at + 5 > bytes) break;
        s.time_us += since;
        if (kTypeBits == 1 || !(type & 1))
            out.put(s.time_us, load<uint16_t>(data + at + 1), load<uint16_t>(data + at + 3), sign(type >> (kTypeBits - 1)));
        at += 5;
    }
    state = s;
    return {at, out.count()};
}

}  // namespace

size_t decode_events(EventWords kind, const uint8_t* data, size_t bytes, EventState& state, const EventColumns& out,
                     size_t& events) {
    const Writer writer(out);
    Taken taken = {0, 0};
    switch (kind) {
        case EventWords::kEvt2: taken = evt2<uint32_t, false>(data, bytes, state, writer); break;
        case EventWords::kEvt21: taken = evt2<uint64_t, false>(data, bytes, state, writer); break;
        case EventWords::kEvt21Swapped: taken = evt2<uint64_t, true>(data, bytes, state, writer); break;
        case EventWords::kEvt3: taken = evt3(data, bytes, state, writer); break;
        case EventWords::kEsDvs: taken = event_stream<1>(data, bytes, state, writer); break;
        case EventWords::kEsAtis: taken = event_stream<2>(data, bytes, state, writer); break;
    }
    events = taken.events;
    return taken.bytes;
}

}  // namespace evsplat
