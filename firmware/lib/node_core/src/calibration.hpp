// Learns what a sonar measures while nobody is in its way: the limit below which an echo means `blocked`, and whether
// "no echo" is what free space looks like. The thesis did this by hand (Mendes 2022, section 5.1).
#pragma once

#include "echo.hpp"

namespace fognav {

constexpr int kCalibrationSamples = 64;
constexpr int32_t kMarginMm = 200;       // the limit is at least so much nearer than the free distance
constexpr int32_t kMinLimitMm = 300;     // nearer, a free distance guards nothing
constexpr int32_t kMaxSpreadMm = 150;    // between the quartiles; more means that something moved
constexpr int kSilentShare = 90;         // percent of samples without an echo that make "no echo" the free state

enum class CalibrationResult : uint8_t { running, done, stuck, unsteady, too_near };

// In words, with the remedy.
const char* describe(CalibrationResult result);

class Calibration {
public:
    // Take a sample as measured, not filtered. No more are taken once it has ended.
    void update(const Sample& sample);

    CalibrationResult result() const;

    // Valid when the result is `done`. Where free space is silent, the limit is the range of the module, or lies before
    // the nearest of the rare echoes.
    int32_t limit_mm() const;
    bool no_echo_is_clear() const;

private:
    int32_t quartile(int which) const;

    int32_t ranges_mm_[kCalibrationSamples] = {};  // those with an echo, ascending
    uint8_t echoes_ = 0;
    uint8_t silent_ = 0;
    uint8_t stuck_ = 0;
};

}  // namespace fognav
