// Which board this is compiled for, what it is called, and what differs between the two.
#pragma once

#include <Arduino.h>

#if defined(ESP8266)
#include <ESP8266WiFi.h>
#elif defined(ESP32)
#include <WiFi.h>
#else
#error "no board: build with `pio run -e d1_mini` or `pio run -e d1_mini32`"
#endif

#include "board_pins.hpp"

#ifndef FOGNAV_FIRMWARE
#define FOGNAV_FIRMWARE "unknown"
#endif
#ifndef FOGNAV_FIRMWARE_NUMBER
#define FOGNAV_FIRMWARE_NUMBER 1  // grows with each release: an update with a lower one is refused
#endif

namespace fognav {

#if defined(ESP8266)
inline constexpr BoardPins kBoard = kD1Mini;
#else
inline constexpr BoardPins kBoard = kD1Mini32;
#endif

inline uint32_t random_bits() {
#if defined(ESP8266)
    return RANDOM_REG32;  // the hardware's generator
#else
    return esp_random();
#endif
}

inline uint32_t chip_number() {
#if defined(ESP8266)
    return ESP.getChipId();
#else
    return static_cast<uint32_t>(ESP.getEfuseMac() >> 24);
#endif
}

inline size_t largest_free_block() {
#if defined(ESP8266)
    return ESP.getMaxFreeBlockSize();
#else
    return ESP.getMaxAllocHeap();
#endif
}

}  // namespace fognav
