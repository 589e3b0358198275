// A stand-in for the I2C bus.
#pragma once

#include "Arduino.h"

struct I2cBus {
    void begin(int sda, int scl);
    void setClock(uint32_t) {}
};
extern I2cBus Wire;
