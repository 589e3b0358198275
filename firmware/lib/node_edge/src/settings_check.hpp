// What no single setting shows: whether they are complete, and whether the board's pins suffice for them.
#pragma once

#include "settings.hpp"

namespace fognav {

// Give the pins of the profile to sonars without pins of their own: the first two.
void use_profile(const BoardPins& board, Settings& settings);

// nullptr, or what is wrong and what to do.
const char* settings_problem(const BoardPins& board, const Settings& settings);

}  // namespace fognav
