#include "settings_check.hpp"

#include "in_flash.hpp"

#include <string.h>

namespace fognav {

namespace {

bool is_local(const char* host) {
    const size_t length = strlen(host);
    return length > 6 && strcmp(host + length - 6, ".local") == 0;
}

bool valid_id(const char* id) {
    if (*id == 0 || *id == '-') return false;
    for (; *id != 0; ++id) {
        const bool allowed = (*id >= 'a' && *id <= 'z') || (*id >= '0' && *id <= '9') || *id == '-';
        if (!allowed) return false;
    }
    return true;
}

// The pins that are taken, each by one sensor.
class Pins {
public:
    explicit Pins(const BoardPins& board) : board_(board) {}

    const char* take_output(int pin) { return take(pin, board_.outputs, IN_FLASH("a pin can't be driven on this board: take one that firmware/README.md names")); }
    const char* take_interrupt(int pin) {
        return take(pin, board_.interrupts, IN_FLASH("an echo pin can't tell of edges on this board: take one that firmware/README.md names"));
    }

private:
    const char* take(int pin, uint64_t allowed, const char* problem) {
        if (!has(allowed, pin)) return problem;
        if (has(taken_, pin)) return IN_FLASH("two sensors share a pin");
        taken_ |= pins(pin);
        return nullptr;
    }

    const BoardPins& board_;
    uint64_t taken_ = 0;
};

const char* sonar_problem(const RangeSensorSettings& sensor, Pins& taken) {
    if (sensor.pins.trigger == kNoPin || sensor.pins.echo == kNoPin) return IN_FLASH("a sonar has no trigger or no echo pin");
    if (sensor.pins.trigger == sensor.pins.echo) return IN_FLASH("a sonar has its trigger and its echo on the same pin");
    const char* problem = taken.take_output(sensor.pins.trigger);
    return problem != nullptr ? problem : taken.take_interrupt(sensor.pins.echo);
}

const char* sensor_problem(const Settings& settings, int index, Pins& taken) {
    const RangeSensorSettings& sensor = settings.sensors[index];
    if (settings.limits[index].limit_mm == 0) return IN_FLASH("a sonar has no range_limit_m");
    if (sensor.kind == RangeSensorKind::hc_sr04) return sonar_problem(sensor, taken);
    return sensor.shutdown == kNoPin ? nullptr : taken.take_output(sensor.shutdown);
}

// All rangers answer at one address at first: only the last to be switched on may lack a pin that keeps it off.
bool rangers_can_be_told_apart(const Settings& settings) {
    int without = 0;
    for (int i = 0; i < settings.sonars; ++i) {
        const RangeSensorSettings& sensor = settings.sensors[i];
        if (sensor.kind != RangeSensorKind::hc_sr04 && sensor.shutdown == kNoPin) ++without;
    }
    return without <= 1;
}

const char* pins_problem(const BoardPins& board, const Settings& settings) {
    Pins taken(board);
    bool i2c = false;
    for (int i = 0; i < settings.sonars; ++i) {
        const char* problem = sensor_problem(settings, i, taken);
        if (problem != nullptr) return problem;
        i2c = i2c || settings.sensors[i].kind != RangeSensorKind::hc_sr04;
    }
    if (i2c && (taken.take_output(board.sda) != nullptr || taken.take_output(board.scl) != nullptr)) {
        return IN_FLASH("a sensor has a pin of the I2C bus, which the rangers need");
    }
    if (!rangers_can_be_told_apart(settings)) return IN_FLASH("several rangers need a shutdown pin each, all but one");
    for (int i = 0; i < settings.values; ++i) {
        const ValueSettings& value = settings.value_sensors[i];
        if (!valid_id(value.name)) return IN_FLASH("a value's kind is missing, or not made of a to z, 0 to 9 and -");
        if (value.kind != ValueSensorKind::ds18b20) continue;
        const char* problem = taken.take_output(value.pin);
        if (problem != nullptr) return problem;
    }
    return settings.button == kNoPin ? nullptr : taken.take_interrupt(settings.button);
}

}  // namespace

void use_profile(const BoardPins& board, Settings& settings) {
    const PinProfile& profile = settings.thesis_pins ? board.thesis : board.standard;
    for (int i = 0; i < settings.sonars && i < kProfileSonars; ++i) {
        RangeSensorSettings& sensor = settings.sensors[i];
        const bool none = sensor.pins.trigger == kNoPin && sensor.pins.echo == kNoPin;
        if (none && sensor.kind == RangeSensorKind::hc_sr04) sensor.pins = profile.sonars[i];
    }
}

const char* settings_problem(const BoardPins& board, const Settings& settings) {
    if (!valid_id(settings.site)) return IN_FLASH("site is missing, or not made of a to z, 0 to 9 and -");
    if (!valid_id(settings.node)) return IN_FLASH("node is missing, or not made of a to z, 0 to 9 and -");
    if (settings.wifi_name[0] == 0) return IN_FLASH("wifi_name is missing");
    if (settings.broker[0] == 0) return IN_FLASH("broker is missing: the name or address of the fog node");
    if (!board.finds_local && (is_local(settings.broker) || is_local(settings.second_broker))) {
        return IN_FLASH("broker is a name in .local, which this board can't look up: give the fog node's address");
    }
    if (settings.sonars == 0) return IN_FLASH("sonars is missing: at least one");
    return pins_problem(board, settings);
}

}  // namespace fognav
