// What one sonar's measurement means, and what all of a node's sonars mean together.
#pragma once

#include "sample.hpp"

namespace fognav {

// A sonar's calibration. An echo nearer than the limit is `blocked`; once blocked, it takes the hysteresis beyond the
// limit to be clear again, so that something at the limit does not make the state flap.
struct SonarLimit {
    int32_t limit_mm = 0;
    bool no_echo_is_clear = false;  // true only where calibration found nothing in range
    uint32_t no_echo_us = 0;        // the pulse by which a clone says "no echo"; 0: none
};

constexpr int32_t kHysteresisMm = 50;

// `before` is the state that the sonar was in.
State classify(const Sample& sample, const SonarLimit& limit, State before);

// One sonar that is blocked blocks; clear takes every sonar.
State fuse(const State* states, int count);

}  // namespace fognav
