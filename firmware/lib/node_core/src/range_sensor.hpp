// The seam between a node and what measures its ranges: an HC-SR04 (sonar.hpp), a VL53L0X or VL53L1X
// (time_of_flight.hpp), or another. A node starts one sensor after the other and polls it until it has a sample.
#pragma once

#include "sample.hpp"

namespace fognav {

constexpr int32_t kMinRangeMm = 20;  // nearer, no sensor measures: a sonar hears its own ringing

class RangeSensor {
public:
    // Begin a measurement. Times are micros(): 32 bits that wrap.
    virtual void start(uint32_t now_us) = 0;

    // True once there is a result, within 100 ms of the start; `sample` then holds it, and the measurement ends. The
    // temperature of the air is in tenths of a degree Celsius.
    virtual bool poll(uint32_t now_us, int16_t temperature_dc, Sample& sample) = 0;

protected:
    // Nobody destroys one by this interface: a virtual destructor would ask for a heap.
    ~RangeSensor() = default;
};

}  // namespace fognav
