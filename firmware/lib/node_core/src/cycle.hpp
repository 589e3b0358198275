// The order of a node's measurements: one sonar after the other, never two at once, since one would hear the other's
// burst; then a pause. The time between two bursts varies, so that no echo of an earlier one, or of another node's, comes
// at the same moment each time: the spike filter drops what does not come twice.
#pragma once

#include <stdint.h>

namespace fognav {

// After a trigger, until its echoes have died away, at least: walls 2 m apart throw a burst to and fro, and its third
// return, 38 ms old, was heard as one of the next sonar's from 1.7 m when that came after 27 ms.
constexpr uint32_t kDecayUs = 50000;
constexpr uint32_t kJitterUs = 10000;  // by up to so much longer

class MeasurementCycle {
public:
    enum class Action : uint8_t {
        wait,     // nothing to do yet
        trigger,  // arm and trigger the sonar `current()` now
        listen,   // its echo is awaited: poll it, and call `measured` when there is a result
        finished  // every sonar has measured: take the reading; the next cycle begins after the pause
    };

    // `seed` makes the jitter of each node its own; 0 means none.
    MeasurementCycle(int sonars, uint32_t seed) : sonars_(sonars), random_(seed) {}

    void set_pause(uint16_t pause_ms) { pause_us_ = pause_ms * 1000u; }

    // What to do at this time (micros(), 32 bits that wrap). `trigger` and `finished` are said once.
    Action step(uint32_t now_us);

    // The sonar's result is here. A doubtful one is measured again before the next sonar is, once in a cycle.
    void measured(bool doubtful);

    // Right after `finished`: leave the pause out, this time.
    void hurry() { wait_us_ -= pause_us_; }

    // Forget what has been measured in this cycle: begin it anew.
    void restart() {
        phase_ = Phase::wait;
        current_ = 0;
        repeated_ = false;
    }

    int current() const { return current_; }

private:
    enum class Phase : uint8_t { wait, listen, complete };

    uint32_t jitter_us();

    Phase phase_ = Phase::wait;
    uint8_t current_ = 0;
    bool repeated_ = false;
    int sonars_;
    uint32_t random_;
    uint32_t pause_us_ = 0;
    uint32_t triggered_us_ = 0;
    uint32_t wait_us_ = 0;  // from the last trigger to the next
};

}  // namespace fognav
