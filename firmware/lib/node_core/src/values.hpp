// Quantities other than ranges that can tell a danger: temperature, gas. A node publishes each once a second; whether it is
// a hazard is decided by the aggregator.
#pragma once

#include <stddef.h>
#include <stdint.h>

namespace fognav {

class ValueSensor {
public:
    virtual const char* kind() const = 0;  // an id of the contract: "temperature", "gas"
    virtual const char* unit() const = 0;

    // Thousandths of the unit. False if the sensor does not answer: then nothing is published.
    virtual bool read(int32_t& thousandths) = 0;

protected:
    ~ValueSensor() = default;
};

struct Value {
    uint32_t seq = 0;
    uint32_t boot = 0;
    const char* kind = "";
    const char* unit = "";
    int32_t thousandths = 0;
};

// Write it as JSON; return its length, or 0 if the buffer is too small for it.
size_t write_value(const Value& value, char* buffer, size_t size);

constexpr int kMaxValues = 4;
constexpr uint32_t kValuePeriodMs = 1000;
constexpr size_t kValueSize = 192;  // with the longest kind and unit

class Values {
public:
    explicit Values(uint32_t boot) : boot_(boot) {}

    // It must live as long as this. False if there are kMaxValues already.
    bool add(ValueSensor& sensor);

    // Read the sensor whose turn it is (millis(), 32 bits that wrap). True if `message` is to be published.
    bool step(uint32_t now_ms);

    const char* message() const { return message_; }

    // What the last step that returned true has read.
    const Value& value() const { return value_; }

private:
    uint32_t boot_;
    ValueSensor* sensors_[kMaxValues] = {};
    int count_ = 0;
    int next_ = 0;
    uint32_t read_ms_ = 0;
    uint32_t seq_ = 0;
    Value value_;
    char message_[kValueSize] = "";
};

}  // namespace fognav
