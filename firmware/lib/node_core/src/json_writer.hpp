// Writes one JSON object into a buffer of fixed size: no heap, no floating point.
#pragma once

#include <stddef.h>
#include <stdint.h>

namespace fognav {

class JsonWriter {
public:
    // One byte of the buffer is kept for the terminating zero.
    JsonWriter(char* buffer, size_t size) : buffer_(buffer), size_(size) {}

    void begin_object() { open('{'); }
    void end_object() { close('}'); }
    void begin_array() { open('['); }
    void end_array() { close(']'); }
    void key(const char* name);

    void value(uint64_t number);
    void value(int32_t number);
    void value(bool flag);
    void value(const char* text);  // UTF-8; control characters are left out
    void thousandths(int32_t number);  // of a metre, for instance, written in metres
    void null();
    void raw(const char* text, size_t length);  // JSON that is written already: a value, or a member with its key

    // The length without the terminating zero, or 0 if the buffer was too small.
    size_t finish();

private:
    void open(char bracket);
    void close(char bracket);
    void separate();
    void put(char character);
    void put(const char* text);
    void digits(uint64_t number, int at_least);

    char* buffer_;
    size_t size_;
    size_t length_ = 0;
    bool first_ = true;
    bool overflow_ = false;
};

}  // namespace fognav
