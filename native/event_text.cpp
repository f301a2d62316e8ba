#include "event_text.h"

#include <string.h>

#include <array>

namespace evsplat {
namespace {

constexpr int kMaxDigits = 18;  // that always fit in 64 bits

constexpr auto kPowers = [] {  // of ten
    std::array<int64_t, kMaxDigits + 1> powers = {1};
    for (int i = 1; i <= kMaxDigits; ++i) powers[i] = 10 * powers[i - 1];
    return powers;
}();

struct Decimal {
    int64_t digits = 0;
    int exponent = 0;
    bool negative = false;
};

bool is_digit(char c) { return uint8_t(c - '0') < 10; }

// [+-]digits[.digits][e[+-]digits]; false where `at` does not begin with that.
bool parse_number(const char*& at, const char* end, Decimal& number) {
    const char* c = at;
    if (c < end && (*c == '-' || *c == '+')) number.negative = *c++ == '-';
    int count = 0;
    bool any = false;
    for (bool fraction = false; c < end; ++c) {
        if (is_digit(*c)) {
            any = true;
            if (count < kMaxDigits) {
                number.digits = 10 * number.digits + (*c - '0');
                count += number.digits != 0;
                number.exponent -= fraction;
            } else {
                number.exponent += !fraction;
            }
        } else if (*c == '.' && !fraction) {
            fraction = true;
        } else {
            break;
        }
    }
    if (!any) return false;
    if (c < end && (*c == 'e' || *c == 'E')) {
        ++c;
        bool negative = false;
        if (c < end && (*c == '-' || *c == '+')) negative = *c++ == '-';
        int exponent = 0;
        if (c == end || !is_digit(*c)) return false;
        for (; c < end && is_digit(*c); ++c)
            if (exponent < 10000) exponent = 10 * exponent + (*c - '0');
        number.exponent += negative ? -exponent : exponent;
    }
    at = c;
    return true;
}

// digits * 10^exponent; rounded half away from zero where `exact` is not asked for.
TextError to_integer(const Decimal& number, bool exact, int64_t& value) {
    int64_t digits = number.digits;
    if (digits && number.exponent > 0) {
        if (number.exponent > kMaxDigits || digits > kPowers[kMaxDigits] / kPowers[number.exponent])
            return TextError::kRange;
        digits *= kPowers[number.exponent];
    } else if (digits && number.exponent < 0) {
        const int64_t power = number.exponent < -kMaxDigits ? 0 : kPowers[-number.exponent];
        const int64_t whole = power ? digits / power : 0, rest = power ? digits - whole * power : digits;
        if (exact && rest) return TextError::kFraction;
        digits = whole + (power && rest >= power - rest);
    }
    value = number.negative ? -digits : digits;
    return TextError::kNone;
}

bool is_blank(char c) { return c == ' ' || c == '\t' || c == '\r'; }

TextError parse_line(const char* c, const char* end, const TextLayout& layout, size_t row, int64_t* const* columns,
                     int& field) {
    for (field = 0; field < layout.fields; ++field) {
        while (c < end && is_blank(*c)) ++c;
        if (c == end) return TextError::kFields;
        Decimal number;
        if (!parse_number(c, end, number)) return TextError::kNumber;
        const int role = layout.roles[field];
        if (role >= 0) {
            if (role == 0) number.exponent += layout.time_exponent;
            const TextError error = to_integer(number, role != 0, columns[role][row]);
            if (error != TextError::kNone) return error;
        }
        const char* after = c;
        while (c < end && is_blank(*c)) ++c;
        if (field + 1 == layout.fields) break;
        if (layout.delimiter) {
            if (c == end) return ++field, TextError::kFields;
            if (*c != layout.delimiter) return TextError::kNumber;
            ++c;
        } else if (c == after) {
            return c == end ? (++field, TextError::kFields) : TextError::kNumber;
        }
    }
    return c == end ? TextError::kNone : TextError::kFields;
}

}  // namespace

TextResult parse_events(const char* text, size_t bytes, bool last, const TextLayout& layout, size_t capacity,
                        int64_t* const* columns) {
    TextResult result;
    while (result.bytes < bytes && result.rows < capacity) {
        const char* line = text + result.bytes;
        const char* end = static_cast<const char*>(memchr(line, '\n', bytes - result.bytes));
        if (!end && !last) break;
        const size_t length = end ? size_t(end - line) + 1 : bytes - result.bytes;
        if (!end) end = line + length;
        while (end > line && is_blank(end[-1])) --end;
        if (line < end && *line != '#' && *line != '%') {
            result.error = parse_line(line, end, layout, result.rows, columns, result.field);
            if (result.error != TextError::kNone) return result;
            ++result.rows;
        }
        result.bytes += length;
    }
    return result;
}

}  // namespace evsplat
