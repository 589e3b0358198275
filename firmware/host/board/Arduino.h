// A stand-in for the parts of the Arduino core that the firmware uses, so that it compiles and runs without a board:
// world.cpp is what lies behind it.
#pragma once

#include <stdint.h>
#include <stdio.h>
#include <string.h>

#include <string>

#define IRAM_ATTR
#define HIGH 1
#define LOW 0
#define INPUT 0
#define OUTPUT 1
#define INPUT_PULLUP 2
#define CHANGE 3
#define A0 17
#define RANDOM_REG32 esp_random()

class String : public std::string {
public:
    using std::string::string;
};

struct SerialPort {
    void begin(unsigned long) {}
    template <class... Arguments>
    void printf(const char* format, Arguments... arguments) {
        ::printf("serial ");
        ::printf(format, arguments...);
    }
};
extern SerialPort Serial;

struct Chip {
    [[noreturn]] void restart();
    uint32_t getChipId() { return 0xC0FFEE; }
    uint64_t getEfuseMac() { return 0xC0FFEE000000; }
    uint32_t getMaxFreeBlockSize();
    uint32_t getMaxAllocHeap() { return getMaxFreeBlockSize(); }
};
extern Chip ESP;

unsigned long millis();
unsigned long micros();
void delay(unsigned long ms);
void delayMicroseconds(unsigned int us);
void pinMode(uint8_t pin, uint8_t mode);
void digitalWrite(uint8_t pin, uint8_t value);
int digitalRead(uint8_t pin);
int analogRead(uint8_t pin);
int digitalPinToInterrupt(int pin);
void attachInterruptArg(uint8_t pin, void (*handler)(void*), void* argument, int mode);
void configTime(long offset_s, int daylight_s, const char* server);
uint32_t esp_random();
uint32_t firmware_number();  // of the image that runs: the tests give FOGNAV_FIRMWARE_NUMBER as this
void enableLoopWDT();

void setup();
void loop();
