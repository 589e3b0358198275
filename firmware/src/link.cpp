#include "link.hpp"

#include <time.h>

#include "discovery.hpp"
#include "in_flash.hpp"
#include "scratch.hpp"

namespace fognav {

void BoardLink::begin(const char* authority) {
    const char* site = settings_.site;
    const char* node = settings_.node;
    snprintf(availability_, sizeof availability_, FOGNAV_NODE_AVAILABILITY_TOPIC, site, node);
    snprintf(reading_, sizeof reading_, FOGNAV_NODE_READING_TOPIC, site, node);
    snprintf(value_, sizeof value_, FOGNAV_NODE_VALUE_TOPIC, site, node);
    snprintf(calibration_topic_, sizeof calibration_topic_, FOGNAV_NODE_CALIBRATION_TOPIC, site, node);
    snprintf(problem_topic_, sizeof problem_topic_, FOGNAV_NODE_PROBLEM_TOPIC, site, node);
    // With the site: a broker that serves several floors disconnects one of two clients with the same id.
    snprintf(client_id_, sizeof client_id_, "node-%s-%s", site, node);
    inbox_.begin(site, node);
    WiFi.persistent(false);  // the flash is not made for a write at every start
    WiFi.mode(WIFI_STA);
    WiFi.setAutoReconnect(false);  // `Connection` decides when
    // Only the one that is needed comes to be.
    if (settings_.tls) {
        static TlsTransport transport(authority);
        transport_ = &transport;
    } else {
        static PlainTransport transport;
        transport_ = &transport;
    }
    client_.use(*transport_);
    client_.setServer(broker_, settings_.port);
    client_.setClientId(client_id_);
    if (settings_.user[0] != 0) client_.setCredentials(settings_.user, settings_.password);
    client_.setWill(availability_, FOGNAV_NODE_AVAILABILITY_QOS, true, FOGNAV_NODE_AVAILABILITY_OFFLINE);
    client_.onConnect([this](bool) {
        accepted_ = true;
        Serial.printf(IN_FLASH("connected to the broker at %s\n"), broker_);
    });
    client_.onDisconnect([this](espMqttClientTypes::DisconnectReason reason) {
        failed_ = true;
        say_why_it_ended(reason);
    });
    client_.onMessage([this](const espMqttClientTypes::MessageProperties&, const char* topic, const uint8_t* payload,
                            size_t length, size_t index, size_t total) { take(topic, payload, length, index, total); });
}

void BoardLink::say_why_it_ended(espMqttClientTypes::DisconnectReason reason) {
    using espMqttClientTypes::DisconnectReason;
    const char* words = IN_FLASH("the broker ended the connection without an answer: do port and tls of node.json fit together?");
    if (reason == DisconnectReason::MQTT_MALFORMED_CREDENTIALS || reason == DisconnectReason::MQTT_NOT_AUTHORIZED) {
        words = IN_FLASH("the broker refuses the node's user or password: write them anew (fognav node replace)");
    } else if (reason == DisconnectReason::MQTT_IDENTIFIER_REJECTED) {
        words = IN_FLASH("the broker refuses the node's client id");
    } else if (reason != DisconnectReason::TCP_DISCONNECTED) {
        words = IN_FLASH("the broker can't serve the node now");
    } else if (accepted_) {
        words = IN_FLASH("the connection to the broker was lost");
    } else if (!transport_->reached()) {
        return;  // the transport has said it
    }
    Serial.printf("%s\n", words);
}

void BoardLink::join_network() {
    if (joining_) {
        const char* words = IN_FLASH("is it in reach, and wifi_password right?");
        if (WiFi.status() == WL_NO_SSID_AVAIL) words = IN_FLASH("there is none of this name here (an ESP8266 knows 2.4 GHz only)");
#if defined(ESP8266)
        if (WiFi.status() == WL_WRONG_PASSWORD) words = IN_FLASH("wifi_password of node.json is wrong");
#endif
        Serial.printf(IN_FLASH("the Wi-Fi network %s was not joined: %s\n"), settings_.wifi_name, words);
    }
    joining_ = true;
    WiFi.disconnect();
    WiFi.begin(settings_.wifi_name, settings_.wifi_password);
}

void BoardLink::connect_broker() {
    if (tried_ && settings_.second_broker[0] != 0) {
        broker_ = broker_ == settings_.broker ? settings_.second_broker : settings_.broker;
        client_.setServer(broker_, settings_.port);
    }
    tried_ = true;
    // Certificates have dates, and the board has no clock of its own: the fog node tells it the time.
    if (settings_.tls) configTime(0, 0, broker_);
    joining_ = false;
    accepted_ = false;
    failed_ = !client_.connect();
}

bool BoardLink::announce() {
    return subscribe(inbox_.topic(Topic::config), FOGNAV_NODE_CONFIG_QOS) &&
           subscribe(inbox_.topic(Topic::command), FOGNAV_NODE_COMMAND_QOS) &&
           subscribe(inbox_.topic(Topic::update), FOGNAV_NODE_UPDATE_QOS) &&
           publish(availability_, FOGNAV_NODE_AVAILABILITY_QOS, true, FOGNAV_NODE_AVAILABILITY_ONLINE) &&
           publish(problem_topic_, FOGNAV_NODE_PROBLEM_QOS, true, problem_ != nullptr ? problem_ : "") &&
           (calibration_.length() == 0 ||
            publish(calibration_topic_, FOGNAV_NODE_CALIBRATION_QOS, true, calibration_.c_str())) &&
           (!settings_.home_assistant || announce_to_home_assistant());
}

// The library refuses what it has no memory for, and gives no number then.
bool BoardLink::was_taken(uint16_t packet) {
    const bool refused = packet == 0;
    if (refused != refused_) {
        Serial.printf(refused ? IN_FLASH("no message can be sent: %lu bytes of memory are free in one piece, and %lu are kept\n")
                              : IN_FLASH("messages can be sent again: %lu bytes of memory are free in one piece, and %lu are kept\n"),
                      static_cast<unsigned long>(largest_free_block()), static_cast<unsigned long>(EMC_MIN_FREE_MEMORY));
    }
    refused_ = refused;
    return !refused;
}

void BoardLink::set_calibration(const String& text) {
    calibration_ = text;
    if (broker_up()) publish(calibration_topic_, FOGNAV_NODE_CALIBRATION_QOS, true, calibration_.c_str());
}

void BoardLink::report(const char* problem) {
    if (problem != nullptr) Serial.printf("%s\n", problem);
    if (problem == problem_) return;
    problem_ = problem;
    if (broker_up()) publish(problem_topic_, FOGNAV_NODE_PROBLEM_QOS, true, problem != nullptr ? problem : "");
}

void BoardLink::publish_reading(const Node& node) {
    if (!broker_up()) return;  // a reading that is late is worth nothing
    publish(reading_, FOGNAV_NODE_READING_QOS, false, node.message());
    const State state = node.reading().state;
    if (settings_.thesis_area == 0 || state == State::unknown) return;
    char topic[24];
    snprintf(topic, sizeof topic, "area %u", static_cast<unsigned>(settings_.thesis_area));
    publish(topic, 0, false, state == State::blocked ? "blocked" : "clear");
}

void BoardLink::publish_value(const char* message) {
    if (broker_up()) publish(value_, FOGNAV_NODE_VALUE_QOS, false, message);
}

void BoardLink::take(const char* topic, const uint8_t* payload, size_t length, size_t index, size_t total) {
    if (!inbox_.take(topic, payload, length, index, total)) return;
    report(receiver_.receive(inbox_.received(), inbox_.text(), inbox_.size()));
}

bool BoardLink::announce_to_home_assistant() {
    char topic[FOGNAV_HOME_ASSISTANT_TOPIC_SIZE];
    snprintf(topic, sizeof topic, FOGNAV_HOME_ASSISTANT_TOPIC, settings_.node);
    const size_t length = write_discovery(settings_, FOGNAV_FIRMWARE, scratch, sizeof scratch);
    return length == 0 || publish(topic, FOGNAV_HOME_ASSISTANT_QOS, true, scratch);
}

}  // namespace fognav
