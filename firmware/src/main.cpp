// The node on its board: Wemos D1 mini (ESP8266) or D1 mini 32 (ESP32). What it decides is in lib/node_core, how it stays
// connected, is set up and is updated in lib/node_edge; the files here connect both to pins, radio, flash and libraries.
#include <LittleFS.h>

#include "board.hpp"
#include "connection.hpp"
#include "files.hpp"
#include "in_flash.hpp"
#include "link.hpp"
#include "portal_server.hpp"
#include "scratch.hpp"
#include "sensors.hpp"
#include "update_board.hpp"

#if defined(ESP32)
#include <esp_task_wdt.h>
#endif

char fognav::scratch[2560];

namespace {

using namespace fognav;

constexpr uint32_t kComplainEveryMs = 5000;
#if defined(ESP32)
constexpr uint32_t kWatchdogS = 60;
#endif

// All of a node that has settings.
class Device final : Receiver {
public:
    explicit Device(const Settings& settings)
        : settings_(settings),
          link_(settings, *this),
          connection_(link_, random_bits()),
          node_(start(settings)),
          values_(node_.reading().boot),
          flash_(settings),
          updater_(flash_, kBoard.name, FOGNAV_FIRMWARE_NUMBER, remembered_update()) {}

    void begin(const char* authority) {
        link_.begin(authority);
        const String calibration = read_file(kCalibrationFile, FOGNAV_NODE_CALIBRATION_LIMIT);
        if (calibration.length() > 0) {
            link_.report(node_.restore(calibration.c_str(), calibration.length()));
            link_.set_calibration(calibration);
        }
        node_.set_temperature(static_cast<int16_t>(settings_.temperature_dc));
        begin_values(settings_, values_);
        begin_sonars(settings_, node_);
    }

    void loop() {
        const bool was_up = connection_.up();
        connection_.step(millis());
        if (connection_.up() && !was_up) {
            node_.on_connected();
            keep_image();
        }
        link_.loop();
        measure();
        if (values_.step(millis())) take_value();
        const char* problem = updater_.step(millis());
        if (problem != nullptr) link_.report(problem);
    }

private:
    static NodeSettings start(const Settings& settings) {
        NodeSettings start;
        start.config.sonars = settings.sonars;
        for (int i = 0; i < settings.sonars; ++i) start.config.limits[i] = settings.limits[i];
        start.boot = random_bits();
        start.publish = settings.publish;
        start.firmware = FOGNAV_FIRMWARE;
        begin_rangers(settings, start.sensors);
        return start;
    }

    const char* receive(Topic topic, const char* text, size_t size) override {
        if (topic == Topic::config) return node_.configure(text, size);
        if (topic == Topic::command) return node_.command(text, size);
        return updater_.offer(text, size, millis());
    }

    void measure() {
        switch (node_.step(micros())) {
            case Node::Event::none:
                break;
            case Node::Event::trigger:
                trigger(settings_, node_.sonar());
                break;
            case Node::Event::publish:
                link_.publish_reading(node_);
                node_.set_rssi(static_cast<int16_t>(link_.rssi()));
                break;
            case Node::Event::calibrated:
                link_.set_calibration(node_.message());
                for (int i = 0; i < settings_.sonars; ++i) Serial.printf("sonar %d: %s\n", i, describe(node_.calibration(i)));
                break;
            case Node::Event::kept:
                store_calibration();
                link_.set_calibration(node_.message());
                break;
            case Node::Event::replaced:
                store_calibration();
                link_.set_calibration("");
        }
    }

    void store_calibration() {
        if (node_.message_length() == 0) {
            remove_file(kCalibrationFile);
        } else if (!write_file(kCalibrationFile, node_.message())) {
            link_.report(IN_FLASH("the calibration can't be stored, and ends with the next restart: the flash is full"));
        }
    }

    void take_value() {
        link_.publish_value(values_.message());
        // A voltage may have the name, too.
        const Value& value = values_.value();
        if (strcmp(value.kind, "temperature") != 0 || strcmp(value.unit, "C") != 0) return;
        node_.measure_temperature(value.thousandths / 100);
    }

    const Settings& settings_;
    BoardLink link_;
    Connection connection_;
    Node node_;
    Values values_;
    FlashBoard flash_;
    Updater updater_;
};

Settings settings;
String authority;
Device* device = nullptr;
PortalSwitch* portal = nullptr;
PortalServer* server = nullptr;

// Without a file system there is nothing else to do.
[[noreturn]] void complain(const char* problem) {
    for (;;) {
        Serial.printf("%s\n", problem);
        delay(kComplainEveryMs);
    }
}

// Open the file system; on a fresh board, make one.
bool mount() {
#if defined(ESP8266)
    return LittleFS.begin();  // makes one by itself
#else
    return LittleFS.begin(true);
#endif
}

// nullptr, or why the node can't begin with what is on its flash.
const char* read_flash() {
    const String text = read_file(kSettingsFile, kSettingsMax);
    if (text.length() == 0) return IN_FLASH("node.json is missing, empty or longer than 2 KB");
    const char* problem = read_settings(text.c_str(), text.length(), kBoard, settings);
    if (problem != nullptr) return problem;
    authority = read_file(kAuthorityFile, kAuthorityMax);
    return authority_problem(authority.c_str(), settings);
}

void open_portal() {
    static PortalServer the_server(*portal, settings);
    server = &the_server;
    the_server.begin();
}

bool button_pressed() { return settings.button != kNoPin && digitalRead(settings.button) == LOW; }

}  // namespace

void setup() {
    Serial.begin(115200);
    if (!mount()) complain(IN_FLASH("the board has no file system, and none can be made: is its flash damaged?"));
    const char* problem = read_flash();
    static PortalSwitch the_portal(problem == nullptr);
    portal = &the_portal;
    if (problem != nullptr) {
        Serial.printf("%s\n", problem);
        open_portal();
        return;
    }
    if (settings.button != kNoPin) pinMode(static_cast<uint8_t>(settings.button), INPUT_PULLUP);
    static Device the_device(settings);
    device = &the_device;
    device->begin(authority.c_str());
#if defined(ESP8266)
    authority = String();  // its list of trusted authorities is a copy
#else
    // An ESP8266's watches the loop by itself, and is fed while it connects. This one is not, for half a minute at worst.
    esp_task_wdt_init(kWatchdogS, true);
    enableLoopWDT();
#endif
}

void loop() {
    portal->step(button_pressed(), millis());
    if (server != nullptr) {
        server->loop();
        if (!portal->open()) ESP.restart();
    } else if (portal->open()) {
        open_portal();
    } else {
        device->loop();
    }
}
