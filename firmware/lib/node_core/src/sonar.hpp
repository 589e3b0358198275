// An HC-SR04 or one of its clones: edges of its echo line, and the pulse by which it says "no echo".
#pragma once

#include "echo.hpp"
#include "range_sensor.hpp"

namespace fognav {

class Sonar final : public RangeSensor {
public:
    // The edge of the node raises the module's trigger after this.
    void start(uint32_t now_us) override { capture_.arm(now_us); }

    bool poll(uint32_t now_us, int16_t temperature_dc, Sample& sample) override {
        return capture_.poll(now_us, temperature_dc, no_echo_us_, sample);
    }

    // For the interrupt; see EchoCapture.
    __attribute__((always_inline)) void on_edge(bool high, uint32_t now_us) { capture_.on_edge(high, now_us); }

    // The pulse of a clone that means "no echo"; 0: none, it keeps its line high for too long instead.
    void set_no_echo(uint32_t pulse_us) { no_echo_us_ = pulse_us; }

    // Width of the last pulse.
    uint32_t pulse_us() const { return capture_.pulse_us(); }

private:
    EchoCapture capture_;
    uint32_t no_echo_us_ = 0;
};

}  // namespace fognav
