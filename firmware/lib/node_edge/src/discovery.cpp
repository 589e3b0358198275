#include "discovery.hpp"

#include <stdio.h>

#include "fognav_contract.h"
#include "in_flash.hpp"
#include "json_writer.hpp"

namespace fognav {

namespace {

void text_member(JsonWriter& json, const char* key, const char* value) {
    json.key(key);
    json.value(value);
}

// An entity whose value Home Assistant takes from the node's readings by a template of its own language.
void sensor(JsonWriter& json, const Settings& settings, const char* name, const char* value_template) {
    char id[kIdSize * 2 + 16];
    snprintf(id, sizeof id, "fognav-%s-%s-%s", settings.site, settings.node, name);
    json.key(name);
    json.begin_object();
    text_member(json, "p", "sensor");
    text_member(json, "name", name);
    text_member(json, "unique_id", id);
    text_member(json, "value_template", value_template);
}

}  // namespace

size_t write_discovery(const Settings& settings, const char* firmware, char* buffer, size_t size) {
    char topic[FOGNAV_NODE_AVAILABILITY_TOPIC_SIZE];
    char id[kIdSize * 2 + 8];
    JsonWriter json(buffer, size);
    snprintf(id, sizeof id, "fognav-%s-%s", settings.site, settings.node);
    json.begin_object();
    json.key("dev");
    json.begin_object();
    text_member(json, "ids", id);
    text_member(json, "name", settings.node);
    text_member(json, "mf", "Fognav");
    text_member(json, "sw", firmware);
    json.end_object();
    json.key("o");
    json.begin_object();
    text_member(json, "name", "fognav");
    text_member(json, "sw", firmware);
    json.end_object();
    snprintf(topic, sizeof topic, FOGNAV_NODE_READING_TOPIC, settings.site, settings.node);
    text_member(json, "state_topic", topic);
    snprintf(topic, sizeof topic, FOGNAV_NODE_AVAILABILITY_TOPIC, settings.site, settings.node);
    text_member(json, "availability_topic", topic);
    json.key("cmps");
    json.begin_object();
    sensor(json, settings, "state", IN_FLASH("{{ value_json.state }}"));
    json.end_object();
    for (int i = 0; i < settings.sonars; ++i) {
        char name[20];
        char value_template[48];
        snprintf(name, sizeof name, "range-%d", i);
        snprintf(value_template, sizeof value_template, IN_FLASH("{{ value_json.range_m[%d] }}"), i);
        sensor(json, settings, name, value_template);
        text_member(json, "device_class", "distance");
        text_member(json, "unit_of_measurement", "m");
        json.end_object();
    }
    json.end_object();
    json.end_object();
    return json.finish();
}

}  // namespace fognav
