// The node's core as a C library for this computer: the simulator's nodes and the tests load it.
#include "node.hpp"

using fognav::Node;

extern "C" {

struct FognavSonar {
    int32_t limit_mm;
    int32_t max_mm;
    int32_t no_echo_is_clear;
};

// A node with so many sonars (1 to 8). `every_reading` is the thesis's mode of publishing; `firmware` must outlive it.
Node* fognav_node_new(const FognavSonar* sonars, int count, uint32_t boot, int pause_ms, int every_reading,
                      const char* firmware) {
    if (count < 1 || count > fognav::kMaxSonars) return nullptr;
    fognav::NodeSettings settings;
    settings.config.sonars = count;
    settings.config.pause_ms = static_cast<uint16_t>(pause_ms);
    for (int i = 0; i < count; ++i) {
        settings.config.limits[i].limit_mm = sonars[i].limit_mm;
        settings.config.limits[i].max_mm = sonars[i].max_mm;
        settings.config.limits[i].no_echo_is_clear = sonars[i].no_echo_is_clear != 0;
    }
    settings.boot = boot;
    settings.publish = every_reading != 0 ? fognav::PublishMode::every_reading : fognav::PublishMode::on_change;
    settings.firmware = firmware;
    return new Node(settings);
}

void fognav_node_free(Node* node) { delete node; }

// 0: nothing, 1: trigger sonar `fognav_node_sonar`, 2: publish `fognav_node_message`, 3: it is a calibration, 4: which is to be
// stored, 5: store it, or nothing if it is empty.
int fognav_node_step(Node* node, uint32_t now_us) { return static_cast<int>(node->step(now_us)); }

// Step from `now_us` on, every `period_us`, up to and with `until_us` or the first event, which is returned as above;
// `now_us` becomes the time of the next step. For whoever steps many nodes: a call from Python takes longer than a step.
int fognav_node_run(Node* node, uint64_t* now_us, uint64_t until_us, uint32_t period_us) {
    while (*now_us <= until_us) {
        const Node::Event event = node->step(static_cast<uint32_t>(*now_us));
        *now_us += period_us;
        if (event != Node::Event::none) return static_cast<int>(event);
    }
    return static_cast<int>(Node::Event::none);
}

int fognav_node_sonar(const Node* node) { return node->sonar(); }

const char* fognav_node_message(const Node* node) { return node->message(); }

void fognav_node_edge(Node* node, int sonar, int high, uint32_t now_us) { node->on_edge(sonar, high != 0, now_us); }

// A configuration as JSON; returns a null pointer, or what is wrong with it.
const char* fognav_node_configure(Node* node, const char* text, uint32_t size) { return node->configure(text, size); }

void fognav_node_connected(Node* node) { node->on_connected(); }

void fognav_node_temperature(Node* node, int temperature_dc) {
    node->set_temperature(static_cast<int16_t>(temperature_dc));
}

void fognav_node_measure_temperature(Node* node, int temperature_dc) { node->measure_temperature(temperature_dc); }

void fognav_node_rssi(Node* node, int rssi) { node->set_rssi(static_cast<int16_t>(rssi)); }

// A command, or a calibration that was stored; each returns a null pointer, or what is wrong with it.
const char* fognav_node_command(Node* node, const char* text, uint32_t size) { return node->command(text, size); }

const char* fognav_node_restore(Node* node, const char* text, uint32_t size) { return node->restore(text, size); }

int fognav_node_calibrating(const Node* node) { return node->calibrating() ? 1 : 0; }

int fognav_node_calibration(const Node* node, int sonar) { return static_cast<int>(node->calibration(sonar)); }

const char* fognav_node_describe_calibration(int result) {
    return fognav::describe(static_cast<fognav::CalibrationResult>(result));
}

int32_t fognav_node_limit_mm(const Node* node, int sonar) { return node->config().limits[sonar].limit_mm; }

int32_t fognav_node_max_mm(const Node* node, int sonar) { return node->config().limits[sonar].max_mm; }

uint32_t fognav_node_no_echo_us(const Node* node, int sonar) { return node->config().limits[sonar].no_echo_us; }

int fognav_node_no_echo_is_clear(const Node* node, int sonar) {
    return node->config().limits[sonar].no_echo_is_clear ? 1 : 0;
}

}  // extern "C"
