// Keeps a node connected: first the network, then the broker, each again and again with a growing, random delay. It never
// gives up and never waits: a node boots faster than the router of a building after a power cut.
#pragma once

#include <stdint.h>

namespace fognav {

constexpr uint32_t kFirstDelayMs = 500;
constexpr uint32_t kLongestDelayMs = 30000;
constexpr uint32_t kNetworkTimeoutMs = 20000;
constexpr uint32_t kBrokerTimeoutMs = 15000;
constexpr uint32_t kRestartAfterMs = 600000;

// What the board does on request, and what it says of its state.
class Link {
public:
    virtual ~Link() = default;
    virtual void join_network() = 0;  // begin; forget what was begun before
    virtual bool network_up() = 0;
    virtual void connect_broker() = 0;  // begin
    virtual void leave_broker() = 0;    // end what was begun, if anything; 250 ms pass until the next attempt
    virtual bool broker_up() = 0;
    virtual bool broker_failed() = 0;  // the attempt that was begun has ended without success
    virtual bool announce() = 0;       // subscribe and say that the node is there; false: the broker was not told all
    virtual void restart() = 0;        // the board: a radio that has hung for ten minutes does not recover by itself
};

// A delay that doubles up to a limit, of which each wait takes a random half or more: after a power cut a hundred nodes
// must not come back at one moment.
class Backoff {
public:
    explicit Backoff(uint32_t seed) : random_(seed != 0 ? seed : 1) {}
    uint32_t next_ms();
    void reset() { delay_ms_ = kFirstDelayMs; }

private:
    uint32_t random_;
    uint32_t delay_ms_ = kFirstDelayMs;
};

class Connection {
public:
    Connection(Link& link, uint32_t seed) : link_(link), backoff_(seed) {}

    // Take the next step at this time (millis(), 32 bits that wrap); call it in every turn of the loop.
    void step(uint32_t now_ms);

    bool up() const { return phase_ == Phase::up; }

private:
    enum class Phase : uint8_t { waiting, joining, connecting, up };

    void enter(Phase phase, uint32_t now_ms);
    void wait(uint32_t now_ms);

    Link& link_;
    Backoff backoff_;
    Phase phase_ = Phase::waiting;
    uint32_t since_ms_ = 0;
    uint32_t delay_ms_ = 0;
    bool known_ = false;  // whether `up_ms_` is set
    uint32_t up_ms_ = 0;  // when the broker was last connected, or the first step was taken
};

}  // namespace fognav
