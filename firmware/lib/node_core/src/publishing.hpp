// Which readings are published. Saving air must not slow the fog's debounce: after a change every reading goes out until
// enough equal ones have, then one each second says that the node lives.
#pragma once

#include "sample.hpp"

namespace fognav {

enum class PublishMode : uint8_t {
    on_change,      // as above
    every_reading,  // the thesis's (Mendes 2022, section 3.3)
};

constexpr uint32_t kHeartbeatMs = 1000;
constexpr uint8_t kEqualReadings = 10;  // the aggregator's slowest rule takes ten equal readings to clear an area

class PublishPolicy {
public:
    explicit PublishPolicy(PublishMode mode = PublishMode::on_change) : mode_(mode) {}

    // Take a reading's state; true if the reading is to be published.
    bool update(State state, uint64_t uptime_ms);

    // Publish again as after a change, for instance when the connection has come back or a
    // configuration has come: whoever sent it may know nothing yet.
    void restart() { equal_ = 0; }

private:
    PublishMode mode_;
    State state_ = State::unknown;
    uint8_t equal_ = 0;
    uint64_t published_ms_ = 0;
};

}  // namespace fognav
