#include "json_writer.hpp"

namespace fognav {

void JsonWriter::put(char character) {
    if (length_ + 1 >= size_) {
        overflow_ = true;
        return;
    }
    buffer_[length_++] = character;
}

void JsonWriter::put(const char* text) {
    for (; *text != 0; ++text) put(*text);
}

void JsonWriter::separate() {
    if (!first_) put(',');
    first_ = false;
}

void JsonWriter::open(char bracket) {
    separate();
    put(bracket);
    first_ = true;
}

void JsonWriter::close(char bracket) {
    put(bracket);
    first_ = false;
}

void JsonWriter::key(const char* name) {
    value(name);
    put(':');
    first_ = true;  // its value follows without a comma
}

void JsonWriter::digits(uint64_t number, int at_least) {
    char reversed[20];
    int count = 0;
    do {
        reversed[count++] = static_cast<char>('0' + number % 10);
        number /= 10;
    } while (number != 0 || count < at_least);
    while (count > 0) put(reversed[--count]);
}

void JsonWriter::value(uint64_t number) {
    separate();
    digits(number, 1);
}

void JsonWriter::value(int32_t number) {
    separate();
    if (number < 0) put('-');
    digits(number < 0 ? -static_cast<int64_t>(number) : number, 1);
}

void JsonWriter::value(const char* text) {
    separate();
    put('"');
    for (; *text != 0; ++text) {
        const unsigned char byte = static_cast<unsigned char>(*text);
        if (byte == '"' || byte == '\\') put('\\');
        if (byte >= ' ' && byte != 0x7F) put(*text);
    }
    put('"');
}

void JsonWriter::value(bool flag) {
    separate();
    put(flag ? "true" : "false");
}

void JsonWriter::thousandths(int32_t number) {
    separate();
    if (number < 0) put('-');
    const uint64_t magnitude = static_cast<uint64_t>(number < 0 ? -static_cast<int64_t>(number) : number);
    digits(magnitude / 1000, 1);
    put('.');
    digits(magnitude % 1000, 3);
}

void JsonWriter::null() {
    separate();
    put("null");
}

void JsonWriter::raw(const char* text, size_t length) {
    separate();
    for (size_t i = 0; i < length; ++i) put(text[i]);
}

size_t JsonWriter::finish() {
    if (size_ == 0) return 0;
    buffer_[overflow_ ? 0 : length_] = 0;
    return overflow_ ? 0 : length_;
}

}  // namespace fognav
