#include "connection.hpp"

namespace fognav {

uint32_t Backoff::next_ms() {
    // Marsaglia's xorshift with 32 bits (2003).
    random_ ^= random_ << 13;
    random_ ^= random_ >> 17;
    random_ ^= random_ << 5;
    const uint32_t half = delay_ms_ / 2;
    const uint32_t delay = half + random_ % (half + 1);
    delay_ms_ = delay_ms_ * 2 > kLongestDelayMs ? kLongestDelayMs : delay_ms_ * 2;
    return delay;
}

void Connection::enter(Phase phase, uint32_t now_ms) {
    phase_ = phase;
    since_ms_ = now_ms;
}

void Connection::wait(uint32_t now_ms) {
    link_.leave_broker();
    delay_ms_ = backoff_.next_ms();
    enter(Phase::waiting, now_ms);
}

void Connection::step(uint32_t now_ms) {
    if (!known_ || phase_ == Phase::up) {
        known_ = true;
        up_ms_ = now_ms;
    }
    if (now_ms - up_ms_ >= kRestartAfterMs) {
        up_ms_ = now_ms;
        link_.restart();
        return;
    }
    switch (phase_) {
        case Phase::waiting:
            if (now_ms - since_ms_ < delay_ms_) return;
            if (link_.network_up()) {
                link_.connect_broker();
                enter(Phase::connecting, now_ms);
            } else {
                link_.join_network();
                enter(Phase::joining, now_ms);
            }
            return;
        case Phase::joining:
            if (link_.network_up()) {
                link_.connect_broker();
                enter(Phase::connecting, now_ms);
            } else if (now_ms - since_ms_ >= kNetworkTimeoutMs) {
                wait(now_ms);
            }
            return;
        case Phase::connecting:
            if (link_.broker_up()) {
                // Connected and silent is worse than gone: nobody would notice.
                if (!link_.announce()) {
                    wait(now_ms);
                    return;
                }
                backoff_.reset();
                enter(Phase::up, now_ms);
            } else if (link_.broker_failed() || !link_.network_up() || now_ms - since_ms_ >= kBrokerTimeoutMs) {
                wait(now_ms);
            }
            return;
        case Phase::up:
            if (!link_.broker_up()) wait(now_ms);
            return;
    }
}

}  // namespace fognav
