// The connection to the broker under the MQTT client, plain or by TLS. Where there is none it says why on the serial port.
#pragma once

#include <espMqttClient.h>

#include "board.hpp"

#if defined(ESP32)
#include <WiFiClientSecure.h>
#endif

namespace fognav {

class BrokerTransport : public espMqttClientInternals::Transport {
public:
    bool connect(const char* host, uint16_t port) override;
    bool connect(IPAddress address, uint16_t port) override { return reach(address.toString().c_str(), address, port); }
    size_t write(const uint8_t* data, size_t size) override { return client_.write(data, size); }
    int read(uint8_t* buffer, size_t size) override { return client_.read(buffer, size); }
    void stop() override { client_.stop(); }
    bool connected() override { return client_.connected() != 0; }
    bool disconnected() override { return !connected(); }

    // Whether the last attempt came as far as the broker: what failed then has failed in MQTT.
    bool reached() const { return reached_; }

protected:
    explicit BrokerTransport(WiFiClient& client) : client_(client) {}

    // Connect; a certificate must be for this name. Say why not, if not.
    virtual bool open(const char* host, IPAddress address, uint16_t port, const char* name) = 0;

private:
    bool reach(const char* host, IPAddress address, uint16_t port);

    WiFiClient& client_;
    bool reached_ = false;
};

class PlainTransport final : public BrokerTransport {
public:
    PlainTransport() : BrokerTransport(plain_) {}

private:
    bool open(const char* host, IPAddress address, uint16_t port, const char* name) override;

    WiFiClient plain_;
};

// Trusts one certificate authority (PEM, which must live as long on an ESP32), and no other.
class TlsTransport final : public BrokerTransport {
public:
    explicit TlsTransport(const char* authority);

private:
    bool open(const char* host, IPAddress address, uint16_t port, const char* name) override;

#if defined(ESP8266)
    // The core's own client checks no name at all when it is given an address, so it is told both.
    struct Client final : BearSSL::WiFiClientSecureCtx {
        bool greet(const char* name) { return _connectSSL(name); }
    };
    BearSSL::X509List trusted_;
    Client secure_;
#else
    const char* trusted_;
    WiFiClientSecure secure_;
#endif
};

}  // namespace fognav
