// A stand-in for the board's file system.
#pragma once

#include "Arduino.h"

class File {
public:
    explicit operator bool() const;
    size_t size() const;
    String readString();
};

struct FileSystem {
    bool begin();
    File open(const char* name, const char* mode);
};
extern FileSystem LittleFS;
