// A stand-in for the parts of the Arduino core that the firmware uses, so that it can be compiled without a board.
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
#define CHANGE 3
#define RANDOM_REG32 4u

class String : public std::string {
public:
    using std::string::string;
};

struct SerialPort {
    void begin(unsigned long) {}
    template <class... Arguments>
    void printf(const char* format, Arguments... arguments) {
        ::printf(format, arguments...);
    }
};
extern SerialPort Serial;

struct Chip {
    void restart();
};
extern Chip ESP;

unsigned long millis();
unsigned long micros();
void delay(unsigned long ms);
void delayMicroseconds(unsigned int us);
void pinMode(uint8_t pin, uint8_t mode);
void digitalWrite(uint8_t pin, uint8_t value);
int digitalRead(uint8_t pin);
int digitalPinToInterrupt(int pin);
void attachInterruptArg(uint8_t pin, void (*handler)(void*), void* argument, int mode);
void configTime(long offset_s, int daylight_s, const char* server);
uint32_t esp_random();
