// Decoders of the words that event cameras write: Prophesee's EVT 2, 2.1 and 3, and Event Stream.
#pragma once

#include <stddef.h>
#include <stdint.h>

namespace evsplat {

enum class EventWords { kEvt2, kEvt21, kEvt21Swapped, kEvt3, kEsDvs, kEsAtis };

// Where a stream stands between two calls; zero at its beginning. All int64, because Python keeps it as an array.
struct EventState {
    int64_t time_us;     // what the words so far add up to, without the bits that an event carries itself
    int64_t time_high;   // EVT: the counter that time_us came from, with the periods it went through
    int64_t time_low;    // EVT 3
    int64_t time_known;  // EVT: whether a counter was read; events before the first have no time
    int64_t x, y, p;     // EVT 3: where the next vector begins
    int64_t untimed;     // events without a time, left out
    int64_t unknown;     // words of a type that the format does not have, left out
    int64_t unknown_at;  // byte of this call where the first of them is
};

struct EventColumns {
    int64_t* t;
    uint16_t *x, *y;
    int8_t* p;  // 1 or -1
    size_t capacity;
};

// Decodes whole words until they end or the columns could not take what the next word may hold. Returns the bytes
// taken; `events` becomes the number of events written.
size_t decode_events(EventWords kind, const uint8_t* data, size_t bytes, EventState& state, const EventColumns& out,
                     size_t& events);

}  // namespace evsplat
