// Radio and broker: what `Connection` asks for, the node's messages out, and the messages for it in.
#pragma once

#include <espMqttClient.h>

#include "board.hpp"
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

class BoardLink final : public Link {
public:
    BoardLink(const Settings& settings, Receiver& receiver) : settings_(settings), receiver_(receiver) {}

    // Prepare the client of the broker, which trusts this certificate authority (PEM) and no other.
    void begin(const char* authority);

    void loop() { settings_.tls ? secure_.loop() : plain_.loop(); }

    void join_network() override;
    bool network_up() override { return WiFi.status() == WL_CONNECTED; }
    void connect_broker() override;
    // The library takes some turns of its loop for it, and connects no earlier.
    void leave_broker() override { settings_.tls ? secure_.disconnect(true) : plain_.disconnect(true); }
    bool broker_up() override { return settings_.tls ? secure_.connected() : plain_.connected(); }
    bool broker_failed() override { return failed_; }
    void announce() override;
    void restart() override { ESP.restart(); }

    int rssi() { return WiFi.RSSI(); }

    // What the node has stored, published with each connection: the broker may have lost it.
    void set_calibration(const String& text);

    // Why something was refused; nullptr: nothing was.
    void report(const char* problem);

    void publish_reading(const Node& node);
    void publish_value(const char* message);

private:
    template <class Client>
    void set_up(Client& client);
    void take(const char* topic, const uint8_t* payload, size_t length, size_t index, size_t total);
    void subscribe(const char* topic, uint8_t qos);
    void publish(const char* topic, uint8_t qos, bool retain, const char* payload);
    void announce_to_home_assistant();

    const Settings& settings_;
    Receiver& receiver_;
    Inbox inbox_;
#if defined(ESP8266)
    espMqttClient plain_;
    espMqttClientSecure secure_;
#else
    // Without a task of its own: callbacks come from `loop`, and so never while the node takes a step.
    espMqttClient plain_{espMqttClientTypes::UseInternalTask::NO};
    espMqttClientSecure secure_{espMqttClientTypes::UseInternalTask::NO};
#endif
    bool failed_ = false;
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
