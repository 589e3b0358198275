// Sensors other than sonars, and what samples mean, as a C library for their tests.
#include <string.h>

#include "classifier.hpp"
#include "node.hpp"
#include "spike_filter.hpp"
#include "time_of_flight.hpp"
#include "values.hpp"

namespace {

// A ranger whose answers the test sets.
struct TestRanger final : fognav::Ranger {
    bool discard() override { return answers != 0; }
    bool ready() override { return is_ready != 0; }
    void read(uint16_t& millimetres, uint8_t& status) override {
        millimetres = range_mm;
        status = code;
    }

    int answers = 1;
    int is_ready = 1;
    uint16_t range_mm = 0;
    uint8_t code = 0;
};

// A node with one sonar and one ranger.
struct RangerNode {
    explicit RangerNode(const fognav::NodeSettings& settings) : node(with(settings, sensor)) {}
    static fognav::NodeSettings with(const fognav::NodeSettings& settings, fognav::RangeSensor& sensor) {
        fognav::NodeSettings changed = settings;
        changed.sensors[1] = &sensor;
        return changed;
    }
    TestRanger ranger;
    fognav::TimeOfFlight sensor{ranger, fognav::vl53l1x_sample};
    fognav::Node node;
};

struct TestValue final : fognav::ValueSensor {
    const char* kind() const override { return name; }
    const char* unit() const override { return "C"; }
    bool read(int32_t& thousandths) override {
        thousandths = value;
        return answers != 0;
    }

    char name[33] = "temperature";
    int32_t value = 0;
    int answers = 1;
};

struct TestValues {
    explicit TestValues(uint32_t boot) : values(boot) {}
    TestValue sensors[fognav::kMaxValues + 1];
    fognav::Values values;
};

}  // namespace

extern "C" {

// The states that a sonar with this limit goes through with these samples (status, range in mm), filtered.
void fognav_states(const int32_t* status, const int32_t* range_mm, int count, int32_t limit_mm, int32_t* states) {
    fognav::SpikeFilter filter;
    fognav::SonarLimit limit;
    limit.limit_mm = limit_mm;
    fognav::State state = fognav::State::unknown;
    for (int i = 0; i < count; ++i) {
        state = fognav::classify(filter.update({static_cast<fognav::Status>(status[i]), range_mm[i]}), limit, state);
        states[i] = static_cast<int32_t>(state);
    }
}

// The status of an answer of a ranger; `range_mm` receives its range.
int fognav_ranger_sample(int is_vl53l1x, uint16_t millimetres, uint8_t code, int32_t* range_mm) {
    const fognav::Sample sample =
        is_vl53l1x != 0 ? fognav::vl53l1x_sample(millimetres, code) : fognav::vl53l0x_sample(millimetres, code);
    *range_mm = sample.range_mm;
    return static_cast<int>(sample.status);
}

RangerNode* fognav_ranger_node_new(int32_t limit_mm) {
    fognav::NodeSettings settings;
    settings.config.sonars = 2;
    settings.config.limits[0].no_echo_is_clear = true;
    settings.config.limits[0].limit_mm = limit_mm;
    settings.config.limits[1].limit_mm = limit_mm;
    return new RangerNode(settings);
}

void fognav_ranger_node_free(RangerNode* test) { delete test; }

// Step the node every millisecond for so long, with these answers of its ranger and a sonar that hears nothing; returns
// the state of its last reading, and the ranger's status and range.
int fognav_ranger_node_run(RangerNode* test, uint32_t start_us, uint32_t ms, int answers, int ready, uint16_t range_mm,
                           uint8_t code, int32_t* status, int32_t* out_range_mm) {
    test->ranger.answers = answers;
    test->ranger.is_ready = ready;
    test->ranger.range_mm = range_mm;
    test->ranger.code = code;
    for (uint32_t at = 0; at < ms; ++at) {
        const uint32_t now_us = start_us + at * 1000;
        if (test->node.step(now_us) == fognav::Node::Event::trigger && test->node.sonar() == 0) {
            test->node.on_edge(0, true, now_us + 450);
            test->node.on_edge(0, false, now_us + 38450);
        }
    }
    const fognav::Reading& reading = test->node.reading();
    *status = static_cast<int32_t>(reading.samples[1].status);
    *out_range_mm = reading.samples[1].range_mm;
    return static_cast<int>(reading.state);
}

TestValues* fognav_values_new(uint32_t boot) { return new TestValues(boot); }

void fognav_values_free(TestValues* test) { delete test; }

// Add the sensor with this index; returns 1 if there was room.
int fognav_values_add(TestValues* test, int index, const char* kind) {
    TestValue& sensor = test->sensors[index];
    strncpy(sensor.name, kind, sizeof sensor.name - 1);
    return test->values.add(sensor) ? 1 : 0;
}

void fognav_values_set(TestValues* test, int index, int32_t thousandths, int answers) {
    test->sensors[index].value = thousandths;
    test->sensors[index].answers = answers;
}

// The message to publish at this time, or nullptr.
const char* fognav_values_step(TestValues* test, uint32_t now_ms) {
    return test->values.step(now_ms) ? test->values.message() : nullptr;
}

}  // extern "C"
