#include "publishing.hpp"

namespace fognav {

bool PublishPolicy::update(const Reading& reading, const State* states) {
    if (changed(reading, states)) equal_ = 0;
    const bool repeated = equal_ < kEqualReadings;
    if (repeated) ++equal_;
    const bool due = reading.uptime_ms - published_ms_ >= kHeartbeatMs;
    if (mode_ == PublishMode::every_reading || repeated || due) {
        published_ms_ = reading.uptime_ms;
        return true;
    }
    return false;
}

bool PublishPolicy::changed(const Reading& reading, const State* states) {
    bool changed = reading.state != state_;
    state_ = reading.state;
    for (int i = 0; i < reading.sonars; ++i) {
        const int32_t moved = reading.samples[i].range_mm - range_mm_[i];
        const bool has_moved = states[i] == State::blocked && (moved > kMovedMm || moved < -kMovedMm);
        if (states[i] == states_[i] && !has_moved) continue;
        states_[i] = states[i];
        range_mm_[i] = reading.samples[i].range_mm;
        changed = true;
    }
    return changed;
}

}  // namespace fognav
