#include "link.hpp"

#include <time.h>

#include "discovery.hpp"

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
    if (!settings_.tls) {
        set_up(plain_);
        return;
    }
#if defined(ESP8266)
    static BearSSL::X509List trusted(authority);
    secure_.setTrustAnchors(&trusted);
#else
    secure_.setCACert(authority);
#endif
    set_up(secure_);
}

template <class Client>
void BoardLink::set_up(Client& client) {
    client.setServer(settings_.broker, settings_.port);
    client.setClientId(client_id_);
    if (settings_.user[0] != 0) client.setCredentials(settings_.user, settings_.password);
    client.setWill(availability_, FOGNAV_NODE_AVAILABILITY_QOS, true, FOGNAV_NODE_AVAILABILITY_OFFLINE);
    client.onDisconnect([this](espMqttClientTypes::DisconnectReason) { failed_ = true; });
    client.onMessage([this](const espMqttClientTypes::MessageProperties&, const char* topic, const uint8_t* payload,
                            size_t length, size_t index, size_t total) { take(topic, payload, length, index, total); });
}

void BoardLink::join_network() {
    WiFi.disconnect();
    WiFi.begin(settings_.wifi_name, settings_.wifi_password);
}

void BoardLink::connect_broker() {
    // Certificates have dates, and the board has no clock of its own: the fog node tells it the time.
    if (settings_.tls) configTime(0, 0, settings_.broker);
    failed_ = false;
    settings_.tls ? secure_.connect() : plain_.connect();
}

void BoardLink::announce() {
    subscribe(inbox_.topic(Topic::config), FOGNAV_NODE_CONFIG_QOS);
    subscribe(inbox_.topic(Topic::command), FOGNAV_NODE_COMMAND_QOS);
    subscribe(inbox_.topic(Topic::update), FOGNAV_NODE_UPDATE_QOS);
    publish(availability_, FOGNAV_NODE_AVAILABILITY_QOS, true, FOGNAV_NODE_AVAILABILITY_ONLINE);
    publish(problem_topic_, FOGNAV_NODE_PROBLEM_QOS, true, problem_ != nullptr ? problem_ : "");
    if (calibration_.length() > 0) {
        publish(calibration_topic_, FOGNAV_NODE_CALIBRATION_QOS, true, calibration_.c_str());
    }
    if (settings_.home_assistant) announce_to_home_assistant();
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

void BoardLink::subscribe(const char* topic, uint8_t qos) {
    settings_.tls ? secure_.subscribe(topic, qos) : plain_.subscribe(topic, qos);
}

void BoardLink::publish(const char* topic, uint8_t qos, bool retain, const char* payload) {
    settings_.tls ? secure_.publish(topic, qos, retain, payload) : plain_.publish(topic, qos, retain, payload);
}

void BoardLink::announce_to_home_assistant() {
    char topic[FOGNAV_HOME_ASSISTANT_TOPIC_SIZE];
    static char text[2560];  // too much for the stack of an ESP8266
    snprintf(topic, sizeof topic, FOGNAV_HOME_ASSISTANT_TOPIC, settings_.node);
    if (write_discovery(settings_, FOGNAV_FIRMWARE, text, sizeof text) == 0) return;
    publish(topic, FOGNAV_HOME_ASSISTANT_QOS, true, text);
}

}  // namespace fognav
