// Reads what a node is told to measure by: the configuration that the aggregator publishes, and a calibration that the node
// has stored.
#pragma once

#include "messages.hpp"

namespace fognav {

// Read a configuration for a node with so many sonars. Return nullptr, or what is wrong with it; `config` is then
// unchanged. Unknown members are ignored. The pulses for "no echo" are those of `config`.
const char* read_config(const char* text, size_t size, int sonars, NodeConfig& config);

// Read a stored calibration, as `write_calibration` wrote it, likewise. The pause is that of `config`.
const char* read_calibration(const char* text, size_t size, int sonars, NodeConfig& config);

}  // namespace fognav
