// A sensor node without its board: measurement cycle, spike filter, classification, calibration and publishing. The edge
// (src/ for a board, host/ for a computer) calls `step` in its loop, triggers the sonar that it names, passes the echo
// lines' edges to `on_edge`, and publishes the message when there is one. "Sonar" is also said of the other sensors of
// range that are given instead.
#pragma once

#include "config_reader.hpp"
#include "cycle.hpp"
#include "publishing.hpp"
#include "sonar.hpp"
#include "spike_filter.hpp"

namespace fognav {

// A reading of eight sonars with the longest name of a firmware has 380 characters, a calibration 520.
constexpr size_t kMessageSize = 576;

// After so long without a step what was measured before is not fresh: a board waits for seconds while it connects.
constexpr uint32_t kGapUs = 250000;

struct NodeSettings {
    NodeConfig config;
    uint32_t boot = 0;  // random, new at each boot; 0 also switches the jitter of the pause off
    PublishMode publish = PublishMode::on_change;
    RangeSensor* sensors[kMaxSonars] = {};  // nullptr: an HC-SR04; others must live as long as the node
    const char* firmware = "";
};

class Node {
public:
    enum class Event : uint8_t {
        none,
        trigger,    // raise the trigger of sonar `sonar()` for kTriggerUs, at once; for another sensor: nothing
        publish,    // publish `message()`, a reading
        calibrated,  // publish `message()`: a calibration has ended; nothing of it counts yet
        kept,       // store `message()` and publish it: what was learned counts from now on
        replaced    // a configuration has replaced the limits that are stored: store `message()`, or nothing if it is empty
    };

    explicit Node(const NodeSettings& settings);
    Node(const Node&) = delete;
    Node& operator=(const Node&) = delete;

    // Take the next step at this time: micros(), 32 bits that wrap; call it at least once in 30 minutes.
    Event step(uint32_t now_us);

    // For the interrupt of a sonar's echo line.
    __attribute__((always_inline)) void on_edge(int sonar, bool high, uint32_t now_us) { sonars_[sonar].on_edge(high, now_us); }

    int sonar() const { return cycle_.current(); }

    // Written by the step that returned `publish` or a later event, valid until the next step.
    const char* message() const { return message_; }
    size_t message_length() const { return length_; }

    // What the last cycle measured; the state is that of all sonars.
    const Reading& reading() const { return reading_; }

    // Apply a configuration (JSON); return nullptr, or what is wrong with it. After a calibration, the configuration that
    // was there before changes the pause only: the broker delivers it again with each connection.
    const char* configure(const char* text, size_t size);
    const NodeConfig& config() const { return config_; }

    // Tenths of a degree Celsius. Without a sensor of the temperature the node assumes 20 degrees, and is 0.2 % wrong per
    // degree.
    void set_temperature(int16_t temperature_dc) { temperature_dc_ = temperature_dc; }

    // What a sensor measured. A room has -20 to 50 degrees, and air does not warm by more than half a degree between two
    // readings: other values (a DS18B20 says 85 after it was without power) must not stretch the ranges.
    void measure_temperature(int32_t temperature_dc);
    void set_rssi(int16_t rssi) { reading_.rssi = rssi; }

    // The connection has come back: readings go out as after a change.
    void on_connected() { publish_.restart(); }

    // Begin what a command asks for: learn the limits anew, or the pulses for "no echo". Return nullptr, or why not. While
    // it is under way the node's state is unknown: its sonars' way is to be kept free. Then `calibrated` comes. What was
    // learned counts once a further command says so, and then of all sonars: whoever compares it with the map may find
    // that somebody stood there, and a sonar that failed leaves all of them their limits.
    const char* command(const char* text, size_t size);
    bool calibrating() const { return calibrating_; }
    CalibrationResult calibration(int sonar) const { return calibrations_[sonar].result(); }

    // Apply a calibration that was stored, before the first step. Return nullptr, or what is wrong with it.
    const char* restore(const char* text, size_t size);

private:
    void take(const Sample& sample);
    void forget();
    Event finish();
    bool doubtful() const;
    void calibrate(CalibrationGoal goal);
    bool calibration_ended() const;
    void write_learned();
    Event report_calibration();
    Event keep_calibration();
    Event report_replaced();
    void apply_limits();

    NodeConfig config_;
    MeasurementCycle cycle_;
    PublishPolicy publish_;
    Sonar sonars_[kMaxSonars];
    RangeSensor* sensors_[kMaxSonars] = {};
    SpikeFilter filters_[kMaxSonars];
    State states_[kMaxSonars] = {};
    Calibration calibrations_[kMaxSonars];
    bool calibrating_ = false;
    bool learned_ = false;     // of all sonars, since the configuration with the version that is in `config_`
    bool keep_ = false;        // what was learned is to count
    bool calibrated_ = false;  // what was learned since that configuration counts
    bool replaced_ = false;    // what is stored counts no more
    int16_t temperature_dc_ = 200;
    bool started_ = false;
    uint32_t seen_us_ = 0;
    uint64_t uptime_us_ = 0;
    Reading reading_;
    char message_[kMessageSize];
    size_t length_ = 0;
};

}  // namespace fognav
