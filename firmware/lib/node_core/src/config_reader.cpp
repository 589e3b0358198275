#include "config_reader.hpp"

#include <string.h>

#include "fognav_contract.h"
#include "in_flash.hpp"
#include "json_reader.hpp"

namespace fognav {

namespace {

constexpr int64_t kMilli = 1000;
constexpr int kMissing = -1;

bool is(const char* key, size_t length, const char* field) {
    return strlen(field) == length && memcmp(key, field, length) == 0;
}

class ConfigReader {
public:
    // What the text does not set stays as it is in `config`, but for the farthest echoes.
    ConfigReader(const NodeConfig& config, int sonars, const char* version_field)
        : config_(config), version_field_(version_field) {
        config_.sonars = sonars;
        for (SonarLimit& limit : config_.limits) limit.max_mm = 0;  // never the one of other limits
    }

    const char* read(const char* text, size_t size) {
        JsonReader json(text, size);
        const char* key = nullptr;
        size_t length = 0;
        if (json.begin_object()) {
            while (json.next_member(key, length)) member(json, key, length);
        }
        if (!json.at_end()) return IN_FLASH("it is not a JSON object, or a member has the wrong type");
        return problem_ != nullptr ? problem_ : missing();
    }

    const NodeConfig& config() const { return config_; }

private:
    void member(JsonReader& json, const char* key, size_t length) {
        if (is(key, length, version_field_)) {
            version(json);
        } else if (is(key, length, FOGNAV_NODE_CONFIG_RANGE_LIMIT_M_FIELD)) {
            limits(json);
        } else if (is(key, length, FOGNAV_NODE_CONFIG_RANGE_MAX_M_FIELD)) {
            farthest(json);
        } else if (is(key, length, FOGNAV_NODE_CONFIG_NO_ECHO_IS_CLEAR_FIELD)) {
            silences(json);
        } else if (is(key, length, FOGNAV_NODE_CALIBRATION_NO_ECHO_US_FIELD)) {
            pulses(json);
        } else if (is(key, length, FOGNAV_NODE_CONFIG_PAUSE_MS_FIELD)) {
            pause(json);
        } else {
            json.skip_value();
        }
    }

    const char* missing() const {
        if (!has_version_) return "version is missing";
        if (limits_ == kMissing) return IN_FLASH("range_limit_m is missing");
        if (silences_ == kMissing) return IN_FLASH("no_echo_is_clear is missing");
        if (limits_ != config_.sonars) return IN_FLASH("range_limit_m is for another number of sonars");
        if (silences_ != config_.sonars) return IN_FLASH("no_echo_is_clear is for another number of sonars");
        if (farthest_ > 0 && farthest_ != config_.sonars) return IN_FLASH("range_max_m is for another number of sonars");
        if (pulses_ != kMissing && pulses_ != config_.sonars) return IN_FLASH("no_echo_us is for another number of sonars");
        return nullptr;
    }

    void refuse(const char* problem) {
        if (problem_ == nullptr) problem_ = problem;
    }

    void version(JsonReader& json) {
        int64_t milli = 0;
        if (!json.number_milli(milli)) return;
        has_version_ = true;
        config_.version = static_cast<uint64_t>(milli / kMilli);
        if (milli < 0 || milli % kMilli != 0) refuse(IN_FLASH("version is not a whole number from 0 on"));
    }

    void pause(JsonReader& json) {
        int64_t milli = 0;
        if (!json.number_milli(milli)) return;
        const bool whole = milli % kMilli == 0;
        const int64_t pause_ms = milli / kMilli;
        if (!whole || pause_ms < FOGNAV_NODE_CONFIG_PAUSE_MS_MIN || pause_ms > FOGNAV_NODE_CONFIG_PAUSE_MS_MAX) {
            refuse(IN_FLASH("pause_ms is not a whole number from 10 to 60000"));
            return;
        }
        config_.pause_ms = static_cast<uint16_t>(pause_ms);
    }

    void limits(JsonReader& json) {
        constexpr int64_t max_mm = static_cast<int64_t>(FOGNAV_NODE_CONFIG_RANGE_LIMIT_M_MAX * 1000);
        if (!json.begin_array()) return;
        limits_ = 0;
        while (json.next_element()) {
            int64_t mm = 0;
            if (!json.number_milli(mm)) return;
            if (mm <= 0 || mm > max_mm) refuse(IN_FLASH("range_limit_m has a limit that is not from 0.001 to 20 m"));
            if (limits_ < kMaxSonars) config_.limits[limits_].limit_mm = static_cast<int32_t>(mm);
            ++limits_;
        }
    }

    void farthest(JsonReader& json) {
        constexpr int64_t max_mm = static_cast<int64_t>(FOGNAV_NODE_CONFIG_RANGE_MAX_M_MAX * 1000);
        if (!json.begin_array()) return;
        farthest_ = 0;
        while (json.next_element()) {
            int64_t mm = 0;
            if (!json.number_milli(mm)) return;
            if (mm < 0 || mm > max_mm) refuse(IN_FLASH("range_max_m has a range that is not from 0 to 20 m"));
            if (farthest_ < kMaxSonars) config_.limits[farthest_].max_mm = static_cast<int32_t>(mm);
            ++farthest_;
        }
    }

    void silences(JsonReader& json) {
        if (!json.begin_array()) return;
        silences_ = 0;
        while (json.next_element()) {
            bool clear = false;
            if (!json.boolean(clear)) return;
            if (silences_ < kMaxSonars) config_.limits[silences_].no_echo_is_clear = clear;
            ++silences_;
        }
    }

    void pulses(JsonReader& json) {
        if (!json.begin_array()) return;
        pulses_ = 0;
        while (json.next_element()) {
            int64_t milli = 0;
            if (!json.number_milli(milli)) return;
            const int64_t us = milli / kMilli;
            if (milli < 0 || us > FOGNAV_NODE_CALIBRATION_NO_ECHO_US_MAX) refuse(IN_FLASH("no_echo_us has a pulse beyond 80000"));
            if (pulses_ < kMaxSonars) config_.limits[pulses_].no_echo_us = static_cast<uint32_t>(us);
            ++pulses_;
        }
    }

    NodeConfig config_;
    const char* version_field_;
    const char* problem_ = nullptr;
    bool has_version_ = false;
    int limits_ = kMissing;  // how many there were
    int farthest_ = kMissing;
    int silences_ = kMissing;
    int pulses_ = kMissing;
};

const char* read(const char* text, size_t size, int sonars, const char* version_field, NodeConfig& config) {
    ConfigReader reader(config, sonars, version_field);
    const char* problem = reader.read(text, size);
    if (problem == nullptr) config = reader.config();
    return problem;
}

}  // namespace

const char* read_config(const char* text, size_t size, int sonars, NodeConfig& config) {
    NodeConfig found = config;
    found.pause_ms = FOGNAV_NODE_CONFIG_PAUSE_MS_DEFAULT;
    const char* problem = read(text, size, sonars, FOGNAV_NODE_CONFIG_VERSION_FIELD, found);
    if (problem == nullptr) config = found;
    return problem;
}

const char* read_calibration(const char* text, size_t size, int sonars, NodeConfig& config) {
    return read(text, size, sonars, FOGNAV_NODE_CALIBRATION_CONFIG_VERSION_FIELD, config);
}

}  // namespace fognav
