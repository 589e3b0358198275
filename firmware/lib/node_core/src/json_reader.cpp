#include "json_reader.hpp"

namespace fognav {

namespace {

constexpr int kMaxDepth = 16;
constexpr int64_t kMaxMantissa = 100000000000000000;  // 1e17: more digits change no millimetre
constexpr int64_t kMaxTimesTen = INT64_MAX / 10;
constexpr int kMaxExponent = 400;

}  // namespace

void JsonReader::blanks() {
    while (at_ < end_ && (*at_ == ' ' || *at_ == '\t' || *at_ == '\n' || *at_ == '\r')) ++at_;
}

bool JsonReader::take(char character) {
    if (at_ >= end_ || *at_ != character) return false;
    ++at_;
    return true;
}

bool JsonReader::begin(char bracket) {
    if (failed_) return false;
    blanks();
    if (!take(bracket)) return fail();
    first_ = true;
    return true;
}

bool JsonReader::next(char bracket) {
    if (failed_) return false;
    blanks();
    if (take(bracket)) {
        first_ = false;  // whatever holds this one has had its first
        return false;
    }
    if (!first_ && !take(',')) return fail();
    first_ = false;
    blanks();
    return true;
}

bool JsonReader::next_member(const char*& key, size_t& length) {
    if (!next('}')) return false;
    if (!string(key, length)) return fail();
    blanks();
    return take(':') || fail();
}

bool JsonReader::string(const char*& start, size_t& length) {
    if (!take('"')) return false;
    start = at_;
    while (at_ < end_ && *at_ != '"') {
        if (static_cast<unsigned char>(*at_) < 0x20) return false;
        if (*at_ == '\\') {
            ++at_;
            if (at_ >= end_) return false;
        }
        ++at_;
    }
    length = static_cast<size_t>(at_ - start);
    return take('"');
}

bool JsonReader::literal(const char* word) {
    const char* from = at_;
    for (; *word != 0; ++word) {
        if (!take(*word)) {
            at_ = from;
            return false;
        }
    }
    return true;
}

bool JsonReader::boolean(bool& value) {
    if (failed_) return false;
    blanks();
    if (literal("true")) {
        value = true;
        return true;
    }
    value = false;
    return literal("false") || fail();
}

bool JsonReader::number_milli(int64_t& value) {
    if (failed_) return false;
    blanks();
    const bool negative = take('-');
    if (!digit()) return fail();
    const bool zero = *at_ == '0';
    int64_t mantissa = 0;
    int exponent = 3;
    const char* first = at_;
    for (; digit(); ++at_) {
        if (mantissa < kMaxMantissa) mantissa = mantissa * 10 + (*at_ - '0');
        else ++exponent;
    }
    if (zero && at_ - first > 1) return fail();
    if (take('.')) {
        if (!digit()) return fail();
        for (; digit(); ++at_) {
            if (mantissa >= kMaxMantissa) continue;
            mantissa = mantissa * 10 + (*at_ - '0');
            --exponent;
        }
    }
    if (take('e') || take('E')) {
        const bool down = take('-');
        if (!down) take('+');
        if (!digit()) return fail();
        int power = 0;
        for (; digit(); ++at_) {
            if (power < kMaxExponent) power = power * 10 + (*at_ - '0');
        }
        exponent += down ? -power : power;
    }
    for (; exponent > 0 && mantissa != 0; --exponent) {
        if (mantissa > kMaxTimesTen) return fail();  // far beyond every limit of a setting
        mantissa *= 10;
    }
    int64_t last = 0;
    for (; exponent < 0 && (mantissa != 0 || last != 0); ++exponent) {
        last = mantissa % 10;
        mantissa /= 10;
    }
    if (last >= 5) ++mantissa;
    value = negative ? -mantissa : mantissa;
    return true;
}

// Resolve the escape behind a backslash at `from`, and move behind it. Characters beyond 16 bits are not resolved.
bool JsonReader::escape(const char*& from, const char* to, uint32_t& character) const {
    static const char codes[] = "\"\\/bfnrt";
    static const char meanings[] = "\"\\/\b\f\n\r\t";
    const char code = *from++;
    for (int i = 0; codes[i] != 0; ++i) {
        if (codes[i] != code) continue;
        character = static_cast<unsigned char>(meanings[i]);
        return true;
    }
    if (code != 'u' || to - from < 4) return false;
    character = 0;
    for (int i = 0; i < 4; ++i, ++from) {
        const char c = *from;
        const int digit = c >= '0' && c <= '9' ? c - '0' : c >= 'a' && c <= 'f' ? c - 'a' + 10 : c >= 'A' && c <= 'F' ? c - 'A' + 10 : -1;
        if (digit < 0) return false;
        character = character << 4 | static_cast<uint32_t>(digit);
    }
    return character != 0 && (character < 0xD800 || character > 0xDFFF);
}

bool JsonReader::text(char* buffer, size_t size) {
    const char* from = nullptr;
    size_t length = 0;
    if (failed_) return false;
    blanks();
    if (!string(from, length)) return fail();
    size_t written = 0;
    // UTF-8 by its definition: what was not escaped is copied byte by byte.
    const auto put = [&](uint32_t byte) {
        if (written + 1 < size) buffer[written] = static_cast<char>(byte);
        ++written;
    };
    for (const char* to = from + length; from < to;) {
        if (*from != '\\') {
            put(static_cast<unsigned char>(*from++));
            continue;
        }
        uint32_t character = 0;
        if (!escape(++from, to, character)) return fail();
        if (character < 0x80) {
            put(character);
        } else if (character < 0x800) {
            put(0xC0 | character >> 6);
            put(0x80 | (character & 0x3F));
        } else {
            put(0xE0 | character >> 12);
            put(0x80 | (character >> 6 & 0x3F));
            put(0x80 | (character & 0x3F));
        }
    }
    if (written >= size) return fail();
    buffer[written] = 0;
    return true;
}

bool JsonReader::scalar() {
    const char* start = nullptr;
    size_t length = 0;
    int64_t number = 0;
    bool flag = false;
    if (at_ >= end_) return fail();
    switch (*at_) {
        case '"':
            return string(start, length) || fail();
        case 't':
        case 'f':
            return boolean(flag);
        case 'n':
            return literal("null") || fail();
        default:
            return number_milli(number);
    }
}

bool JsonReader::skip_value() {
    // The brackets that are open, innermost last; inside, values and separators take turns.
    char open[kMaxDepth];
    int depth = 0;
    const char* key = nullptr;
    size_t length = 0;
    if (failed_) return false;
    for (;;) {
        blanks();
        if (at_ < end_ && (*at_ == '{' || *at_ == '[')) {
            if (depth == kMaxDepth) return fail();
            open[depth++] = *at_++;
            first_ = true;
        } else if (!scalar()) {
            return false;
        }
        while (depth > 0) {
            const bool more = open[depth - 1] == '{' ? next_member(key, length) : next_element();
            if (failed_) return false;
            if (more) break;
            --depth;
        }
        if (depth == 0) {
            first_ = false;
            return true;
        }
    }
}

bool JsonReader::at_end() {
    blanks();
    return !failed_ && at_ == end_;
}

}  // namespace fognav
