#include "messages.hpp"

#include <string.h>

#include "fognav_contract.h"
#include "json_reader.hpp"
#include "json_writer.hpp"

namespace fognav {

static_assert(kMaxSonars == FOGNAV_NODE_READING_RANGE_M_ITEMS_MAX, "the contract allows another number of sonars");
static_assert(FOGNAV_NODE_READING_RANGE_M_MAX >= 20.0, "a range may exceed what the contract allows");

namespace {

constexpr int64_t kMilli = 1000;

const char* name(Status status) {
    switch (status) {
        case Status::ok:
            return FOGNAV_NODE_READING_STATUS_OK;
        case Status::no_echo:
            return FOGNAV_NODE_READING_STATUS_NO_ECHO;
        case Status::stuck:
            break;
    }
    return FOGNAV_NODE_READING_STATUS_STUCK;
}

const char* name(State state) {
    switch (state) {
        case State::blocked:
            return FOGNAV_NODE_READING_STATE_BLOCKED;
        case State::clear:
            return FOGNAV_NODE_READING_STATE_CLEAR;
        case State::unknown:
            break;
    }
    return FOGNAV_NODE_READING_STATE_UNKNOWN;
}

bool is(const char* key, size_t length, const char* field) {
    return strlen(field) == length && memcmp(key, field, length) == 0;
}

// Reads one member of a configuration; true if it could be read, whatever its value.
class ConfigReader {
public:
    explicit ConfigReader(int sonars) { config_.sonars = sonars; }

    void member(JsonReader& json, const char* key, size_t length) {
        if (is(key, length, FOGNAV_NODE_CONFIG_VERSION_FIELD)) {
            version(json);
        } else if (is(key, length, FOGNAV_NODE_CONFIG_RANGE_LIMIT_M_FIELD)) {
            limits(json);
        } else if (is(key, length, FOGNAV_NODE_CONFIG_NO_ECHO_IS_CLEAR_FIELD)) {
            silences(json);
        } else if (is(key, length, FOGNAV_NODE_CONFIG_PAUSE_MS_FIELD)) {
            pause(json);
        } else {
            json.skip_value();
        }
    }

    const char* problem() const {
        if (problem_ != nullptr) return problem_;
        if (!has_version_) return "version is missing";
        if (limits_ < 0) return "range_limit_m is missing";
        if (silences_ < 0) return "no_echo_is_clear is missing";
        if (limits_ != config_.sonars) return "range_limit_m is for another number of sonars";
        if (silences_ != config_.sonars) return "no_echo_is_clear is for another number of sonars";
        return nullptr;
    }

    const NodeConfig& config() const { return config_; }

private:
    void refuse(const char* problem) {
        if (problem_ == nullptr) problem_ = problem;
    }

    void version(JsonReader& json) {
        int64_t milli = 0;
        if (!json.number_milli(milli)) return;
        has_version_ = true;
        config_.version = static_cast<uint64_t>(milli / kMilli);
        if (milli < 0 || milli % kMilli != 0) refuse("version is not a whole number from 0 on");
    }

    void pause(JsonReader& json) {
        int64_t milli = 0;
        if (!json.number_milli(milli)) return;
        const bool whole = milli % kMilli == 0;
        const int64_t pause_ms = milli / kMilli;
        if (!whole || pause_ms < FOGNAV_NODE_CONFIG_PAUSE_MS_MIN || pause_ms > FOGNAV_NODE_CONFIG_PAUSE_MS_MAX) {
            refuse("pause_ms is not a whole number from 10 to 60000");
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
            if (mm <= 0 || mm > max_mm) refuse("range_limit_m has a limit that is not from 0.001 to 20 m");
            if (limits_ < kMaxSonars) config_.limits[limits_].limit_mm = static_cast<int32_t>(mm);
            ++limits_;
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

    NodeConfig config_;
    const char* problem_ = nullptr;
    bool has_version_ = false;
    int limits_ = -1;  // how many there were, -1 without the member
    int silences_ = -1;
};

}  // namespace

size_t write_reading(const Reading& reading, char* buffer, size_t size) {
    JsonWriter json(buffer, size);
    json.begin_object();
    json.key(FOGNAV_NODE_READING_SEQ_FIELD);
    json.value(static_cast<uint64_t>(reading.seq));
    json.key(FOGNAV_NODE_READING_BOOT_FIELD);
    json.value(static_cast<uint64_t>(reading.boot));
    json.key(FOGNAV_NODE_READING_UPTIME_MS_FIELD);
    json.value(reading.uptime_ms);
    json.key(FOGNAV_NODE_READING_RANGE_M_FIELD);
    json.begin_array();
    for (int i = 0; i < reading.sonars; ++i) {
        if (reading.samples[i].status == Status::ok) {
            json.metres(reading.samples[i].range_mm);
        } else {
            json.null();
        }
    }
    json.end_array();
    json.key(FOGNAV_NODE_READING_STATUS_FIELD);
    json.begin_array();
    for (int i = 0; i < reading.sonars; ++i) json.value(name(reading.samples[i].status));
    json.end_array();
    json.key(FOGNAV_NODE_READING_STATE_FIELD);
    json.value(name(reading.state));
    if (reading.rssi != 0) {
        json.key(FOGNAV_NODE_READING_RSSI_FIELD);
        json.value(static_cast<int32_t>(reading.rssi));
    }
    json.key(FOGNAV_NODE_READING_FW_FIELD);
    json.value(reading.firmware);
    json.end_object();
    return json.finish();
}

const char* read_config(const char* text, size_t size, int sonars, NodeConfig& config) {
    JsonReader json(text, size);
    ConfigReader reader(sonars);
    const char* key = nullptr;
    size_t length = 0;
    if (json.begin_object()) {
        while (json.next_member(key, length)) reader.member(json, key, length);
    }
    if (!json.at_end()) return "it is not a JSON object, or a member has the wrong type";
    if (reader.problem() != nullptr) return reader.problem();
    config = reader.config();
    return nullptr;
}

}  // namespace fognav
