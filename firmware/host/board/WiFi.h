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

struct WiFiClient {
    int available() { return 0; }
    uint8_t connected() { return 0; }
    int read(uint8_t*, size_t) { return -1; }
};
