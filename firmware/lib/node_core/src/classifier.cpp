#include "classifier.hpp"

namespace fognav {

State classify(const Sample& sample, const SonarLimit& limit, State before) {
    switch (sample.status) {
        case Status::ok: {
            const int32_t limit_mm = limit.limit_mm + (before == State::blocked ? kHysteresisMm : 0);
            return sample.range_mm < limit_mm ? State::blocked : State::clear;
        }
        case Status::no_echo:
            return limit.no_echo_is_clear ? State::clear : State::unknown;
        case Status::stuck:
            break;
    }
    return State::unknown;
}

State fuse(const State* states, int count) {
    State fused = count > 0 ? State::clear : State::unknown;
    for (int i = 0; i < count; ++i) {
        if (states[i] == State::blocked) return State::blocked;
        if (states[i] == State::unknown) fused = State::unknown;
    }
    return fused;
}

}  // namespace fognav
