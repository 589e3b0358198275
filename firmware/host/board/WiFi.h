// A stand-in for the board's radio.
#pragma once

#include "Arduino.h"

enum wl_status_t { WL_DISCONNECTED, WL_CONNECTED };
enum WiFiMode { WIFI_STA };

struct Radio {
    void persistent(bool on);
    void mode(WiFiMode mode);
    void setAutoReconnect(bool on);
    void disconnect();
    void begin(const char* name, const char* password);
    wl_status_t status();
    int RSSI();
};
extern Radio WiFi;
