// A stand-in for the library of 1-Wire.
#pragma once

#include "Arduino.h"

struct OneWire {
    explicit OneWire(uint8_t) {}
};
