#include "calibration.hpp"

#include "in_flash.hpp"

namespace fognav {

namespace {

constexpr int32_t kRangeMm = 4000;  // data sheet

}  // namespace

const char* describe(CalibrationResult result) {
    switch (result) {
        case CalibrationResult::running:
            return IN_FLASH("calibration is under way: keep the way in front of the sonars free");
        case CalibrationResult::done:
            return "calibrated";
        case CalibrationResult::stuck:
            return IN_FLASH("the sonar does not answer: check its supply (5 V), trigger and echo wires");
        case CalibrationResult::unsteady:
            return IN_FLASH("its echoes are unsteady: keep the way free, or aim the sonar at a flat wall, and repeat");
        case CalibrationResult::too_near:
            return IN_FLASH("its free distance is below half a metre: mount the sonar where it looks farther");
    }
    return "";
}

void Calibration::update(const Sample& sample, const Sample& counts, uint32_t pulse_us) {
    if (result() != CalibrationResult::running) return;
    if (sample.status == Status::stuck) {
        ++stuck_;
        return;
    }
    if (learned() == CalibrationResult::done) {
        count(counts);
        return;
    }
    if (sample.status == Status::no_echo) {
        ++silent_;
        return;
    }
    const int32_t value = goal_ == CalibrationGoal::no_echo ? static_cast<int32_t>(pulse_us) : sample.range_mm;
    int at = echoes_++;
    for (; at > 0 && echoes_seen_[at - 1] > value; --at) echoes_seen_[at] = echoes_seen_[at - 1];
    echoes_seen_[at] = value;
}

void Calibration::count(const Sample& counts) {
    if (counts.status == Status::stuck) return;  // held by the filter: it says nothing of free space
    ++free_.samples;
    if (counts.status == Status::no_echo) ++free_.no_echoes;
    if (counts.status == Status::ok && counts.range_mm < limit_mm()) ++free_.false_echoes;
}

CalibrationResult Calibration::result() const {
    if (stuck_ >= (kCalibrationSamples + free_.samples) / 4) return CalibrationResult::stuck;
    const CalibrationResult found = learned();
    const bool counts = goal_ == CalibrationGoal::free_distance && found == CalibrationResult::done;
    return counts && free_.samples < kFreeSamples ? CalibrationResult::running : found;
}

CalibrationResult Calibration::learned() const {
    if (echoes_ + silent_ < kCalibrationSamples) return CalibrationResult::running;
    if (goal_ == CalibrationGoal::free_distance) return free_distance();
    const bool alike = silent() || (heard() && spread() <= kMaxPulseSpreadUs);
    return alike ? CalibrationResult::done : CalibrationResult::unsteady;
}

CalibrationResult Calibration::free_distance() const {
    // Neither steadily silent nor steadily heard: no rule could tell its silence from a coat.
    if (!silent() && (!heard() || spread() > kMaxSpreadMm)) return CalibrationResult::unsteady;
    return limit_mm() < kMinLimitMm ? CalibrationResult::too_near : CalibrationResult::done;
}

void Calibration::apply(SonarLimit& limit) const {
    if (goal_ == CalibrationGoal::no_echo) {
        limit.no_echo_us = silent() ? 0 : static_cast<uint32_t>(quartile(2));
        return;
    }
    limit.limit_mm = limit_mm();
    limit.max_mm = max_mm();
    limit.no_echo_is_clear = silent();
}

FreeSamples Calibration::free_samples() const {
    return result() == CalibrationResult::done ? free_ : FreeSamples();
}

int32_t Calibration::quartile(int which) const { return echoes_seen_[(echoes_ - 1) * which / 4]; }

int32_t Calibration::limit_mm() const {
    if (silent()) return echoes_ == 0 ? kRangeMm : echoes_seen_[0] - kMarginMm;
    const int32_t margin = 3 * spread();
    return quartile(1) - (margin > kMarginMm ? margin : kMarginMm);
}

int32_t Calibration::max_mm() const {
    if (silent()) return 0;
    const int32_t margin = 3 * spread();
    return quartile(2) + (margin > kBeyondMm ? margin : kBeyondMm);
}

}  // namespace fognav
