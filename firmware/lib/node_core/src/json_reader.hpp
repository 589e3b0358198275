// Reads JSON where it lies: no heap, no copy, no recursion. It accepts all that RFC 8259 allows, and does not judge the
// escapes in strings. Each function returns false where the text is not what it asks for, and from then on.
#pragma once

#include <stddef.h>
#include <stdint.h>

namespace fognav {

class JsonReader {
public:
    JsonReader(const char* text, size_t size) : at_(text), end_(text + size) {}

    bool begin_object() { return begin('{'); }
    bool begin_array() { return begin('['); }

    // True for each member of the object, with its key (without quotes, escapes unresolved); false at the object's end.
    bool next_member(const char*& key, size_t& length);

    // True for each element of the array, false at its end.
    bool next_element() { return next(']'); }

    // A number times 1000, rounded half away from zero: metres to millimetres.
    bool number_milli(int64_t& value);
    bool boolean(bool& value);

    // A string with its escapes resolved, as UTF-8 with a terminating zero. False if the buffer is too small for it.
    bool text(char* buffer, size_t size);
    bool skip_value();

    // True if nothing but blanks follows and all went well.
    bool at_end();

    bool failed() const { return failed_; }

    // Where it has come to: behind a member's key and colon, or behind a value.
    const char* position() const { return at_; }

private:
    bool begin(char bracket);
    bool next(char bracket);
    bool literal(const char* word);
    bool string(const char*& start, size_t& length);
    bool take(char character);
    bool digit() const { return at_ < end_ && *at_ >= '0' && *at_ <= '9'; }
    bool scalar();
    bool escape(const char*& from, const char* to, uint32_t& character) const;
    void blanks();
    bool fail() {
        failed_ = true;
        return false;
    }

    const char* at_;
    const char* end_;
    bool first_ = false;
    bool failed_ = false;
};

}  // namespace fognav
