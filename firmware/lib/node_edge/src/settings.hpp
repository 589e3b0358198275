// What a node is told when it is set up: who it is, its network and broker, its sensors. A file `node.json` on the board.
#pragma once

#include <stddef.h>

#include "board_pins.hpp"
#include "messages.hpp"
#include "publishing.hpp"
#include "values.hpp"

namespace fognav {

constexpr size_t kIdSize = 33;  // FOGNAV_ID_MAX and the terminating zero; settings.cpp asserts it
constexpr size_t kNameSize = 65;
constexpr size_t kPasswordSize = 97;
constexpr size_t kUpdateKeySize = 65;  // a point of P-256, uncompressed

enum class RangeSensorKind : uint8_t { hc_sr04, vl53l0x, vl53l1x };

// A sensor of range: a sonar has two pins, a ranger on I2C at most the one that switches it off (XSHUT), which it needs
// where there are several: each gets an address of its own while the later ones are off.
struct RangeSensorSettings {
    RangeSensorKind kind = RangeSensorKind::hc_sr04;
    SonarPins pins;
    int8_t shutdown = kNoPin;
};

enum class ValueSensorKind : uint8_t { ds18b20, analog };

// A sensor of a value: a DS18B20 at a pin, in degrees Celsius, or a voltage at the analog pin, in volts.
struct ValueSettings {
    ValueSensorKind kind = ValueSensorKind::analog;
    char name[kIdSize] = "";  // the value's kind in messages: "temperature", "gas"
    int8_t pin = kNoPin;
    int32_t full_scale_mv = 3300;
};

struct Settings {
    char site[kIdSize] = "";
    char node[kIdSize] = "";
    char wifi_name[kNameSize] = "";
    char wifi_password[kPasswordSize] = "";
    char broker[kNameSize] = "";  // a name or an address
    char second_broker[kNameSize] = "";  // of a floor with two: they are tried in turn
    uint16_t port = 8883;
    bool tls = true;  // with the certificate authority in the file ca.pem, and no other
    char user[kNameSize] = "";
    char password[kPasswordSize] = "";
    uint32_t thesis_area = 0;  // also publish `area <n>` for the thesis's receivers; 0: no
    bool home_assistant = false;
    PublishMode publish = PublishMode::on_change;
    int32_t temperature_dc = 200;  // of the air, where no sensor measures it: tenths of a degree Celsius
    bool thesis_pins = false;      // the profile for sonars without pins of their own
    int8_t button = kNoPin;        // held low for 3 s, it opens the set-up portal
    bool updates = false;          // whether `update_key` is set
    uint8_t update_key[kUpdateKeySize] = {};
    int sonars = 0;
    RangeSensorSettings sensors[kMaxSonars] = {};
    SonarLimit limits[kMaxSonars] = {};
    int values = 0;
    ValueSettings value_sensors[kMaxValues] = {};
};

// Read settings from JSON, for a board. Return nullptr, or what is wrong with them and what to do; `settings` then holds
// what was read so far. (A second copy of them would take a third of an ESP8266's stack.)
const char* read_settings(const char* text, size_t size, const BoardPins& board, Settings& settings);

// A number that differs where a calibration of before says nothing: for another node, other sensors or other limits.
uint32_t calibrated_mark(const Settings& settings);

}  // namespace fognav
