#include "node.hpp"

#include <string.h>

#include "fognav_contract.h"
#include "in_flash.hpp"

namespace fognav {

namespace {

constexpr int32_t kColdestDc = -200;
constexpr int32_t kWarmestDc = 500;
constexpr int32_t kTemperatureStepDc = 5;

}  // namespace

static_assert(kMessageSize <= FOGNAV_NODE_READING_LIMIT, "a reading may be longer than its channel allows");

Node::Node(const NodeSettings& settings)
    : config_(settings.config), cycle_(settings.config.sonars, settings.boot), publish_(settings.publish) {
    for (int i = 0; i < kMaxSonars; ++i) {
        sensors_[i] = settings.sensors[i] != nullptr ? settings.sensors[i] : &sonars_[i];
    }
    apply_limits();
    reading_.boot = settings.boot;
    reading_.sonars = config_.sonars;
    reading_.firmware = settings.firmware;
    message_[0] = 0;
}

Node::Event Node::step(uint32_t now_us) {
    if (started_) {
        uptime_us_ += now_us - seen_us_;
        if (now_us - seen_us_ > kGapUs) forget();
    }
    started_ = true;
    seen_us_ = now_us;
    switch (cycle_.step(now_us)) {
        case MeasurementCycle::Action::trigger:
            sensors_[cycle_.current()]->start(now_us);
            return Event::trigger;
        case MeasurementCycle::Action::listen: {
            Sample sample;
            if (sensors_[cycle_.current()]->poll(now_us, temperature_dc_, sample)) take(sample);
            return Event::none;
        }
        case MeasurementCycle::Action::finished:
            return finish();
        case MeasurementCycle::Action::wait:
            break;
    }
    return Event::none;
}

void Node::forget() {
    cycle_.restart();
    for (SpikeFilter& filter : filters_) filter = SpikeFilter();
}

void Node::measure_temperature(int32_t temperature_dc) {
    if (temperature_dc < kColdestDc || temperature_dc > kWarmestDc) return;
    const int32_t step = temperature_dc - temperature_dc_;
    const int32_t most = kTemperatureStepDc;
    temperature_dc_ = static_cast<int16_t>(temperature_dc_ + (step > most ? most : step < -most ? -most : step));
}

void Node::take(const Sample& sample) {
    const int sonar = cycle_.current();
    const Sample counts = filters_[sonar].update(sample);
    if (calibrating_) calibrations_[sonar].update(sample, counts, sonars_[sonar].pulse_us());
    reading_.samples[sonar] = counts;
    states_[sonar] = classify(counts, config_.limits[sonar], states_[sonar]);
    // What may be a spike, or the first echo of an obstacle, is measured again at once.
    cycle_.measured(filters_[sonar].contradicted());
}

Node::Event Node::finish() {
    if (doubtful()) cycle_.hurry();
    if (calibrating_ && calibration_ended()) return report_calibration();
    if (keep_) return keep_calibration();
    if (replaced_) return report_replaced();
    reading_.uptime_ms = uptime_us_ / 1000;
    reading_.state = calibrating_ ? State::unknown : fuse(states_, reading_.samples, reading_.sonars);
    if (!publish_.update(reading_, states_)) return Event::none;
    length_ = write_reading(reading_, message_, sizeof message_);
    ++reading_.seq;
    return Event::publish;
}

bool Node::doubtful() const {
    for (int i = 0; i < config_.sonars; ++i) {
        if (filters_[i].contradicted()) return true;
    }
    return false;
}

const char* Node::configure(const char* text, size_t size) {
    NodeConfig found = config_;
    const char* problem = read_config(text, size, config_.sonars, found);
    if (problem != nullptr) return problem;
    if (calibrated_ && found.version == config_.version) {
        config_.pause_ms = found.pause_ms;
    } else {
        if (found.version != config_.version) learned_ = keep_ = false;
        replaced_ = replaced_ || calibrated_;
        config_ = found;
        calibrated_ = false;
    }
    apply_limits();
    publish_.restart();
    return nullptr;
}

const char* Node::command(const char* text, size_t size) {
    const auto is = [&](const char* command) { return strlen(command) == size && memcmp(text, command, size) == 0; };
    if (is(FOGNAV_NODE_COMMAND_CALIBRATE)) {
        calibrate(CalibrationGoal::free_distance);
    } else if (is(FOGNAV_NODE_COMMAND_LEARN_NO_ECHO)) {
        calibrate(CalibrationGoal::no_echo);
    } else if (is(FOGNAV_NODE_COMMAND_KEEP)) {
        if (!learned_) return IN_FLASH("there is no calibration to keep: calibrate, until every sonar has learned");
        keep_ = true;
    } else {
        return IN_FLASH("this firmware does not know the command: it knows " FOGNAV_NODE_COMMAND_CALIBRATE
               ", " FOGNAV_NODE_COMMAND_LEARN_NO_ECHO " and " FOGNAV_NODE_COMMAND_KEEP);
    }
    return nullptr;
}

const char* Node::restore(const char* text, size_t size) {
    const char* problem = read_calibration(text, size, config_.sonars, config_);
    if (problem != nullptr) return problem;
    calibrated_ = true;
    apply_limits();
    return nullptr;
}

void Node::apply_limits() {
    cycle_.set_pause(config_.pause_ms);
    for (int i = 0; i < config_.sonars; ++i) sonars_[i].set_no_echo(config_.limits[i].no_echo_us);
}

void Node::calibrate(CalibrationGoal goal) {
    apply_limits();
    learned_ = keep_ = false;
    for (int i = 0; i < config_.sonars; ++i) {
        calibrations_[i] = Calibration(goal);
        // What it says for "no echo" is what it says now.
        if (goal == CalibrationGoal::no_echo) sonars_[i].set_no_echo(0);
    }
    calibrating_ = true;
}

bool Node::calibration_ended() const {
    for (int i = 0; i < config_.sonars; ++i) {
        if (calibrations_[i].result() == CalibrationResult::running) return false;
    }
    return true;
}

void Node::write_learned() {
    CalibrationReport report;
    report.boot = reading_.boot;
    report.config = config_;
    for (int i = 0; i < config_.sonars; ++i) {
        report.results[i] = calibrations_[i].result();
        report.free[i] = calibrations_[i].free_samples();
        if (report.results[i] == CalibrationResult::done) calibrations_[i].apply(report.config.limits[i]);
    }
    length_ = write_calibration(report, message_, sizeof message_);
}

Node::Event Node::report_calibration() {
    calibrating_ = false;
    learned_ = true;
    for (int i = 0; i < config_.sonars; ++i) learned_ = learned_ && calibrations_[i].result() == CalibrationResult::done;
    apply_limits();
    publish_.restart();
    write_learned();
    return Event::calibrated;
}

Node::Event Node::keep_calibration() {
    keep_ = replaced_ = false;
    calibrated_ = true;
    for (int i = 0; i < config_.sonars; ++i) calibrations_[i].apply(config_.limits[i]);
    apply_limits();
    publish_.restart();
    write_learned();
    return Event::kept;
}

Node::Event Node::report_replaced() {
    replaced_ = false;
    CalibrationReport report;
    report.boot = reading_.boot;
    report.config = config_;
    bool pulses = false;
    for (int i = 0; i < config_.sonars; ++i) {
        report.results[i] = CalibrationResult::done;
        pulses = pulses || config_.limits[i].no_echo_us != 0;
    }
    message_[0] = 0;
    length_ = pulses ? write_calibration(report, message_, sizeof message_) : 0;
    return Event::replaced;
}

}  // namespace fognav
