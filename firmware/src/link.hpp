// Radio and broker: what `Connection` asks for, the node's messages out, and the messages for it in.
#pragma once

#include <espMqttClient.h>

#include "board.hpp"
#include "broker_transport.hpp"
#include "connection.hpp"
#include "inbox.hpp"
#include "node.hpp"
#include "settings.hpp"

namespace fognav {

// Who acts on messages for the node. Returns nullptr, or why one is refused.
class Receiver {
public:
    virtual const char* receive(Topic topic, const char* text, size_t size) = 0;

protected:
    ~Receiver() = default;
};

// The MQTT client, over a connection that it is given: the library's own ones make one each for plain and TLS, of which the
// second takes 6 KB of an ESP8266 for its stack alone. It has no task, so callbacks come from `loop`, never in a step of the node.
class BrokerClient final : public MqttClientSetup<BrokerClient> {
public:
    BrokerClient() : MqttClientSetup(espMqttClientTypes::UseInternalTask::NO) {}
    void use(espMqttClientInternals::Transport& transport) { _transport = &transport; }
};

class BoardLink final : public Link {
public:
    BoardLink(const Settings& settings, Receiver& receiver)
        : settings_(settings), receiver_(receiver), broker_(settings.broker) {}

    // Prepare the client of the broker, which trusts this certificate authority (PEM) and no other.
    void begin(const char* authority);

    void loop() { client_.loop(); }

    void join_network() override;
    bool network_up() override { return WiFi.status() == WL_CONNECTED; }
    void connect_broker() override;
    // The library takes some turns of its loop for it, and connects no earlier.
    void leave_broker() override { client_.disconnect(true); }
    bool broker_up() override { return client_.connected(); }
    bool broker_failed() override { return failed_; }
    bool announce() override;
    void restart() override { ESP.restart(); }

    int rssi() { return WiFi.RSSI(); }

    // What the node has stored, published with each connection: the broker may have lost it.
    void set_calibration(const String& text);

    // Why something was refused; nullptr: nothing was.
    void report(const char* problem);

    void publish_reading(const Node& node);
    void publish_value(const char* message);

private:
    void take(const char* topic, const uint8_t* payload, size_t length, size_t index, size_t total);
    bool subscribe(const char* topic, uint8_t qos) { return was_taken(client_.subscribe(topic, qos)); }
    bool publish(const char* topic, uint8_t qos, bool retain, const char* payload) {
        return was_taken(client_.publish(topic, qos, retain, payload));
    }
    bool was_taken(uint16_t packet);
    bool announce_to_home_assistant();
    void say_why_it_ended(espMqttClientTypes::DisconnectReason reason);

    const Settings& settings_;
    Receiver& receiver_;
    const char* broker_;  // the one that was tried last, of two
    bool tried_ = false;
    Inbox inbox_;
    BrokerClient client_;
    BrokerTransport* transport_ = nullptr;
    bool joining_ = false;
    bool failed_ = false;
    bool accepted_ = false;  // by the broker, at the last attempt
    bool refused_ = false;   // the last message, for lack of memory
    const char* problem_ = nullptr;
    String calibration_;
    char availability_[FOGNAV_NODE_AVAILABILITY_TOPIC_SIZE] = "";
    char reading_[FOGNAV_NODE_READING_TOPIC_SIZE] = "";
    char value_[FOGNAV_NODE_VALUE_TOPIC_SIZE] = "";
    char calibration_topic_[FOGNAV_NODE_CALIBRATION_TOPIC_SIZE] = "";
    char problem_topic_[FOGNAV_NODE_PROBLEM_TOPIC_SIZE] = "";
    char client_id_[2 * kIdSize + 6] = "";
};

}  // namespace fognav
