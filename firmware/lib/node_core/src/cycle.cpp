#include "cycle.hpp"

namespace fognav {

MeasurementCycle::Action MeasurementCycle::step(uint32_t now_us) {
    if (phase_ == Phase::listen) return Action::listen;
    if (now_us - since_us_ < wait_us_) return Action::wait;
    if (phase_ == Phase::decay && ++current_ == sonars_) {
        current_ = 0;
        phase_ = Phase::pause;
        since_us_ = now_us;
        wait_us_ = pause_us_ + jitter_us();
        return Action::finished;
    }
    if (phase_ == Phase::pause) begun_us_ = now_us;
    phase_ = Phase::listen;
    since_us_ = now_us;
    wait_us_ = kDecayUs;
    return Action::trigger;
}

void MeasurementCycle::hurry() {
    const uint32_t taken_us = since_us_ - begun_us_;
    const uint32_t rest_us = taken_us < kShortestUs ? kShortestUs - taken_us : 0;
    if (rest_us < wait_us_) wait_us_ = rest_us;
}

uint32_t MeasurementCycle::jitter_us() {
    // Marsaglia's xorshift with 32 bits (2003).
    random_ ^= random_ << 13;
    random_ ^= random_ >> 17;
    random_ ^= random_ << 5;
    return random_ % kJitterUs;
}

}  // namespace fognav
