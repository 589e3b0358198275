// A stand-in for the board's HTTP client: it is answered with the file `served` beside the flash, if there is one.
#pragma once

#include "WiFi.h"

#define HTTP_CODE_OK 200

struct HTTPClient {
    void setTimeout(uint16_t) {}
    bool begin(WiFiClient& client, const char* url);
    int GET();
    int getSize();
    void end();

private:
    WiFiClient* client_ = nullptr;
};
