// A stand-in for the ESP32's watchdog of tasks.
#pragma once

#include "Arduino.h"

void esp_task_wdt_init(uint32_t timeout_s, bool panic);
