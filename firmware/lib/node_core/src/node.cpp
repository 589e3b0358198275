#include "node.hpp"

#include "fognav_contract.h"

namespace fognav {

static_assert(kMessageSize <= FOGNAV_NODE_READING_LIMIT, "a reading may be longer than its channel allows");

Node::Node(const NodeSettings& settings)
    : config_(settings.config), cycle_(settings.config.sonars, settings.boot), publish_(settings.publish) {
    for (int i = 0; i < kMaxSonars; ++i) no_echo_[i] = settings.no_echo[i];
    cycle_.set_pause(config_.pause_ms);
    reading_.boot = settings.boot;
    reading_.sonars = config_.sonars;
    reading_.firmware = settings.firmware;
    message_[0] = 0;
}

Node::Event Node::step(uint32_t now_us) {
    if (started_) uptime_us_ += now_us - seen_us_;
    started_ = true;
    seen_us_ = now_us;
    switch (cycle_.step(now_us)) {
        case MeasurementCycle::Action::trigger:
            captures_[cycle_.current()].arm(now_us);
            return Event::trigger;
        case MeasurementCycle::Action::listen: {
            Sample sample;
            const int sonar = cycle_.current();
            if (captures_[sonar].poll(now_us, temperature_dc_, no_echo_[sonar], sample)) take(sample);
            return Event::none;
        }
        case MeasurementCycle::Action::finished:
            return finish();
        case MeasurementCycle::Action::wait:
            break;
    }
    return Event::none;
}

void Node::take(const Sample& sample) {
    const int sonar = cycle_.current();
    if (calibrating_) calibrations_[sonar].update(sample);
    const Sample counts = filters_[sonar].update(sample);
    reading_.samples[sonar] = counts;
    states_[sonar] = classify(counts, config_.limits[sonar], states_[sonar]);
    cycle_.measured();
}

Node::Event Node::finish() {
    if (calibrating_) end_calibration();
    reading_.uptime_ms = uptime_us_ / 1000;
    reading_.state = calibrating_ ? State::unknown : fuse(states_, reading_.sonars);
    if (!publish_.update(reading_.state, reading_.uptime_ms)) return Event::none;
    length_ = write_reading(reading_, message_, sizeof message_);
    ++reading_.seq;
    return Event::publish;
}

const char* Node::configure(const char* text, size_t size) {
    const char* problem = read_config(text, size, config_.sonars, config_);
    if (problem != nullptr) return problem;
    cycle_.set_pause(config_.pause_ms);
    publish_.restart();
    return nullptr;
}

void Node::calibrate() {
    for (int i = 0; i < config_.sonars; ++i) calibrations_[i] = Calibration();
    calibrating_ = true;
}

void Node::end_calibration() {
    for (int i = 0; i < config_.sonars; ++i) {
        if (calibrations_[i].result() == CalibrationResult::running) return;
    }
    calibrating_ = false;
    for (int i = 0; i < config_.sonars; ++i) {
        if (calibrations_[i].result() != CalibrationResult::done) continue;
        config_.limits[i].limit_mm = calibrations_[i].limit_mm();
        config_.limits[i].no_echo_is_clear = calibrations_[i].no_echo_is_clear();
    }
}

}  // namespace fognav
