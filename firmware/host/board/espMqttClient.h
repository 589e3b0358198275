// A stand-in for the library espMqttClient: the functions that the firmware uses, as its documentation names them.
#pragma once

#include <functional>

#include "ESP8266WiFi.h"

namespace espMqttClientTypes {
enum class DisconnectReason : int8_t { TCP_DISCONNECTED };
enum class UseInternalTask { NO, YES };
struct MessageProperties {
    uint8_t qos;
    bool dup;
    bool retain;
    uint16_t packetId;
};
using OnDisconnectCallback = std::function<void(DisconnectReason)>;
using OnMessageCallback =
    std::function<void(const MessageProperties&, const char*, const uint8_t*, size_t, size_t, size_t)>;
}  // namespace espMqttClientTypes

class espMqttClient {
public:
    explicit espMqttClient(espMqttClientTypes::UseInternalTask = espMqttClientTypes::UseInternalTask::YES) {}
    espMqttClient& setServer(const char* host, uint16_t port);
    espMqttClient& setClientId(const char* id);
    espMqttClient& setCredentials(const char* user, const char* password);
    espMqttClient& setWill(const char* topic, uint8_t qos, bool retain, const char* payload);
    espMqttClient& onDisconnect(espMqttClientTypes::OnDisconnectCallback callback);
    espMqttClient& onMessage(espMqttClientTypes::OnMessageCallback callback);
    bool connected() const { return connected_; }
    bool connect();
    bool disconnect(bool force = false);
    uint16_t subscribe(const char* topic, uint8_t qos);
    uint16_t publish(const char* topic, uint8_t qos, bool retain, const char* payload);
    void loop();

private:
    bool connected_ = false;
    bool connecting_ = false;
    espMqttClientTypes::OnDisconnectCallback on_disconnect_;
    espMqttClientTypes::OnMessageCallback on_message_;
};

class espMqttClientSecure : public espMqttClient {
public:
    using espMqttClient::espMqttClient;
    espMqttClientSecure& setTrustAnchors(const BearSSL::X509List* trusted);
    espMqttClientSecure& setCACert(const char* pem);
};
