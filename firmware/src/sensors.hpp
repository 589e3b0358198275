// The sensors at the board's pins: sonars by interrupt, laser rangers and a thermometer by their libraries, a voltage.
#pragma once

#include "node.hpp"
#include "settings.hpp"
#include "values.hpp"

namespace fognav {

// Start the rangers of the settings on the I2C bus; `sensors` receives them, and nullptr for sonars.
void begin_rangers(const Settings& settings, RangeSensor* (&sensors)[kMaxSonars]);

// Let the echo lines tell the node of their edges.
void begin_sonars(const Settings& settings, Node& node);

// Trigger a sonar; nothing for a ranger.
void trigger(const Settings& settings, int sonar);

void begin_values(const Settings& settings, Values& values);

}  // namespace fognav
