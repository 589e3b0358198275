#include "messages.hpp"

#include "fognav_contract.h"
#include "json_writer.hpp"

namespace fognav {

static_assert(kMaxSonars == FOGNAV_NODE_READING_RANGE_M_ITEMS_MAX, "the contract allows another number of sonars");
static_assert(FOGNAV_NODE_READING_RANGE_M_MAX >= 20.0, "a range may exceed what the contract allows");

namespace {

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

const char* name(CalibrationResult result) {
    switch (result) {
        case CalibrationResult::done:
            return FOGNAV_NODE_CALIBRATION_RESULT_DONE;
        case CalibrationResult::unsteady:
            return FOGNAV_NODE_CALIBRATION_RESULT_UNSTEADY;
        case CalibrationResult::too_near:
            return FOGNAV_NODE_CALIBRATION_RESULT_TOO_NEAR;
        case CalibrationResult::stuck:
        case CalibrationResult::running:
            break;
    }
    return FOGNAV_NODE_CALIBRATION_RESULT_STUCK;
}

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
            json.thousandths(reading.samples[i].range_mm);
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

size_t write_calibration(const CalibrationReport& report, char* buffer, size_t size) {
    const NodeConfig& config = report.config;
    JsonWriter json(buffer, size);
    json.begin_object();
    json.key(FOGNAV_NODE_CALIBRATION_BOOT_FIELD);
    json.value(static_cast<uint64_t>(report.boot));
    json.key(FOGNAV_NODE_CALIBRATION_CONFIG_VERSION_FIELD);
    json.value(config.version);
    json.key(FOGNAV_NODE_CALIBRATION_RESULT_FIELD);
    json.begin_array();
    for (int i = 0; i < config.sonars; ++i) json.value(name(report.results[i]));
    json.end_array();
    json.key(FOGNAV_NODE_CALIBRATION_RANGE_LIMIT_M_FIELD);
    json.begin_array();
    for (int i = 0; i < config.sonars; ++i) json.thousandths(config.limits[i].limit_mm);
    json.end_array();
    json.key(FOGNAV_NODE_CALIBRATION_RANGE_MAX_M_FIELD);
    json.begin_array();
    for (int i = 0; i < config.sonars; ++i) json.thousandths(config.limits[i].max_mm);
    json.end_array();
    json.key(FOGNAV_NODE_CALIBRATION_NO_ECHO_IS_CLEAR_FIELD);
    json.begin_array();
    for (int i = 0; i < config.sonars; ++i) json.value(config.limits[i].no_echo_is_clear);
    json.end_array();
    json.key(FOGNAV_NODE_CALIBRATION_NO_ECHO_US_FIELD);
    json.begin_array();
    for (int i = 0; i < config.sonars; ++i) json.value(static_cast<uint64_t>(config.limits[i].no_echo_us));
    json.end_array();
    json.key(FOGNAV_NODE_CALIBRATION_SAMPLES_FIELD);
    json.begin_array();
    for (int i = 0; i < config.sonars; ++i) json.value(static_cast<uint64_t>(report.free[i].samples));
    json.end_array();
    json.key(FOGNAV_NODE_CALIBRATION_FALSE_ECHOES_FIELD);
    json.begin_array();
    for (int i = 0; i < config.sonars; ++i) json.value(static_cast<uint64_t>(report.free[i].false_echoes));
    json.end_array();
    json.key(FOGNAV_NODE_CALIBRATION_NO_ECHOES_FIELD);
    json.begin_array();
    for (int i = 0; i < config.sonars; ++i) json.value(static_cast<uint64_t>(report.free[i].no_echoes));
    json.end_array();
    json.end_object();
    return json.finish();
}

}  // namespace fognav
