#include "values.hpp"

#include "fognav_contract.h"
#include "json_writer.hpp"

namespace fognav {

static_assert(kValueSize <= FOGNAV_NODE_VALUE_LIMIT, "a value may be longer than its channel allows");
static_assert(kValueSize >= 96 + FOGNAV_ID_MAX + FOGNAV_NODE_VALUE_UNIT_LENGTH_MAX, "a value may not fit");

size_t write_value(const Value& value, char* buffer, size_t size) {
    JsonWriter json(buffer, size);
    json.begin_object();
    json.key(FOGNAV_NODE_VALUE_SEQ_FIELD);
    json.value(static_cast<uint64_t>(value.seq));
    json.key(FOGNAV_NODE_VALUE_BOOT_FIELD);
    json.value(static_cast<uint64_t>(value.boot));
    json.key(FOGNAV_NODE_VALUE_KIND_FIELD);
    json.value(value.kind);
    json.key(FOGNAV_NODE_VALUE_VALUE_FIELD);
    json.thousandths(value.thousandths);
    json.key(FOGNAV_NODE_VALUE_UNIT_FIELD);
    json.value(value.unit);
    json.end_object();
    return json.finish();
}

bool Values::add(ValueSensor& sensor) {
    if (count_ == kMaxValues) return false;
    sensors_[count_++] = &sensor;
    return true;
}

bool Values::step(uint32_t now_ms) {
    if (count_ == 0 || now_ms - read_ms_ < kValuePeriodMs / static_cast<uint32_t>(count_)) return false;
    read_ms_ = now_ms;
    ValueSensor& sensor = *sensors_[next_];
    next_ = (next_ + 1) % count_;
    value_.boot = boot_;
    value_.kind = sensor.kind();
    value_.unit = sensor.unit();
    if (!sensor.read(value_.thousandths)) return false;
    value_.seq = seq_++;
    return write_value(value_, message_, sizeof message_) > 0;
}

}  // namespace fognav
