#include "settings.hpp"

#include <string.h>

#include "fognav_contract.h"
#include "hexadecimal.hpp"
#include "in_flash.hpp"
#include "json_reader.hpp"
#include "settings_check.hpp"

namespace fognav {

static_assert(kIdSize == FOGNAV_ID_MAX + 1, "the contract allows ids of another length");

namespace {

constexpr int64_t kMilli = 1000;
constexpr int kPinMax = 39;

class SettingsReader {
public:
    SettingsReader(const char* text, size_t size, Settings& settings) : json_(text, size), settings_(settings) {}

    const char* read(const BoardPins& board) {
        const char* key = nullptr;
        size_t length = 0;
        if (json_.begin_object()) {
            while (json_.next_member(key, length)) member(key, length);
        }
        if (problem_ != nullptr) return problem_;
        if (!json_.at_end()) return IN_FLASH("node.json is not a JSON object, or a member has the wrong type or is too long");
        use_profile(board, settings_);
        return settings_problem(board, settings_);
    }

private:
    using Member = void (SettingsReader::*)();
    struct Entry {
        const char* name;
        Member read;
    };

    void refuse(const char* problem) {
        if (problem_ == nullptr) problem_ = problem;
    }

    static bool is(const char* key, size_t length, const char* name) {
        return strlen(name) == length && memcmp(key, name, length) == 0;
    }

    // Read a member by the first entry with its name. A misspelt setting must not be taken for one that is not there.
    template <size_t count>
    void dispatch(const Entry (&entries)[count], const char* key, size_t length, const char* unknown) {
        for (const Entry& entry : entries) {
            if (is(key, length, entry.name)) {
                (this->*entry.read)();
                return;
            }
        }
        refuse(unknown);
        json_.skip_value();
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

    int8_t pin() { return static_cast<int8_t>(number(0, kPinMax, IN_FLASH("a pin is not a GPIO number from 0 to 39"))); }

    // The index of a word in a list of them; another word is refused with `problem`.
    template <size_t count>
    int word(const char* const (&words)[count], const char* problem) {
        char found[16] = "";
        if (!json_.text(found, sizeof found)) return 0;
        for (size_t i = 0; i < count; ++i) {
            if (strcmp(found, words[i]) == 0) return static_cast<int>(i);
        }
        refuse(problem);
        return 0;
    }

    void member(const char* key, size_t length) {
        using Reader = SettingsReader;
        static constexpr Entry kEntries[] = {
            {"site", &Reader::site}, {"node", &Reader::node},
            {"wifi_name", &Reader::wifi_name}, {"wifi_password", &Reader::wifi_password},
            {"broker", &Reader::broker}, {"second_broker", &Reader::second_broker}, {"port", &Reader::port}, {"tls", &Reader::tls},
            {"user", &Reader::user}, {"password", &Reader::password},
            {"thesis_area", &Reader::thesis_area}, {"home_assistant", &Reader::home_assistant},
            {"every_reading", &Reader::every_reading}, {"temperature_c", &Reader::temperature},
            {"profile", &Reader::profile}, {"button", &Reader::button}, {"update_key", &Reader::update_key},
            {"sonars", &Reader::sonars}, {"values", &Reader::values},
        };
        dispatch(kEntries, key, length, IN_FLASH("node.json has a member that no setting is called; compare it with firmware/README.md"));
    }

    void site() { text(settings_.site); }
    void node() { text(settings_.node); }
    void wifi_name() { text(settings_.wifi_name); }
    void wifi_password() { text(settings_.wifi_password); }
    void broker() { text(settings_.broker); }
    void second_broker() { text(settings_.second_broker); }
    void user() { text(settings_.user); }
    void password() { text(settings_.password); }
    void tls() { json_.boolean(settings_.tls); }
    void home_assistant() { json_.boolean(settings_.home_assistant); }
    void button() { settings_.button = pin(); }

    void port() {
        settings_.port = static_cast<uint16_t>(number(1, 65535, IN_FLASH("port is not a whole number from 1 to 65535")));
    }

    void thesis_area() {
        settings_.thesis_area = static_cast<uint32_t>(number(0, 9999, IN_FLASH("thesis_area is not a whole number up to 9999")));
    }

    void every_reading() {
        bool every = false;
        if (json_.boolean(every)) settings_.publish = every ? PublishMode::every_reading : PublishMode::on_change;
    }

    void temperature() {
        int64_t milli = 0;
        if (!json_.number_milli(milli)) return;
        if (milli < -40 * kMilli || milli > 60 * kMilli) refuse(IN_FLASH("temperature_c is not from -40 to 60 degrees"));
        settings_.temperature_dc = static_cast<int32_t>(milli / 100);
    }

    void profile() {
        static constexpr const char* kProfiles[] = {"standard", "thesis"};
        settings_.thesis_pins = word(kProfiles, IN_FLASH("profile is neither standard nor thesis")) == 1;
    }

    void update_key() {
        char found[2 * kUpdateKeySize + 1] = "";
        if (!json_.text(found, sizeof found)) return;
        settings_.updates = bytes(found, settings_.update_key, kUpdateKeySize) == static_cast<int>(kUpdateKeySize) &&
                            settings_.update_key[0] == 4;
        if (!settings_.updates) refuse(IN_FLASH("update_key is not a public key: 130 hexadecimal digits that begin with 04"));
    }

    void sonars() {
        if (!json_.begin_array()) return;
        while (json_.next_element()) {
            if (settings_.sonars == kMaxSonars) {
                refuse(IN_FLASH("node.json has more than eight sonars"));
                json_.skip_value();
                continue;
            }
            object(&SettingsReader::sonar_member);
            ++settings_.sonars;
        }
    }

    void values() {
        if (!json_.begin_array()) return;
        while (json_.next_element()) {
            if (settings_.values == kMaxValues) {
                refuse(IN_FLASH("node.json has more than four values"));
                json_.skip_value();
                continue;
            }
            object(&SettingsReader::value_member);
            ++settings_.values;
        }
    }

    void object(void (SettingsReader::*take)(const char* key, size_t length)) {
        const char* key = nullptr;
        size_t length = 0;
        if (!json_.begin_object()) return;
        while (json_.next_member(key, length)) (this->*take)(key, length);
    }

    void sonar_member(const char* key, size_t length) {
        using Reader = SettingsReader;
        static constexpr Entry kEntries[] = {
            {"sensor", &Reader::range_sensor}, {"trigger", &Reader::trigger}, {"echo", &Reader::echo},
            {"shutdown", &Reader::shutdown}, {"range_limit_m", &Reader::range_limit},
            {"range_max_m", &Reader::range_max}, {"no_echo_is_clear", &Reader::no_echo_is_clear},
        };
        dispatch(kEntries, key, length,
                 IN_FLASH("a sonar in node.json has a member that no setting is called; compare it with firmware/README.md"));
    }

    RangeSensorSettings& sensor() { return settings_.sensors[settings_.sonars]; }
    SonarLimit& limit() { return settings_.limits[settings_.sonars]; }

    void range_sensor() {
        static constexpr const char* kKinds[] = {"hc-sr04", "vl53l0x", "vl53l1x"};
        sensor().kind =
            static_cast<RangeSensorKind>(word(kKinds, IN_FLASH("a sonar's sensor is none of hc-sr04, vl53l0x and vl53l1x")));
    }
    void trigger() { sensor().pins.trigger = pin(); }
    void echo() { sensor().pins.echo = pin(); }
    void shutdown() { sensor().shutdown = pin(); }
    void no_echo_is_clear() { json_.boolean(limit().no_echo_is_clear); }

    void range_limit() {
        int64_t mm = 0;
        if (!json_.number_milli(mm)) return;
        if (mm <= 0 || mm > 20000) refuse(IN_FLASH("range_limit_m of a sonar is not from 0.001 to 20 m"));
        limit().limit_mm = static_cast<int32_t>(mm);
    }

    void range_max() {
        int64_t mm = 0;
        if (!json_.number_milli(mm)) return;
        if (mm < 0 || mm > 20000) refuse(IN_FLASH("range_max_m of a sonar is not from 0 to 20 m"));
        limit().max_mm = static_cast<int32_t>(mm);
    }

    void value_member(const char* key, size_t length) {
        using Reader = SettingsReader;
        static constexpr Entry kEntries[] = {
            {"kind", &Reader::value_kind}, {"sensor", &Reader::value_sensor}, {"pin", &Reader::value_pin},
            {"full_scale_v", &Reader::full_scale},
        };
        dispatch(kEntries, key, length,
                 IN_FLASH("a value in node.json has a member that no setting is called; compare it with firmware/README.md"));
    }

    ValueSettings& value() { return settings_.value_sensors[settings_.values]; }

    void value_kind() { text(value().name); }
    void value_pin() { value().pin = pin(); }

    void value_sensor() {
        static constexpr const char* kKinds[] = {"ds18b20", "analog"};
        value().kind = static_cast<ValueSensorKind>(word(kKinds, IN_FLASH("a value's sensor is neither ds18b20 nor analog")));
    }

    void full_scale() {
        int64_t milli = 0;
        if (!json_.number_milli(milli)) return;
        if (milli <= 0 || milli > 100 * kMilli) refuse(IN_FLASH("full_scale_v of a value is not above 0 and up to 100 V"));
        value().full_scale_mv = static_cast<int32_t>(milli);
    }

    JsonReader json_;
    Settings& settings_;
    const char* problem_ = nullptr;
};

}  // namespace

const char* read_settings(const char* text, size_t size, const BoardPins& board, Settings& settings) {
    // A temporary would be a second one on the stack.
    static constexpr Settings kFresh FLASH_SECTION = {};
    settings = kFresh;
    return SettingsReader(text, size, settings).read(board);
}

uint32_t calibrated_mark(const Settings& settings) {
    uint32_t mark = 2166136261;  // FNV-1a
    const auto add = [&mark](int32_t value) { mark = (mark ^ static_cast<uint32_t>(value)) * 16777619; };
    for (const char* text = settings.site; *text != 0; ++text) add(*text);
    add('/');
    for (const char* text = settings.node; *text != 0; ++text) add(*text);
    for (int i = 0; i < settings.sonars; ++i) {
        const RangeSensorSettings& sensor = settings.sensors[i];
        const SonarLimit& limit = settings.limits[i];
        add(static_cast<int32_t>(sensor.kind));
        add(sensor.pins.trigger);
        add(sensor.pins.echo);
        add(sensor.shutdown);
        add(limit.limit_mm);
        add(limit.max_mm);
        add(limit.no_echo_is_clear ? 1 : 0);
    }
    return mark;
}

}  // namespace fognav
