// Learns what a sensor measures while nobody is in its way: the limit below which an echo means `blocked`, the farthest
// echo of free space, and whether "no echo" is what free space looks like. The thesis did this by hand (Mendes 2022, section 5.1). Or it learns the pulse
// by which a clone of the HC-SR04 says "no echo", while nothing at all is in its range.
#pragma once

#include "classifier.hpp"

namespace fognav {

constexpr int kCalibrationSamples = 64;  // from these the limit is learned
constexpr int kFreeSamples = 256;        // and in these, after them, false echoes are counted
constexpr int32_t kMarginMm = 200;       // the limit is at least so much nearer than the free distance
constexpr int32_t kBeyondMm = 300;       // an echo so much farther than the free distance comes from elsewhere, at least
constexpr int32_t kMinLimitMm = 300;     // nearer, a free distance guards nothing
constexpr int32_t kMaxSpreadMm = 150;    // between the quartiles; more means that something moved
constexpr int kSteadyShare = 90;         // percent of samples that must be alike: silent, or with an echo
constexpr int32_t kMaxPulseSpreadUs = 100;  // between the quartiles of what a module says for "no echo"

enum class CalibrationGoal : uint8_t { free_distance, no_echo };
enum class CalibrationResult : uint8_t { running, done, stuck, unsteady, too_near };

// In words, with the remedy.
const char* describe(CalibrationResult result);

// What free space was like to a sensor that learned its limit: of so many samples, as the spike filter lets them through,
// how many were echoes from nearer than that limit, and how many had none. All zero if it learned no limit.
struct FreeSamples {
    uint16_t samples = 0;
    uint16_t false_echoes = 0;
    uint16_t no_echoes = 0;
};

class Calibration {
public:
    explicit Calibration(CalibrationGoal goal = CalibrationGoal::free_distance) : goal_(goal) {}

    // Take a sample as measured, what counts by the spike filter since then, and the width of the pulse. The limit comes
    // from what was measured, the share of false echoes from what counts, as in readings. No more are taken once it has
    // ended.
    void update(const Sample& sample, const Sample& counts, uint32_t pulse_us);

    CalibrationResult result() const;

    // Put what was learned into the sensor's limit, and leave the rest of it alone; the result must be `done`.
    void apply(SonarLimit& limit) const;

    FreeSamples free_samples() const;

private:
    CalibrationResult learned() const;
    CalibrationResult free_distance() const;
    void count(const Sample& counts);

    // Where free space is silent, the limit is the range of the module, or lies before the nearest of the rare echoes.
    int32_t limit_mm() const;
    int32_t max_mm() const;  // 0 where free space is silent
    bool silent() const { return silent_ * 100 >= kSteadyShare * (echoes_ + silent_); }
    bool heard() const { return echoes_ * 100 >= kSteadyShare * (echoes_ + silent_); }
    int32_t spread() const { return quartile(3) - quartile(1); }
    int32_t quartile(int which) const;

    CalibrationGoal goal_;
    int32_t echoes_seen_[kCalibrationSamples] = {};  // ascending: ranges (mm) or, for `no_echo`, pulses (us)
    uint8_t echoes_ = 0;
    uint8_t silent_ = 0;
    uint8_t stuck_ = 0;
    FreeSamples free_;
};

}  // namespace fognav
