// What an update needs of the board: HTTP, flash, hash, and the key of the settings.
#pragma once

#include "board.hpp"

#if defined(ESP8266)
#include <ESP8266HTTPClient.h>
#else
#include <HTTPClient.h>
#endif

#include "settings.hpp"
#include "signature.hpp"
#include "update.hpp"

namespace fognav {

// The number of the last update that was installed, 0 without one.
uint32_t remembered_update();

// What runs has reached the broker: an ESP32 keeps it. Before that its next start, whatever the cause, goes back to the image of
// before. The boot loader of an ESP8266 can't.
void keep_image();

class FlashBoard final : public UpdateBoard {
public:
    explicit FlashBoard(const Settings& settings) : settings_(settings) {}

    bool signature_is_good(const char* text, size_t size, const uint8_t* signature, size_t signature_size) override;
    bool open(const char* url, uint32_t size) override;
    int fetch(uint8_t* buffer, size_t size) override;
    void close() override { http_.end(); }
    bool begin_flash(uint32_t size) override;
    bool write_flash(const uint8_t* data, size_t size) override;
    bool commit_flash() override;
    void abandon_flash() override;
    void begin_hash() override { hash_ = Sha256(); }
    void add_to_hash(const uint8_t* data, size_t size) override { hash_.add(data, size); }
    void end_hash(uint8_t (&hash)[kHashSize]) override { hash_.end(hash); }
    void remember(uint32_t number) override;
    void restart() override { ESP.restart(); }

private:
    const Settings& settings_;
    WiFiClient client_;
    HTTPClient http_;
    Sha256 hash_;
};

}  // namespace fognav
