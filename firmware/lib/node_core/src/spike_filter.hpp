// Keeps one sonar's measurements free of spikes: a sample that contradicts the one before it counts only when the next
// agrees with it. A change is therefore told one sample later, never more than kMaxHeld.
#pragma once

#include "sample.hpp"

namespace fognav {

// Two samples agree within this: somebody who walks moves 12 to 17 cm in a cycle of 0.12 s, and about half of that until
// a contradicted sample is measured again (50 to 60 ms).
constexpr int32_t kAgreeMm = 150;
constexpr int kMaxHeld = 2;        // after so many samples that agree with nothing, the newest counts: nothing is hidden

class SpikeFilter {
public:
    // Take a sample; return the one that counts now.
    Sample update(const Sample& sample);

    // The last sample contradicts what counts, and is the first to do so.
    bool contradicted() const { return held_ == 1; }

private:
    Sample accepted_ = {Status::stuck, 0};
    Sample candidate_ = {Status::stuck, 0};
    uint8_t held_ = 0;
    bool empty_ = true;
};

bool agree(const Sample& a, const Sample& b);

}  // namespace fognav
