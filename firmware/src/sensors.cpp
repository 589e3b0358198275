#include "sensors.hpp"

#include <DallasTemperature.h>
#include <OneWire.h>
#include <VL53L0X.h>
#include <VL53L1X.h>
#include <Wire.h>

#include <new>

#include "board.hpp"
#include "time_of_flight.hpp"

namespace fognav {

namespace {

constexpr uint32_t kI2cHz = 400000;
constexpr uint16_t kRangerAnswersMs = 20;
constexpr uint32_t kRangerBudgetUs = 33000;  // ST's default: 30 measurements a second
constexpr uint8_t kFirstAddress = 0x30;      // a ranger's own, at which it starts, is 0x29
constexpr uint32_t kRangerBootMs = 2;        // after its shutdown pin is released: ST says 1.2

class RangerL0X final : public Ranger {
public:
    void begin(uint8_t address) {
        sensor_.setTimeout(kRangerAnswersMs);
        answers_ = sensor_.init();
        sensor_.setAddress(address);
        sensor_.setMeasurementTimingBudget(kRangerBudgetUs);
        sensor_.startContinuous();
    }
    bool discard() override {
        if (answers_) sensor_.writeReg(VL53L0X::SYSTEM_INTERRUPT_CLEAR, 1);
        return answers_ && sensor_.last_status == 0;
    }
    bool ready() override { return (sensor_.readReg(VL53L0X::RESULT_INTERRUPT_STATUS) & 7) != 0; }
    void read(uint16_t& millimetres, uint8_t& code) override {
        code = sensor_.readReg(VL53L0X::RESULT_RANGE_STATUS) >> 3 & 0xF;
        millimetres = sensor_.readRangeContinuousMillimeters();
    }

private:
    VL53L0X sensor_;
    bool answers_ = false;
};

class RangerL1X final : public Ranger {
public:
    void begin(uint8_t address) {
        sensor_.setTimeout(kRangerAnswersMs);
        answers_ = sensor_.init();
        sensor_.setAddress(address);
        sensor_.setDistanceMode(VL53L1X::Long);
        sensor_.setMeasurementTimingBudget(kRangerBudgetUs);
        sensor_.startContinuous(kRangerBudgetUs / 1000);
    }
    bool discard() override {
        if (answers_ && sensor_.dataReady()) sensor_.read(false);
        return answers_ && sensor_.last_status == 0;
    }
    bool ready() override { return sensor_.dataReady(); }
    void read(uint16_t& millimetres, uint8_t& code) override {
        millimetres = sensor_.read(false);
        code = static_cast<uint8_t>(sensor_.ranging_data.range_status);
    }

private:
    VL53L1X sensor_;
    bool answers_ = false;
};

// A place for one ranger of either kind: the settings say which, and nothing is made in the loop.
struct RangerPlace {
    RangerL0X l0x;
    RangerL1X l1x;
    alignas(TimeOfFlight) unsigned char sensor[sizeof(TimeOfFlight)];
};

RangerPlace& ranger_place(int index) {
    static RangerPlace places[kMaxSonars];
    return places[index];
}

RangeSensor* begin_ranger(RangeSensorKind kind, RangerPlace& place, uint8_t address) {
    if (kind == RangeSensorKind::vl53l0x) {
        place.l0x.begin(address);
        return new (place.sensor) TimeOfFlight(place.l0x, vl53l0x_sample);
    }
    place.l1x.begin(address);
    return new (place.sensor) TimeOfFlight(place.l1x, vl53l1x_sample);
}

// One echo line, for its interrupt.
struct EchoLine {
    Node* node;
    int sonar;
    int pin;
};

EchoLine echo_lines[kMaxSonars];

void IRAM_ATTR on_echo(void* argument) {
    const EchoLine& line = *static_cast<EchoLine*>(argument);
    line.node->on_edge(line.sonar, digitalRead(line.pin) == HIGH, micros());
}

class Thermometer final : public ValueSensor {
public:
    explicit Thermometer(const ValueSettings& settings)
        : settings_(settings), wire_(static_cast<uint8_t>(settings.pin)), sensors_(&wire_) {
        sensors_.begin();
        sensors_.setWaitForConversion(false);  // it takes 750 ms: what is read is what was asked for a second ago
        sensors_.requestTemperatures();
    }
    const char* kind() const override { return settings_.name; }
    const char* unit() const override { return "C"; }
    bool read(int32_t& thousandths) override {
        const float celsius = sensors_.getTempCByIndex(0);
        sensors_.requestTemperatures();
        thousandths = static_cast<int32_t>(celsius * 1000);
        return celsius > DEVICE_DISCONNECTED_C;
    }

private:
    const ValueSettings& settings_;
    OneWire wire_;
    DallasTemperature sensors_;
};

class Voltage final : public ValueSensor {
public:
    explicit Voltage(const ValueSettings& settings) : settings_(settings) {}
    const char* kind() const override { return settings_.name; }
    const char* unit() const override { return "V"; }
    bool read(int32_t& thousandths) override {
        thousandths = analogRead(A0) * settings_.full_scale_mv / kAnalogMax;
        return true;
    }

private:
#if defined(ESP8266)
    static constexpr int32_t kAnalogMax = 1023;
#else
    static constexpr int32_t kAnalogMax = 4095;
#endif
    const ValueSettings& settings_;
};

// As with the rangers: places for what the settings ask for.
template <class Sensor>
Sensor& make_value(int index, const ValueSettings& settings) {
    struct Place {
        alignas(Sensor) unsigned char bytes[sizeof(Sensor)];
    };
    static Place places[kMaxValues];
    return *new (&places[index]) Sensor(settings);
}

}  // namespace

void begin_rangers(const Settings& settings, RangeSensor* (&sensors)[kMaxSonars]) {
    bool any = false;
    for (int i = 0; i < settings.sonars; ++i) {
        const RangeSensorSettings& each = settings.sensors[i];
        if (each.kind == RangeSensorKind::hc_sr04) continue;
        any = true;
        if (each.shutdown == kNoPin) continue;
        pinMode(static_cast<uint8_t>(each.shutdown), OUTPUT);
        digitalWrite(static_cast<uint8_t>(each.shutdown), LOW);
    }
    if (!any) return;
    Wire.begin(kBoard.sda, kBoard.scl);
    Wire.setClock(kI2cHz);
    // The one that can't be switched off is awake already: it must leave the common address first.
    for (const bool with_pin : {false, true}) {
        for (int i = 0; i < settings.sonars; ++i) {
            const RangeSensorSettings& each = settings.sensors[i];
            if (each.kind == RangeSensorKind::hc_sr04 || (each.shutdown != kNoPin) != with_pin) continue;
            if (with_pin) {
                pinMode(static_cast<uint8_t>(each.shutdown), INPUT);  // its own pull-up raises it: 5 V would harm it
                delay(kRangerBootMs);
            }
            sensors[i] = begin_ranger(each.kind, ranger_place(i), static_cast<uint8_t>(kFirstAddress + i));
        }
    }
}

void begin_sonars(const Settings& settings, Node& node) {
    for (int i = 0; i < settings.sonars; ++i) {
        if (settings.sensors[i].kind != RangeSensorKind::hc_sr04) continue;
        const SonarPins& pins = settings.sensors[i].pins;
        pinMode(static_cast<uint8_t>(pins.trigger), OUTPUT);
        digitalWrite(static_cast<uint8_t>(pins.trigger), LOW);
        pinMode(static_cast<uint8_t>(pins.echo), INPUT);
        echo_lines[i] = {&node, i, pins.echo};
        attachInterruptArg(digitalPinToInterrupt(pins.echo), on_echo, &echo_lines[i], CHANGE);
    }
}

void trigger(const Settings& settings, int sonar) {
    if (settings.sensors[sonar].kind != RangeSensorKind::hc_sr04) return;
    const uint8_t pin = static_cast<uint8_t>(settings.sensors[sonar].pins.trigger);
    digitalWrite(pin, HIGH);
    delayMicroseconds(kTriggerUs);
    digitalWrite(pin, LOW);
}

void begin_values(const Settings& settings, Values& values) {
    for (int i = 0; i < settings.values; ++i) {
        const ValueSettings& each = settings.value_sensors[i];
        if (each.kind == ValueSensorKind::ds18b20) {
            values.add(make_value<Thermometer>(i, each));
        } else {
            values.add(make_value<Voltage>(i, each));
        }
    }
}

}  // namespace fognav
