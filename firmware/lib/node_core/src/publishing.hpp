// Which readings are published. Saving air must not slow the fog's debounce: after a change every reading goes out until
// enough equal ones have, then one each second says that the node lives.
#pragma once

#include "messages.hpp"

namespace fognav {

enum class PublishMode : uint8_t {
    on_change,      // as above
    every_reading,  // the thesis's (Mendes 2022, section 3.3)
};

constexpr uint32_t kHeartbeatMs = 1000;
constexpr uint8_t kEqualReadings = 10;  // the aggregator's slowest rule takes ten equal readings to clear an area

// What blocks has moved: the aggregator takes an echo within 0.3 m of a robot's rim for that robot, and must soon know of
// somebody who stands in front of one.
constexpr int32_t kMovedMm = 100;

class PublishPolicy {
public:
    explicit PublishPolicy(PublishMode mode = PublishMode::on_change) : mode_(mode) {}

    // Take a reading and what each of its sonars shows; true if the reading is to be published. A sonar whose state
    // changes is a change, also where another one's leaves the node's state as it is.
    bool update(const Reading& reading, const State* states);

    // Publish again as after a change, for instance when the connection has come back or a
    // configuration has come: whoever sent it may know nothing yet.
    void restart() { equal_ = 0; }

private:
    bool changed(const Reading& reading, const State* states);

    PublishMode mode_;
    State state_ = State::unknown;
    State states_[kMaxSonars] = {};
    int32_t range_mm_[kMaxSonars] = {};  // of each sonar at the last change; counts while it is blocked
    uint8_t equal_ = 0;
    uint64_t published_ms_ = 0;
};

}  // namespace fognav
