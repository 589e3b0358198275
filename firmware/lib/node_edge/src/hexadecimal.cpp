#include "hexadecimal.hpp"

#include <string.h>

namespace fognav {

namespace {

int digit(char character) {
    if (character >= '0' && character <= '9') return character - '0';
    if (character >= 'a' && character <= 'f') return character - 'a' + 10;
    return -1;
}

}  // namespace

int bytes(const char* text, uint8_t* buffer, size_t size) {
    const size_t length = strlen(text);
    if (length % 2 != 0 || length / 2 > size) return -1;
    for (size_t i = 0; i < length / 2; ++i) {
        const int high = digit(text[2 * i]);
        const int low = digit(text[2 * i + 1]);
        if (high < 0 || low < 0) return -1;
        buffer[i] = static_cast<uint8_t>(high << 4 | low);
    }
    return static_cast<int>(length / 2);
}

}  // namespace fognav
