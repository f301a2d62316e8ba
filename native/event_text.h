// Events from lines of decimal numbers.
#pragma once

#include <stddef.h>
#include <stdint.h>

namespace evsplat {

constexpr int kTextComponents = 4;  // t, x, y, p

struct TextLayout {
    const int* roles;     // per field of a line: 0 to 3 for t, x, y, p, -1 to pass over
    int fields;
    char delimiter;       // 0: any white space
    int time_exponent;    // t is multiplied by ten to this power and rounded
};

enum class TextError { kNone, kFields, kNumber, kFraction, kRange };

struct TextResult {
    size_t rows = 0, bytes = 0;  // what was taken; where an error is, its line begins at `bytes`
    TextError error = TextError::kNone;
    int field = 0;               // of the error
};

// Parses whole lines into columns of `capacity`; lines that are empty or begin with # or % are passed over. The last
// line may end without a line feed where `last` is set.
TextResult parse_events(const char* text, size_t bytes, bool last, const TextLayout& layout, size_t capacity,
                        int64_t* const* columns);

}  // namespace evsplat
