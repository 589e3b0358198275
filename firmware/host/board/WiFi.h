// A stand-in for the board's radio.
#pragma once

#include "Arduino.h"

enum wl_status_t { WL_DISCONNECTED, WL_CONNECTED };
enum WiFiMode { WIFI_STA, WIFI_AP };

struct IPAddress {};

struct Radio {
    void persistent(bool) {}
    void mode(WiFiMode) {}
    void setAutoReconnect(bool) {}
    void disconnect() {}
    void begin(const char* name, const char* password);
    wl_status_t status();
    int RSSI() { return -60; }
    void softAP(const char* name);
    IPAddress softAPIP() { return {}; }
};
extern Radio WiFi;

class WiFiClient {
public:
    int available();
    uint8_t connected() { return body_ != nullptr ? 1 : 0; }
    int read(uint8_t* buffer, size_t size);
    void set_body(FILE* body) { body_ = body; }
    FILE* body() { return body_; }

private:
    FILE* body_ = nullptr;  // of the answer
};
