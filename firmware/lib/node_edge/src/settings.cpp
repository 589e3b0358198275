#include "settings.hpp"

#include <string.h>

#include "fognav_contract.h"
#include "json_reader.hpp"

namespace fognav {

static_assert(kIdSize == FOGNAV_ID_MAX + 1, "the contract allows ids of another length");

namespace {

constexpr int64_t kMilli = 1000;

bool valid_id(const char* id) {
    if (*id == 0 || *id == '-') return false;
    for (; *id != 0; ++id) {
        const bool allowed = (*id >= 'a' && *id <= 'z') || (*id >= '0' && *id <= '9') || *id == '-';
        if (!allowed) return false;
    }
    return true;
}

class SettingsReader {
public:
    SettingsReader(const char* text, size_t size) : json_(text, size) {}

    const char* read() {
        const char* key = nullptr;
        size_t length = 0;
        if (json_.begin_object()) {
            while (json_.next_member(key, length)) member(key, length);
        }
        if (problem_ != nullptr) return problem_;
        if (!json_.at_end()) return "node.json is not a JSON object, or a member has the wrong type or is too long";
        return missing();
    }

    const Settings& settings() const { return settings_; }

private:
    void refuse(const char* problem) {
        if (problem_ == nullptr) problem_ = problem;
    }

    bool is(const char* key, size_t length, const char* name) const {
        return strlen(name) == length && memcmp(key, name, length) == 0;
    }

    template <size_t size>
    void text(char (&target)[size]) {
        json_.text(target, size);
    }

    // A whole number from `least` to `most`; anything else is refused with `problem`.
    int64_t number(int64_t least, int64_t most, const char* problem) {
        int64_t milli = 0;
        if (!json_.number_milli(milli)) return least;
        if (milli % kMilli == 0 && milli / kMilli >= least && milli / kMilli <= most) return milli / kMilli;
        refuse(problem);
        return least;
    }

    void member(const char* key, size_t length) {
        if (is(key, length, "site")) {
            text(settings_.site);
        } else if (is(key, length, "node")) {
            text(settings_.node);
        } else if (is(key, length, "wifi_name")) {
            text(settings_.wifi_name);
        } else if (is(key, length, "wifi_password")) {
            text(settings_.wifi_password);
        } else if (is(key, length, "broker")) {
            text(settings_.broker);
        } else if (is(key, length, "port")) {
            settings_.port = static_cast<uint16_t>(number(1, 65535, "port is not a whole number from 1 to 65535"));
        } else if (is(key, length, "tls")) {
            json_.boolean(settings_.tls);
        } else if (is(key, length, "user")) {
            text(settings_.user);
        } else if (is(key, length, "password")) {
            text(settings_.password);
        } else if (is(key, length, "thesis_area")) {
            settings_.thesis_area = static_cast<uint32_t>(number(0, 999999, "thesis_area is not a whole number"));
        } else if (is(key, length, "home_assistant")) {
            json_.boolean(settings_.home_assistant);
        } else if (is(key, length, "every_reading")) {
            bool every = false;
            if (json_.boolean(every)) settings_.publish = every ? PublishMode::every_reading : PublishMode::on_change;
        } else if (is(key, length, "sonars")) {
            sonars();
        } else {
            // A misspelt setting must not be taken for one that is not there.
            refuse("node.json has a member that no setting is called; compare it with firmware/README.md");
            json_.skip_value();
        }
    }

    void sonars() {
        if (!json_.begin_array()) return;
        while (json_.next_element()) {
            if (settings_.sonars == kMaxSonars) {
                refuse("node.json has more than eight sonars");
                json_.skip_value();
                continue;
            }
            sonar(settings_.pins[settings_.sonars], settings_.limits[settings_.sonars]);
            ++settings_.sonars;
        }
    }

    void sonar(SonarPins& pins, SonarLimit& limit) {
        constexpr const char* kPin = "a pin of a sonar is not a GPIO number from 0 to 39";
        const char* key = nullptr;
        size_t length = 0;
        if (!json_.begin_object()) return;
        while (json_.next_member(key, length)) {
            if (is(key, length, "trigger")) {
                pins.trigger = static_cast<int8_t>(number(0, 39, kPin));
            } else if (is(key, length, "echo")) {
                pins.echo = static_cast<int8_t>(number(0, 39, kPin));
            } else if (is(key, length, "range_limit_m")) {
                int64_t mm = 0;
                if (!json_.number_milli(mm)) return;
                if (mm <= 0 || mm > 20000) refuse("range_limit_m of a sonar is not from 0.001 to 20 m");
                limit.limit_mm = static_cast<int32_t>(mm);
            } else if (is(key, length, "no_echo_is_clear")) {
                json_.boolean(limit.no_echo_is_clear);
            } else {
                refuse("a sonar in node.json has a member that no setting is called; compare it with firmware/README.md");
                json_.skip_value();
            }
        }
    }

    const char* missing() const {
        if (!valid_id(settings_.site)) return "site is missing, or not made of a to z, 0 to 9 and -";
        if (!valid_id(settings_.node)) return "node is missing, or not made of a to z, 0 to 9 and -";
        if (settings_.wifi_name[0] == 0) return "wifi_name is missing";
        if (settings_.broker[0] == 0) return "broker is missing: the name or address of the fog node";
        if (settings_.sonars == 0) return "sonars is missing: the pins of at least one";
        for (int i = 0; i < settings_.sonars; ++i) {
            const SonarPins& pins = settings_.pins[i];
            if (pins.trigger == kNoPin || pins.echo == kNoPin) return "a sonar has no trigger or no echo pin";
            if (settings_.limits[i].limit_mm == 0) return "a sonar has no range_limit_m";
            if (pins.trigger == pins.echo) return "a sonar has its trigger and its echo on the same pin";
            for (int j = 0; j < i; ++j) {
                // A trigger may be shared: then both would measure at once, which the cycle exists to prevent.
                if (settings_.pins[j].echo == pins.echo || settings_.pins[j].trigger == pins.trigger ||
                    settings_.pins[j].echo == pins.trigger || settings_.pins[j].trigger == pins.echo) {
                    return "two sonars share a pin";
                }
            }
        }
        return nullptr;
    }

    JsonReader json_;
    Settings settings_;
    const char* problem_ = nullptr;
};

}  // namespace

const char* read_settings(const char* text, size_t size, Settings& settings) {
    SettingsReader reader(text, size);
    const char* problem = reader.read();
    if (problem == nullptr) settings = reader.settings();
    return problem;
}

}  // namespace fognav
