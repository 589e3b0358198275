#include "echo.hpp"

namespace fognav {

int32_t range_mm(uint32_t flight_us, int16_t temperature_dc) {
    // The speed in tenths of a mm/s keeps the resolution of the temperature; half of the way, rounded.
    const uint64_t speed = static_cast<uint64_t>(3313000 + int64_t{606} * temperature_dc);
    return static_cast<int32_t>((flight_us * speed + 10000000) / 20000000);
}

void EchoCapture::arm(uint32_t now_us) {
    phase_ = Phase::idle;  // an edge between these lines finds no measurement
    armed_us_ = now_us;
    phase_ = Phase::armed;
}

bool EchoCapture::poll(uint32_t now_us, int16_t temperature_dc, uint32_t no_echo_us, Sample& sample) {
    if (phase_ == Phase::idle) return false;
    const bool over = now_us - armed_us_ >= kWindowUs;
    // Signed: the interrupt may have come after the caller read its clock, and then the line rose in its future.
    if (phase_ == Phase::rising && static_cast<int32_t>(now_us - rose_us_) > static_cast<int32_t>(kMaxFlightUs)) {
        // Whatever falls later comes from too far. A line that stays high will not rise at the next trigger.
        phase_ = Phase::idle;
        sample = {Status::no_echo, 0};
        return true;
    }
    if (phase_ != Phase::done) {
        if (!over) return false;
        phase_ = Phase::idle;
        sample = {Status::stuck, 0};  // the line never rose: nobody measured anything
        return true;
    }
    phase_ = Phase::idle;
    const uint32_t flight_us = pulse_us();
    const uint32_t off = flight_us > no_echo_us ? flight_us - no_echo_us : no_echo_us - flight_us;
    const bool says_no_echo = no_echo_us != 0 && off <= kSameNoEchoUs;
    const int32_t range = range_mm(flight_us, temperature_dc);
    if (flight_us > kMaxFlightUs || says_no_echo) {
        sample = {Status::no_echo, 0};
    } else if (range < kMinRangeMm) {
        sample = {Status::stuck, 0};
    } else {
        sample = {Status::ok, range};
    }
    return true;
}

}  // namespace fognav
