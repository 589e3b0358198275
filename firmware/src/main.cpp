// The node on its board: Wemos D1 mini (ESP8266) or D1 mini 32 (ESP32). What it decides is in lib/node_core, how it stays
// connected in lib/node_edge; here are only pins, radio, files and the MQTT library.
#include <Arduino.h>
#include <LittleFS.h>
#include <espMqttClient.h>
#include <time.h>

#if defined(ESP8266)
#include <ESP8266WiFi.h>
#else
#include <WiFi.h>
#endif

#include "connection.hpp"
#include "discovery.hpp"
#include "fognav_contract.h"
#include "node.hpp"
#include "settings.hpp"

#ifndef FOGNAV_FIRMWARE
#define FOGNAV_FIRMWARE "unknown"
#endif

namespace {

constexpr const char* kSettingsFile = "/node.json";
constexpr const char* kAuthorityFile = "/ca.pem";
constexpr size_t kSettingsMax = 2048;
constexpr size_t kAuthorityMax = 4096;
constexpr uint32_t kComplainEveryMs = 5000;

uint32_t random_bits() {
#if defined(ESP8266)
    return RANDOM_REG32;  // the hardware's generator
#else
    return esp_random();
#endif
}

// A file as text with a terminating zero; an empty one if it is missing or larger than `size_max`.
String read_file(const char* name, size_t size_max) {
    File file = LittleFS.open(name, "r");
    if (!file || file.size() > size_max) return String();
    return file.readString();
}

class Board : public fognav::Link {
public:
    explicit Board(const fognav::Settings& settings) : settings_(settings) {}

    // Prepare the client of the broker. False if the certificate authority is missing.
    bool begin() {
        snprintf(availability_, sizeof availability_, FOGNAV_NODE_AVAILABILITY_TOPIC, settings_.site, settings_.node);
        snprintf(reading_, sizeof reading_, FOGNAV_NODE_READING_TOPIC, settings_.site, settings_.node);
        snprintf(config_, sizeof config_, FOGNAV_NODE_CONFIG_TOPIC, settings_.site, settings_.node);
        snprintf(client_id_, sizeof client_id_, "node-%s", settings_.node);
        WiFi.persistent(false);  // the flash is not made for a write at every start
        WiFi.mode(WIFI_STA);
        WiFi.setAutoReconnect(false);  // `Connection` decides when
        if (!settings_.tls) {
            set_up(plain_);
            return true;
        }
        authority_ = read_file(kAuthorityFile, kAuthorityMax);
        if (authority_.length() == 0) return false;
#if defined(ESP8266)
        static BearSSL::X509List trusted(authority_.c_str());
        secure_.setTrustAnchors(&trusted);
#else
        secure_.setCACert(authority_.c_str());
#endif
        set_up(secure_);
        return true;
    }

    void loop() { settings_.tls ? secure_.loop() : plain_.loop(); }

    void join_network() override {
        WiFi.disconnect();
        WiFi.begin(settings_.wifi_name, settings_.wifi_password);
    }

    bool network_up() override { return WiFi.status() == WL_CONNECTED; }

    void connect_broker() override {
        // Certificates have dates, and the board has no clock of its own: the fog node tells it the time.
        if (settings_.tls) configTime(0, 0, settings_.broker);
        failed_ = false;
        settings_.tls ? secure_.connect() : plain_.connect();
    }

    // The library takes some turns of its loop for it, and connects no earlier.
    void leave_broker() override { settings_.tls ? secure_.disconnect(true) : plain_.disconnect(true); }

    bool broker_up() override { return settings_.tls ? secure_.connected() : plain_.connected(); }

    bool broker_failed() override { return failed_; }

    void announce() override {
        subscribe(config_, FOGNAV_NODE_CONFIG_QOS);
        publish(availability_, FOGNAV_NODE_AVAILABILITY_QOS, true, FOGNAV_NODE_AVAILABILITY_ONLINE);
        if (settings_.home_assistant) announce_to_home_assistant();
        node_->on_connected();
    }

    void restart() override { ESP.restart(); }

    void serve(fognav::Node& node) { node_ = &node; }

    int rssi() { return WiFi.RSSI(); }

    void publish_reading() {
        if (!broker_up()) return;  // a reading that is late is worth nothing
        publish(reading_, FOGNAV_NODE_READING_QOS, false, node_->message());
        const fognav::State state = node_->reading().state;
        if (settings_.thesis_area == 0 || state == fognav::State::unknown) return;
        char topic[24];
        snprintf(topic, sizeof topic, "area %u", static_cast<unsigned>(settings_.thesis_area));
        publish(topic, 0, false, state == fognav::State::blocked ? "blocked" : "clear");
    }

private:
    template <class Client>
    void set_up(Client& client) {
        client.setServer(settings_.broker, settings_.port);
        client.setClientId(client_id_);
        if (settings_.user[0] != 0) client.setCredentials(settings_.user, settings_.password);
        client.setWill(availability_, FOGNAV_NODE_AVAILABILITY_QOS, true, FOGNAV_NODE_AVAILABILITY_OFFLINE);
        client.onDisconnect([this](espMqttClientTypes::DisconnectReason) { failed_ = true; });
        client.onMessage([this](const espMqttClientTypes::MessageProperties&, const char*, const uint8_t* payload,
                                size_t length, size_t index, size_t total) { take(payload, length, index, total); });
    }

    // A part of the only message that the node subscribes to. Longer ones than the contract allows are left out.
    void take(const uint8_t* payload, size_t length, size_t index, size_t total) {
        if (total > sizeof message_ || index + length > total) return;
        memcpy(message_ + index, payload, length);
        if (index + length < total) return;
        const char* problem = node_->configure(message_, total);
        if (problem != nullptr) Serial.printf("the configuration is refused: %s\n", problem);
    }

    void subscribe(const char* topic, uint8_t qos) {
        settings_.tls ? secure_.subscribe(topic, qos) : plain_.subscribe(topic, qos);
    }

    void publish(const char* topic, uint8_t qos, bool retain, const char* payload) {
        settings_.tls ? secure_.publish(topic, qos, retain, payload) : plain_.publish(topic, qos, retain, payload);
    }

    void announce_to_home_assistant() {
        char topic[FOGNAV_HOME_ASSISTANT_TOPIC_SIZE];
        static char text[2048];  // too much for the stack of an ESP8266
        snprintf(topic, sizeof topic, FOGNAV_HOME_ASSISTANT_TOPIC, settings_.node);
        if (fognav::write_discovery(settings_, FOGNAV_FIRMWARE, text, sizeof text) == 0) return;
        publish(topic, FOGNAV_HOME_ASSISTANT_QOS, true, text);
    }

    const fognav::Settings& settings_;
    fognav::Node* node_ = nullptr;
#if defined(ESP8266)
    espMqttClient plain_;
    espMqttClientSecure secure_;
#else
    // Without a task of its own: callbacks come from `loop`, and so never while the node takes a step.
    espMqttClient plain_{espMqttClientTypes::UseInternalTask::NO};
    espMqttClientSecure secure_{espMqttClientTypes::UseInternalTask::NO};
#endif
    String authority_;
    bool failed_ = false;
    char availability_[FOGNAV_NODE_AVAILABILITY_TOPIC_SIZE];
    char reading_[FOGNAV_NODE_READING_TOPIC_SIZE];
    char config_[FOGNAV_NODE_CONFIG_TOPIC_SIZE];
    char client_id_[fognav::kIdSize + 5];
    char message_[FOGNAV_NODE_CONFIG_LIMIT];
};

// One echo line, for its interrupt.
struct EchoLine {
    fognav::Node* node;
    int sonar;
    int pin;
};

EchoLine echo_lines[fognav::kMaxSonars];

void IRAM_ATTR on_echo(void* argument) {
    const EchoLine& line = *static_cast<EchoLine*>(argument);
    line.node->on_edge(line.sonar, digitalRead(line.pin) == HIGH, micros());
}

fognav::Settings settings;
Board board(settings);
fognav::Node* node = nullptr;
fognav::Connection* connection = nullptr;

// Say it on the serial port until somebody reads it: without settings there is nothing else to do.
[[noreturn]] void complain(const char* problem) {
    for (;;) {
        Serial.printf("%s\n", problem);
        delay(kComplainEveryMs);
    }
}

void trigger(int sonar) {
    const uint8_t pin = static_cast<uint8_t>(settings.pins[sonar].trigger);
    digitalWrite(pin, HIGH);
    delayMicroseconds(fognav::kTriggerUs);
    digitalWrite(pin, LOW);
}

void set_up_sonars() {
    for (int i = 0; i < settings.sonars; ++i) {
        const fognav::SonarPins& pins = settings.pins[i];
        pinMode(static_cast<uint8_t>(pins.trigger), OUTPUT);
        digitalWrite(static_cast<uint8_t>(pins.trigger), LOW);
        pinMode(static_cast<uint8_t>(pins.echo), INPUT);
        echo_lines[i] = {node, i, pins.echo};
        attachInterruptArg(digitalPinToInterrupt(pins.echo), on_echo, &echo_lines[i], CHANGE);
    }
}

}  // namespace

void setup() {
    Serial.begin(115200);
    if (!LittleFS.begin()) complain("the board has no file system: run `pio run --target uploadfs`");
    const String text = read_file(kSettingsFile, kSettingsMax);
    if (text.length() == 0) complain("node.json is missing, empty or longer than 2 KB: see firmware/README.md");
    const char* problem = fognav::read_settings(text.c_str(), text.length(), settings);
    if (problem != nullptr) complain(problem);
    if (!board.begin()) complain("ca.pem is missing, empty or longer than 4 KB: the certificate of the fog node's authority; or set tls to false");

    fognav::NodeSettings start;
    start.config.sonars = settings.sonars;
    for (int i = 0; i < settings.sonars; ++i) start.config.limits[i] = settings.limits[i];
    start.boot = random_bits();
    start.publish = settings.publish;
    start.firmware = FOGNAV_FIRMWARE;
    static fognav::Node the_node(start);
    static fognav::Connection the_connection(board, random_bits());
    node = &the_node;
    connection = &the_connection;
    board.serve(the_node);
    set_up_sonars();
}

// The board's own watchdog restarts it if a turn of this loop does not end.
void loop() {
    connection->step(millis());
    board.loop();
    const fognav::Node::Event event = node->step(micros());
    if (event == fognav::Node::Event::trigger) {
        trigger(node->sonar());
    } else if (event == fognav::Node::Event::publish) {
        board.publish_reading();
        node->set_rssi(static_cast<int16_t>(board.rssi()));
    }
}
