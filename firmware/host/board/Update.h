// A stand-in for the writer of a board's flash: a file beside the others.
#pragma once

#include "Arduino.h"

class FlashWriter {
public:
    bool begin(size_t size);
    size_t write(uint8_t* data, size_t size);
    bool end();

private:
    FILE* image_ = nullptr;
    size_t missing_ = 0;
};
extern FlashWriter Update;
