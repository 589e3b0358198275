// What a node is told when it is set up: who it is, its network and broker, its pins. A file `node.json` on the board.
#pragma once

#include <stddef.h>

#include "messages.hpp"
#include "publishing.hpp"

namespace fognav {

constexpr size_t kIdSize = 33;  // FOGNAV_ID_MAX and the terminating zero; settings.cpp asserts it
constexpr size_t kNameSize = 65;
constexpr size_t kPasswordSize = 97;
constexpr int kNoPin = -1;

struct SonarPins {
    int8_t trigger = kNoPin;
    int8_t echo = kNoPin;
};

struct Settings {
    char site[kIdSize] = "";
    char node[kIdSize] = "";
    char wifi_name[kNameSize] = "";
    char wifi_password[kPasswordSize] = "";
    char broker[kNameSize] = "";  // a name or an address
    uint16_t port = 8883;
    bool tls = true;  // with the certificate authority in the file ca.pem, and no other
    char user[kNameSize] = "";
    char password[kPasswordSize] = "";
    uint32_t thesis_area = 0;  // also publish `area <n>` for the thesis's receivers; 0: no
    bool home_assistant = false;
    PublishMode publish = PublishMode::on_change;
    int sonars = 0;
    SonarPins pins[kMaxSonars] = {};
    SonarLimit limits[kMaxSonars] = {};
};

// Read settings from JSON. Return nullptr, or what is wrong with them and what to do; `settings` is then unchanged.
const char* read_settings(const char* text, size_t size, Settings& settings);

}  // namespace fognav
