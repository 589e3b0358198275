#include "time_of_flight.hpp"

namespace fognav {

namespace {

constexpr uint16_t kNothingMm = 8190;  // from here on a VL53L0X says that nothing was in range

Sample range(uint16_t millimetres) {
    if (millimetres < kMinRangeMm) return {Status::stuck, 0};  // shiny black gives zeros that call themselves valid
    return {Status::ok, millimetres};
}

}  // namespace

Sample vl53l0x_sample(uint16_t millimetres, uint8_t code) {
    constexpr uint8_t vcsel_continuity = 1;
    constexpr uint8_t no_vhv_value = 3;
    constexpr uint8_t complete = 11;
    if (code >= vcsel_continuity && code <= no_vhv_value) return {Status::stuck, 0};
    if (code != complete || millimetres >= kNothingMm) return {Status::no_echo, 0};
    return range(millimetres);
}

Sample vl53l1x_sample(uint16_t millimetres, uint8_t code) {
    switch (code) {
        case 0:  // valid
        case 3:  // valid, at the near end of its range
        case 6:  // valid, the first one: not checked for a target beyond its range
            return range(millimetres);
        case 1:  // too noisy
        case 2:  // too weak
        case 4:  // nothing in range
        case 7:  // wrapped round: beyond its range
            return {Status::no_echo, 0};
        default:  // no measurement; with 11 to 13 something is there: two targets in one, too weak to range, or too near
            return {Status::stuck, 0};
    }
}

void TimeOfFlight::start(uint32_t now_us) {
    started_us_ = now_us;
    answers_ = ranger_.discard();
}

bool TimeOfFlight::poll(uint32_t now_us, int16_t, Sample& sample) {
    if (answers_ && ranger_.ready()) {
        uint16_t millimetres = 0;
        uint8_t code = 0;
        ranger_.read(millimetres, code);
        sample = meaning_(millimetres, code);
        return true;
    }
    if (answers_ && now_us - started_us_ < kRangerTimeoutUs) return false;
    sample = {Status::stuck, 0};
    return true;
}

}  // namespace fognav
