#include "calibration.hpp"

namespace fognav {

namespace {

constexpr int32_t kRangeMm = 4000;  // data sheet

}  // namespace

const char* describe(CalibrationResult result) {
    switch (result) {
        case CalibrationResult::running:
            return "calibration is under way: keep the way in front of the sonars free";
        case CalibrationResult::done:
            return "calibrated";
        case CalibrationResult::stuck:
            return "the sonar does not answer: check its supply (5 V), trigger and echo wires";
        case CalibrationResult::unsteady:
            return "its echoes are unsteady: keep the way free, or aim the sonar at a flat wall, and repeat";
        case CalibrationResult::too_near:
            return "its free distance is below half a metre: mount the sonar where it looks farther";
    }
    return "";
}

void Calibration::update(const Sample& sample) {
    if (result() != CalibrationResult::running) return;
    if (sample.status == Status::stuck) {
        ++stuck_;
        return;
    }
    if (sample.status == Status::no_echo) {
        ++silent_;
        return;
    }
    int at = echoes_++;
    for (; at > 0 && ranges_mm_[at - 1] > sample.range_mm; --at) ranges_mm_[at] = ranges_mm_[at - 1];
    ranges_mm_[at] = sample.range_mm;
}

CalibrationResult Calibration::result() const {
    if (stuck_ >= kCalibrationSamples / 4) return CalibrationResult::stuck;
    const int measured = echoes_ + silent_;
    if (measured < kCalibrationSamples) return CalibrationResult::running;
    if (!no_echo_is_clear()) {
        // Neither steadily silent nor steadily heard: no rule could tell its silence from a coat.
        if (echoes_ * 100 < kSilentShare * measured) return CalibrationResult::unsteady;
        if (quartile(3) - quartile(1) > kMaxSpreadMm) return CalibrationResult::unsteady;
    }
    return limit_mm() < kMinLimitMm ? CalibrationResult::too_near : CalibrationResult::done;
}

bool Calibration::no_echo_is_clear() const { return silent_ * 100 >= kSilentShare * (echoes_ + silent_); }

int32_t Calibration::quartile(int which) const { return ranges_mm_[(echoes_ - 1) * which / 4]; }

int32_t Calibration::limit_mm() const {
    if (no_echo_is_clear()) return echoes_ == 0 ? kRangeMm : ranges_mm_[0] - kMarginMm;
    const int32_t spread = 3 * (quartile(3) - quartile(1));
    return quartile(1) - (spread > kMarginMm ? spread : kMarginMm);
}

}  // namespace fognav
