// Texts that stay in the flash of an ESP8266, whose linker else copies them into the RAM. They are read byte by byte like others:
// the core has a handler for that (slow, some microseconds a byte) with the second heap that platformio.ini asks for.
#pragma once

#if defined(ESP8266)
#define FLASH_SECTION __attribute__((section(".irom.text.texts")))
#define IN_FLASH(text)                                          \
    (__extension__({                                            \
        static const char in_flash[] FLASH_SECTION = text;      \
        &in_flash[0];                                           \
    }))
#else
#define FLASH_SECTION
#define IN_FLASH(text) text
#endif
