// A stand-in for the board's radio.
#pragma once

#include <memory>

#include "Arduino.h"

enum wl_status_t { WL_IDLE_STATUS, WL_NO_SSID_AVAIL, WL_CONNECTED, WL_CONNECT_FAILED, WL_WRONG_PASSWORD, WL_DISCONNECTED };
enum WiFiMode { WIFI_STA, WIFI_AP };

class IPAddress {
public:
    bool fromString(const char* text);
    String toString() const { return String(text_.c_str()); }

private:
    std::string text_;
};

struct Radio {
    void persistent(bool) {}
    void mode(WiFiMode) {}
    void setAutoReconnect(bool) {}
    void disconnect() {}
    void begin(const char* name, const char* password);
    wl_status_t status();
    int RSSI() { return -60; }
    int hostByName(const char* name, IPAddress& address, uint32_t timeout_ms = 10000);
    void softAP(const char* name);
    IPAddress softAPIP() { return {}; }
};
extern Radio WiFi;

// A connection to the broker, or to the server of updates: then `body` is what that answers.
class WiFiClient {
public:
    virtual ~WiFiClient() = default;
    virtual int connect(IPAddress address, uint16_t port);
    int connect(const IPAddress& address, uint16_t port, int32_t timeout_ms);
    virtual int available();
    virtual uint8_t connected();
    virtual int read(uint8_t* buffer, size_t size);
    virtual size_t write(const uint8_t*, size_t size) { return size; }
    virtual void stop();
    void setTimeout(uint32_t timeout_ms) { timeout_ms_ = timeout_ms; }
    void setNoDelay(bool) {}
    std::unique_ptr<WiFiClient> clone() const { return std::make_unique<WiFiClient>(*this); }
    void set_body(FILE* body) { body_ = body; }
    FILE* body() { return body_; }

protected:
    bool open_ = false;
    uint32_t timeout_ms_ = 5000;

private:
    FILE* body_ = nullptr;
};
