// What one sonar measured, and what a measurement means. The words are the contract's (fognav_contract.h).
#pragma once

#include <stdint.h>

namespace fognav {

constexpr int kMaxSonars = 8;  // FOGNAV_NODE_READING_RANGE_M_ITEMS_MAX; messages.cpp asserts it

enum class Status : uint8_t {
    ok,       // an echo at range_mm
    no_echo,  // the module listened and heard nothing
    stuck,    // the module did not answer as it should: not connected, line held, or nearer than it can measure
};

enum class State : uint8_t { unknown, clear, blocked };

struct Sample {
    Status status;
    int32_t range_mm;  // 0 unless status is ok
};

}  // namespace fognav
