#include "update_board.hpp"

#if defined(ESP8266)
#include <Updater.h>
#else
#include <Update.h>
#include <esp_ota_ops.h>

// The core asks before `setup` whether it shall leave a new image on trial.
extern "C" bool verifyRollbackLater() { return true; }
#endif

#include <stdlib.h>

#include "files.hpp"
#include "in_flash.hpp"

namespace fognav {

namespace {

constexpr uint16_t kAnswerMs = 3000;  // the node does not measure while it waits for the first answer

}  // namespace

uint32_t remembered_update() { return static_cast<uint32_t>(strtoul(read_file(kUpdateFile, 16).c_str(), nullptr, 10)); }

void keep_image() {
#if defined(ESP32)
    esp_ota_mark_app_valid_cancel_rollback();
#endif
}

bool FlashBoard::signature_is_good(const char* text, size_t size, const uint8_t* signature, size_t signature_size) {
    return settings_.updates && verify(settings_.update_key, kUpdateKeySize, text, size, signature, signature_size);
}

bool FlashBoard::open(const char* url, uint32_t size) {
    http_.setTimeout(kAnswerMs);
    http_.setReuse(false);
#if defined(ESP32)
    http_.setConnectTimeout(kAnswerMs);
#endif
    // Not encrypted: what comes is checked against a hash that is signed.
    return http_.begin(client_, url) && http_.GET() == HTTP_CODE_OK && http_.getSize() == static_cast<int>(size);
}

int FlashBoard::fetch(uint8_t* buffer, size_t size) {
    // The ESP8266's client is connected with a copy of what it was given.
    WiFiClient* client = http_.getStreamPtr();
    if (client == nullptr) return -1;
    const int available = client->available();
    if (available <= 0) return client->connected() ? 0 : -1;
    return client->read(buffer, size < static_cast<size_t>(available) ? size : static_cast<size_t>(available));
}

bool FlashBoard::begin_flash(uint32_t size) { return Update.begin(size); }

bool FlashBoard::write_flash(const uint8_t* data, size_t size) {
    return Update.write(const_cast<uint8_t*>(data), size) == size;  // its interface forgot the const
}

bool FlashBoard::commit_flash() { return Update.end(); }

// Ending before all was written discards it; ending after that would start it.
void FlashBoard::abandon_flash() { Update.end(); }

void FlashBoard::remember(uint32_t number) {
    char text[12];
    snprintf(text, sizeof text, "%lu", static_cast<unsigned long>(number));
    if (!write_file(kUpdateFile, text)) Serial.printf(IN_FLASH("the number of the update can't be stored: the flash is full\n"));
}

}  // namespace fognav
