// A stand-in for the HTTP client of the ESP8266.
#pragma once

#include "HTTPClient.h"
