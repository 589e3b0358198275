// A stand-in for the radio of the ESP8266, and for its TLS.
#pragma once

#include "WiFi.h"

namespace BearSSL {
struct X509List {
    explicit X509List(const char* pem);
};
}  // namespace BearSSL
