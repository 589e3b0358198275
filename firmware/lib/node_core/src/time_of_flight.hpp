// Laser rangers of ST on I2C, VL53L0X and VL53L1X, behind the same seam as a sonar. The registers are the business of a
// library at the edge; what an answer means is decided here.
#pragma once

#include "range_sensor.hpp"

namespace fognav {

// A ranger that measures continuously.
class Ranger {
public:
    // Forget a measurement that is ready, so that the next one is fresh. False if the ranger does not answer.
    virtual bool discard() = 0;
    virtual bool ready() = 0;

    // The measurement that is ready, with the ranger's own code for how it went.
    virtual void read(uint16_t& millimetres, uint8_t& code) = 0;

protected:
    ~Ranger() = default;
};

// What an answer means. Codes: VL53L0X, bits 3 to 6 of RESULT_RANGE_STATUS (ST UM2039); VL53L1X, its driver's range
// status (ST UM2150).
Sample vl53l0x_sample(uint16_t millimetres, uint8_t code);
Sample vl53l1x_sample(uint16_t millimetres, uint8_t code);

constexpr uint32_t kRangerTimeoutUs = 100000;  // three of its measurements

class TimeOfFlight final : public RangeSensor {
public:
    using Meaning = Sample (*)(uint16_t millimetres, uint8_t code);

    TimeOfFlight(Ranger& ranger, Meaning meaning) : ranger_(ranger), meaning_(meaning) {}

    void start(uint32_t now_us) override;
    bool poll(uint32_t now_us, int16_t temperature_dc, Sample& sample) override;

private:
    Ranger& ranger_;
    Meaning meaning_;
    uint32_t started_us_ = 0;
    bool answers_ = false;
};

}  // namespace fognav
