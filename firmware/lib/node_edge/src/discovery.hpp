// Home Assistant's device discovery: one retained message that describes the node and its state.
#pragma once

#include <stddef.h>

#include "settings.hpp"

namespace fognav {

// Write it; return its length, or 0 if the buffer is too small. FOGNAV_HOME_ASSISTANT_LIMIT suffices for every node.
size_t write_discovery(const Settings& settings, const char* firmware, char* buffer, size_t size);

}  // namespace fognav
