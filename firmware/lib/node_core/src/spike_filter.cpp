#include "spike_filter.hpp"

namespace fognav {

bool agree(const Sample& a, const Sample& b) {
    if (a.status != b.status) return false;
    const int32_t difference = a.range_mm > b.range_mm ? a.range_mm - b.range_mm : b.range_mm - a.range_mm;
    return difference <= kAgreeMm;
}

Sample SpikeFilter::update(const Sample& sample) {
    const bool confirmed = held_ > 0 && agree(sample, candidate_);
    if (empty_ || confirmed || held_ == kMaxHeld || agree(sample, accepted_)) {
        accepted_ = sample;
        held_ = 0;
        empty_ = false;
    } else {
        candidate_ = sample;
        ++held_;
    }
    return accepted_;
}

}  // namespace fognav
