#include "files.hpp"

#include <LittleFS.h>

namespace fognav {

namespace {

constexpr const char* kUnfinished = "/unfinished";

}  // namespace

String read_file(const char* name, size_t size_max) {
    File file = LittleFS.open(name, "r");
    if (!file || file.size() > size_max) return String();
    return file.readString();
}

bool write_file(const char* name, const char* text) {
    File file = LittleFS.open(kUnfinished, "w");
    if (!file) return false;
    const size_t size = strlen(text);
    const bool written = file.write(reinterpret_cast<const uint8_t*>(text), size) == size;
    file.close();
    return written && LittleFS.rename(kUnfinished, name);
}

void remove_file(const char* name) { LittleFS.remove(name); }

}  // namespace fognav
