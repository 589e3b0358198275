#include "publishing.hpp"

namespace fognav {

bool PublishPolicy::update(State state, uint64_t uptime_ms) {
    if (state != state_) equal_ = 0;
    state_ = state;
    const bool repeated = equal_ < kEqualReadings;
    if (repeated) ++equal_;
    const bool due = uptime_ms - published_ms_ >= kHeartbeatMs;
    if (mode_ == PublishMode::every_reading || repeated || due) {
        published_ms_ = uptime_ms;
        return true;
    }
    return false;
}

}  // namespace fognav
