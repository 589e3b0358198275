// From edges of the echo line to a range. The line rises when a module has sent its burst and falls at the echo; the
// width of the pulse is the time of flight there and back.
//
// Timing: HC-SR04 data sheet (2 cm to 4 m, pulse of about 38 ms without an echo). Boards differ: some begin the pulse 2
// to 12 ms after the trigger, some leak the trigger into the line, and edges bounce; so the window is fixed, and what
// comes within 100 us of the trigger or lasts less than 50 us is not an echo.
#pragma once

#include "range_sensor.hpp"

namespace fognav {

constexpr uint32_t kTriggerUs = 20;       // width of the trigger; the data sheet's 10 us are marginal for some boards
constexpr uint32_t kLeakUs = 100;         // after the trigger, edges are its leak
constexpr uint32_t kBounceUs = 50;        // a shorter pulse is a bounce
constexpr uint32_t kWindowUs = 80000;     // after the trigger, until a measurement ends without a pulse
constexpr uint32_t kMaxFlightUs = 24500;  // 4.2 m at 20 degrees: a longer pulse is a module's "no echo"
constexpr uint32_t kSameNoEchoUs = 150;   // 2.6 cm: pulses of a clone's "no echo" are equal but for its clock

// Range (mm) of a time of flight there and back (us), at a temperature of the air in tenths of a degree Celsius. Speed of
// sound in dry air: 331.3 + 0.606 T m/s, good to 0.1 % from -20 to 40 degrees.
int32_t range_mm(uint32_t flight_us, int16_t temperature_dc);

// The edges of one measurement. `on_edge` is for the interrupt: it stores two times and judges nothing.
class EchoCapture {
public:
    // Begin a measurement, before the trigger's pulse. Times are micros(): 32 bits that wrap.
    void arm(uint32_t now_us);

    // The line has changed. Does nothing unless a measurement is under way. Always a part of its caller: an interrupt's
    // handler must be in the internal RAM of an ESP8266 with all that it calls.
    __attribute__((always_inline)) void on_edge(bool high, uint32_t now_us) {
        if (phase_ == Phase::idle || phase_ == Phase::done || now_us - armed_us_ < kLeakUs) return;
        if (high) {
            if (phase_ == Phase::armed) {
                rose_us_ = now_us;
                phase_ = Phase::rising;
            }
        } else if (phase_ == Phase::rising) {
            fell_us_ = now_us;
            phase_ = now_us - rose_us_ < kBounceUs ? Phase::armed : Phase::done;
        }
    }

    // True once there is a result; `sample` then holds it, and the measurement ends. `no_echo_us` is the pulse by which
    // a clone says "no echo" as if something stood at 0.4 m; 0: a pulse beyond kMaxFlightUs says it.
    bool poll(uint32_t now_us, int16_t temperature_dc, uint32_t no_echo_us, Sample& sample);

    uint32_t pulse_us() const { return fell_us_ - rose_us_; }

private:
    enum class Phase : uint8_t { idle, armed, rising, done };
    volatile Phase phase_ = Phase::idle;
    uint32_t armed_us_ = 0;
    volatile uint32_t rose_us_ = 0;
    volatile uint32_t fell_us_ = 0;
};

}  // namespace fognav
