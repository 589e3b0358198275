// A stand-in for the board's file system: a folder of the computer.
#pragma once

#include <memory>

#include "Arduino.h"

class File {
public:
    File() = default;
    File(const std::string& path, const char* mode);
    explicit operator bool() const { return file_ != nullptr; }
    size_t size() const;
    String readString();
    size_t write(const uint8_t* data, size_t size);
    void close() { file_.reset(); }

private:
    std::shared_ptr<FILE> file_;  // copies are of the same file, as on the board
};

struct FileSystem {
#if defined(ESP8266)
    bool begin();
#else
    bool begin(bool format_on_fail = false);
#endif
    File open(const char* name, const char* mode);
    bool rename(const char* from, const char* to);
    bool remove(const char* name);
};
extern FileSystem LittleFS;
