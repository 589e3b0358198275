// Room for one long text at a time, too much for the stack of an ESP8266: what the portal is sent, or what Home Assistant is told.
// Whoever writes there is done with it before the loop's next turn.
#pragma once

#include <stddef.h>

namespace fognav {

extern char scratch[2560];

}  // namespace fognav
