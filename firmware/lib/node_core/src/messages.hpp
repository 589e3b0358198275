// The node's messages, as the contract defines them (fognav_contract.h is generated from it).
#pragma once

#include <stddef.h>

#include "calibration.hpp"

namespace fognav {

struct Reading {
    uint32_t seq = 0;   // from 0 at each boot, may wrap
    uint32_t boot = 0;  // random, new at each boot
    uint64_t uptime_ms = 0;
    int sonars = 0;
    Sample samples[kMaxSonars] = {};
    State state = State::unknown;
    int16_t rssi = 0;  // dBm; 0: not known
    const char* firmware = "";
};

// Write a reading as JSON; return its length, or 0 if the buffer is too small for it.
size_t write_reading(const Reading& reading, char* buffer, size_t size);

struct NodeConfig {
    uint64_t version = 0;
    int sonars = 0;
    SonarLimit limits[kMaxSonars] = {};
    uint16_t pause_ms = 10;
};

// What a node has learned: how it ended for each sonar, and the settings with what was learned. The configuration's
// version is that of the one that it replaces.
struct CalibrationReport {
    uint32_t boot = 0;
    CalibrationResult results[kMaxSonars] = {};
    FreeSamples free[kMaxSonars] = {};
    NodeConfig config;
};

// Write it as JSON; return its length, or 0 if the buffer is too small for it.
size_t write_calibration(const CalibrationReport& report, char* buffer, size_t size);

}  // namespace fognav
