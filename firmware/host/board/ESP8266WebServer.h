// A stand-in for the web server of the ESP8266, which has the same functions under another name.
#pragma once

#include "WebServer.h"

using ESP8266WebServer = WebServer;
