// A stand-in for the board's HTTP client: it is answered with the file `served` beside the flash, if there is one. The one of the
// ESP8266 connects with a copy of the client that it is given, since version 3 of its core.
#pragma once

#include "WiFi.h"

#define HTTP_CODE_OK 200

struct HTTPClient {
    void setTimeout(uint16_t) {}
    void setConnectTimeout(int32_t) {}
    void setReuse(bool) {}
    bool begin(WiFiClient& client, const char* url);
    int GET();
    int getSize();
    WiFiClient* getStreamPtr();
    void end();

private:
    std::unique_ptr<WiFiClient> copy_;
    WiFiClient* client_ = nullptr;
};
