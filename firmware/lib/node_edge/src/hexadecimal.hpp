#pragma once

#include <stddef.h>
#include <stdint.h>

namespace fognav {

// The bytes that pairs of hexadecimal digits (0 to 9, a to f) stand for: how many, or -1 if the text is not such, or
// stands for more than `size`.
int bytes(const char* text, uint8_t* buffer, size_t size);

}  // namespace fognav
