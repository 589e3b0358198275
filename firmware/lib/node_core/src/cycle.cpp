#include "cycle.hpp"

namespace fognav {

MeasurementCycle::Action MeasurementCycle::step(uint32_t now_us) {
    if (phase_ == Phase::listen) return Action::listen;
    if (phase_ == Phase::complete) {
        phase_ = Phase::wait;
        wait_us_ += pause_us_;
        return Action::finished;
    }
    if (now_us - triggered_us_ < wait_us_) return Action::wait;
    phase_ = Phase::listen;
    triggered_us_ = now_us;
    wait_us_ = kDecayUs + jitter_us();
    return Action::trigger;
}

void MeasurementCycle::measured(bool doubtful) {
    phase_ = Phase::wait;
    if (doubtful && !repeated_) {
        repeated_ = true;
        return;
    }
    if (++current_ < sonars_) return;
    current_ = 0;
    repeated_ = false;
    phase_ = Phase::complete;
}

uint32_t MeasurementCycle::jitter_us() {
    // Marsaglia's xorshift with 32 bits (2003).
    random_ ^= random_ << 13;
    random_ ^= random_ >> 17;
    random_ ^= random_ << 5;
    return random_ % kJitterUs;
}

}  // namespace fognav
