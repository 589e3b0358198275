// The order of a node's measurements: one sonar after the other, never two at once, since one would hear the other's
// burst; then a pause. The pause varies a little, so that nodes that see each other do not stay in step.
#pragma once

#include "echo.hpp"

namespace fognav {

constexpr uint32_t kDecayUs = 27000;  // after a trigger, until its echoes have died away
constexpr uint32_t kJitterUs = 6000;  // the pause is longer by up to so much
// Of a cycle without its pause: the aggregator takes readings that are closer together than 40 ms for one.
constexpr uint32_t kShortestUs = 45000;

class MeasurementCycle {
public:
    enum class Action : uint8_t {
        wait,     // nothing to do yet
        trigger,  // arm and trigger the sonar `current()` now
        listen,   // its echo is awaited: poll it, and call `measured` when there is a result
        finished  // every sonar has measured once: take the reading; the next cycle begins after the pause
    };

    // `seed` makes the jitter of each node its own; 0 means none.
    MeasurementCycle(int sonars, uint32_t seed) : sonars_(sonars), random_(seed) {}

    void set_pause(uint16_t pause_ms) { pause_us_ = pause_ms * 1000u; }

    // What to do at this time (micros(), 32 bits that wrap). `trigger` and `finished` are said once.
    Action step(uint32_t now_us);

    void measured() { phase_ = Phase::decay; }

    // After `finished`: leave the pause out, or most of it, this time.
    void hurry();

    // Forget what has been measured in this cycle: begin it anew.
    void restart() {
        phase_ = Phase::pause;
        current_ = 0;
    }

    int current() const { return current_; }

private:
    enum class Phase : uint8_t { pause, listen, decay };

    uint32_t jitter_us();

    Phase phase_ = Phase::pause;
    uint8_t current_ = 0;
    int sonars_;
    uint32_t random_;
    uint32_t pause_us_ = 50000;
    uint32_t begun_us_ = 0;  // of the cycle: its first trigger
    uint32_t since_us_ = 0;  // of the pause, or of the last trigger
    uint32_t wait_us_ = 0;
};

}  // namespace fognav
