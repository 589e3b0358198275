// A stand-in for the library espMqttClient 1.7: the functions that the firmware uses. It connects through the transport that it is
// given, step by step, waits while that waits, and takes no message (but the one that connects) when memory is short.
#pragma once

#include <functional>

#include "ESP8266WiFi.h"

#ifndef EMC_MIN_FREE_MEMORY
#define EMC_MIN_FREE_MEMORY 16384
#endif

namespace espMqttClientTypes {
enum class DisconnectReason : uint8_t {
    USER_OK,
    MQTT_UNACCEPTABLE_PROTOCOL_VERSION,
    MQTT_IDENTIFIER_REJECTED,
    MQTT_SERVER_UNAVAILABLE,
    MQTT_MALFORMED_CREDENTIALS,
    MQTT_NOT_AUTHORIZED,
    TLS_BAD_FINGERPRINT,
    TCP_DISCONNECTED
};
enum class UseInternalTask { NO, YES };
struct MessageProperties {
    uint8_t qos;
    bool dup;
    bool retain;
    uint16_t packetId;
};
using OnConnectCallback = std::function<void(bool)>;
using OnDisconnectCallback = std::function<void(DisconnectReason)>;
using OnMessageCallback =
    std::function<void(const MessageProperties&, const char*, const uint8_t*, size_t, size_t, size_t)>;
}  // namespace espMqttClientTypes

namespace espMqttClientInternals {
class Transport {
public:
    virtual bool connect(IPAddress ip, uint16_t port) = 0;
    virtual bool connect(const char* host, uint16_t port) = 0;
    virtual size_t write(const uint8_t* buf, size_t size) = 0;
    virtual int read(uint8_t* buf, size_t size) = 0;
    virtual void stop() = 0;
    virtual bool connected() = 0;
    virtual bool disconnected() = 0;
};
}  // namespace espMqttClientInternals

class MqttClient {
public:
    virtual ~MqttClient() = default;
    bool connected() const { return state_ == State::connected; }
    bool connect();
    bool disconnect(bool force = false);
    uint16_t subscribe(const char* topic, uint8_t qos);
    uint16_t publish(const char* topic, uint8_t qos, bool retain, const char* payload);
    void loop();

protected:
    explicit MqttClient(espMqttClientTypes::UseInternalTask) {}
    void told_server(const char* host, uint16_t port);
    void told_client(const char* id);
    void told_user(const char* user);
    void told_will(const char* topic, uint8_t qos, bool retain, const char* payload);

    espMqttClientInternals::Transport* _transport = nullptr;
    espMqttClientTypes::OnConnectCallback on_connect_;
    espMqttClientTypes::OnDisconnectCallback on_disconnect_;
    espMqttClientTypes::OnMessageCallback on_message_;

private:
    enum class State { disconnected, connecting_tcp, connecting_mqtt, connected, disconnecting, stopped };

    void deliver();

    State state_ = State::disconnected;
    espMqttClientTypes::DisconnectReason reason_ = espMqttClientTypes::DisconnectReason::TCP_DISCONNECTED;
    const char* host_ = nullptr;
    uint16_t port_ = 0;
};

template <class T>
class MqttClientSetup : public MqttClient {
public:
    T& setServer(const char* host, uint16_t port) { return told_server(host, port), self(); }
    T& setClientId(const char* id) { return told_client(id), self(); }
    T& setCredentials(const char* user, const char*) { return told_user(user), self(); }
    T& setWill(const char* topic, uint8_t qos, bool retain, const char* payload) {
        return told_will(topic, qos, retain, payload), self();
    }
    T& onConnect(espMqttClientTypes::OnConnectCallback callback) { return on_connect_ = callback, self(); }
    T& onDisconnect(espMqttClientTypes::OnDisconnectCallback callback) { return on_disconnect_ = callback, self(); }
    T& onMessage(espMqttClientTypes::OnMessageCallback callback) { return on_message_ = callback, self(); }

protected:
    using MqttClient::MqttClient;

private:
    T& self() { return static_cast<T&>(*this); }
};
