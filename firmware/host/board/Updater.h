// A stand-in for the writer of an ESP8266's flash.
#pragma once

#include "Update.h"
