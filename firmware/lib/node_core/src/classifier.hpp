// What one sonar's measurement means, and what all of a node's sonars mean together.
#pragma once

#include "sample.hpp"

namespace fognav {

// A sonar's calibration. An echo nearer than the limit is `blocked`; once blocked, it takes the hysteresis beyond the
// limit to be clear again, so that something at the limit does not make the state flap. An echo from farther than free
// space gives one came by a detour, from behind something that reflects it away: nobody measured that nothing is there.
struct SonarLimit {
    int32_t limit_mm = 0;
    int32_t max_mm = 0;             // the farthest echo that free space gives; 0: not known
    bool no_echo_is_clear = false;  // true only where calibration found nothing in range
    uint32_t no_echo_us = 0;        // the pulse by which a clone says "no echo"; 0: none
};

constexpr int32_t kHysteresisMm = 50;

// `before` is the state that the sonar was in.
State classify(const Sample& sample, const SonarLimit& limit, State before);

// One sonar that is blocked blocks; clear takes every sonar, and an echo of at least one: a dead or covered sonar is as
// silent as free space.
State fuse(const State* states, const Sample* samples, int count);

}  // namespace fognav
