// The edge's parts without a board as a C library: settings, connection and discovery, for their tests.
#include "connection.hpp"
#include "discovery.hpp"

namespace {

// A link whose state the test sets; it counts what the connection asks for.
struct TestLink final : fognav::Link {
    void join_network() override { ++joins; }
    bool network_up() override { return network != 0; }
    void connect_broker() override { ++connects; }
    void leave_broker() override { ++leaves; }
    bool broker_up() override { return broker != 0; }
    bool broker_failed() override { return failed != 0; }
    bool announce() override {
        ++announcements;
        return true;
    }
    void restart() override { ++restarts; }

    int network = 0;
    int broker = 0;
    int failed = 0;
    int joins = 0;
    int connects = 0;
    int leaves = 0;
    int announcements = 0;
    int restarts = 0;
};

struct TestConnection {
    explicit TestConnection(uint32_t seed) : connection(link, seed) {}
    TestLink link;
    fognav::Connection connection;
};

const fognav::BoardPins& board(int is_esp32) { return is_esp32 != 0 ? fognav::kD1Mini32 : fognav::kD1Mini; }

}  // namespace

extern "C" {

// nullptr, or what is wrong with these settings.
const char* fognav_settings_problem(const char* text, uint32_t size, int is_esp32) {
    fognav::Settings settings;
    return fognav::read_settings(text, size, board(is_esp32), settings);
}

// The pins of sensor `index` with these settings: trigger and echo; -1 if they are invalid.
void fognav_settings_pins(const char* text, uint32_t size, int is_esp32, int index, int* trigger, int* echo) {
    fognav::Settings settings;
    fognav::read_settings(text, size, board(is_esp32), settings);
    *trigger = settings.sensors[index].pins.trigger;
    *echo = settings.sensors[index].pins.echo;
}

// The length of Home Assistant's description of the node with these settings, which must be valid.
uint32_t fognav_discovery(const char* text, uint32_t size, char* buffer, uint32_t buffer_size) {
    fognav::Settings settings;
    if (fognav::read_settings(text, size, fognav::kD1Mini, settings) != nullptr) return 0;
    return static_cast<uint32_t>(fognav::write_discovery(settings, "host", buffer, buffer_size));
}

TestConnection* fognav_connection_new(uint32_t seed) { return new TestConnection(seed); }

void fognav_connection_free(TestConnection* test) { delete test; }

// Take a step with this state of the link; `counts` receives joins, connects, announcements, restarts and leaves so far. Returns
// 1 if the connection is up.
int fognav_connection_step(TestConnection* test, uint32_t now_ms, int network, int broker, int failed, int* counts) {
    test->link.network = network;
    test->link.broker = broker;
    test->link.failed = failed;
    test->connection.step(now_ms);
    counts[0] = test->link.joins;
    counts[1] = test->link.connects;
    counts[2] = test->link.announcements;
    counts[3] = test->link.restarts;
    counts[4] = test->link.leaves;
    return test->connection.up() ? 1 : 0;
}

}  // extern "C"
