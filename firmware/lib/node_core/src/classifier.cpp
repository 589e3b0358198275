#include "classifier.hpp"

namespace fognav {

State classify(const Sample& sample, const SonarLimit& limit, State before) {
    switch (sample.status) {
        case Status::ok: {
            const int32_t limit_mm = limit.limit_mm + (before == State::blocked ? kHysteresisMm : 0);
            if (sample.range_mm < limit_mm) return State::blocked;
            return limit.max_mm != 0 && sample.range_mm > limit.max_mm ? State::unknown : State::clear;
        }
        case Status::no_echo:
            return limit.no_echo_is_clear ? State::clear : State::unknown;
        case Status::stuck:
            break;
    }
    return State::unknown;
}

State fuse(const State* states, const Sample* samples, int count) {
    bool heard = false;
    bool clear = true;
    for (int i = 0; i < count; ++i) {
        if (states[i] == State::blocked) return State::blocked;
        clear = clear && states[i] == State::clear;
        heard = heard || samples[i].status == Status::ok;
    }
    return clear && heard ? State::clear : State::unknown;
}

}  // namespace fognav
