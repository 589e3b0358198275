// An update over the air: offered by a message, signed, fetched in small pieces between two measurements. Nothing is
// fetched before the signature is found good, and nothing is started before what came has the hash that was signed.
#pragma once

#include <stddef.h>
#include <stdint.h>

#include "fognav_contract.h"

namespace fognav {

constexpr size_t kHashSize = 32;  // SHA-256
constexpr size_t kUrlSize = FOGNAV_NODE_UPDATE_URL_LENGTH_MAX + 1;
constexpr size_t kSignatureMax = FOGNAV_NODE_UPDATE_SIGNATURE_LENGTH_MAX / 2;
constexpr size_t kSignedTextSize = 192;

struct UpdateOffer {
    uint32_t number = 0;  // of the firmware: it only grows
    char board[FOGNAV_ID_MAX + 1] = "";
    uint32_t size = 0;  // bytes
    uint8_t hash[kHashSize] = {};
    uint8_t signature[kSignatureMax] = {};  // ECDSA, ASN.1
    size_t signature_size = 0;
    char url[kUrlSize] = "";
};

// Read an offer from JSON. Return nullptr, or what is wrong with it; `offer` then holds what was read so far.
const char* read_update(const char* text, size_t size, UpdateOffer& offer);

// What is signed: a few lines of text, so that `openssl dgst -sha256 -sign` can do it. Returns its length.
size_t signed_text(const UpdateOffer& offer, char* buffer, size_t size);

// What the board does for an update.
class UpdateBoard {
public:
    // Whether the maker has signed this text.
    virtual bool signature_is_good(const char* text, size_t size, const uint8_t* signature, size_t signature_size) = 0;

    // Begin to fetch; false if nobody answers, or answers with another size.
    virtual bool open(const char* url, uint32_t size) = 0;

    // Fetch what has come, without waiting: the number of bytes, 0 if there is nothing yet, -1 after a loss.
    virtual int fetch(uint8_t* buffer, size_t size) = 0;
    virtual void close() = 0;

    // Prepare the flash for so many bytes, write to it, and start from it at the next reset. What is abandoned was not
    // written as a whole.
    virtual bool begin_flash(uint32_t size) = 0;
    virtual bool write_flash(const uint8_t* data, size_t size) = 0;
    virtual bool commit_flash() = 0;
    virtual void abandon_flash() = 0;

    virtual void begin_hash() = 0;
    virtual void add_to_hash(const uint8_t* data, size_t size) = 0;
    virtual void end_hash(uint8_t (&hash)[kHashSize]) = 0;

    // Keep the number of what was installed, over resets.
    virtual void remember(uint32_t number) = 0;
    virtual void restart() = 0;

protected:
    ~UpdateBoard() = default;
};

constexpr uint32_t kFetchTimeoutMs = 30000;  // without a byte
constexpr uint32_t kRetryAfterMs = 300000;
constexpr int kUpdateAttempts = 3;  // of one offer, until the node starts anew
constexpr size_t kPieceSize = 512;  // fetched in one step

class Updater {
public:
    // `number` is that of the running firmware, `remembered` the last one installed: the higher one counts, so that an
    // image that calls itself older than it was signed is not installed again and again.
    Updater(UpdateBoard& port, const char* board, uint32_t number, uint32_t remembered)
        : port_(port), board_(board), running_(number), number_(number > remembered ? number : remembered) {}

    // Take an offer (JSON); return nullptr, or why it is refused. An offer of what runs already is neither taken nor refused, nor
    // is the offer again that was taken last; another one replaces that, even while it is fetched. An empty text withdraws it.
    const char* offer(const char* text, size_t size, uint32_t now_ms);

    // Go on; call it in every turn of the loop (millis(), 32 bits that wrap). Return nullptr, or why the update failed.
    const char* step(uint32_t now_ms);

    bool busy() const { return phase_ != Phase::idle; }

private:
    enum class Phase : uint8_t { idle, due, fetching };

    void withdraw();
    const char* begin(uint32_t now_ms);
    const char* fetch(uint32_t now_ms);
    bool hash_is_right();
    const char* finish();
    const char* fail(const char* problem, uint32_t now_ms);

    UpdateBoard& port_;
    const char* board_;
    uint32_t running_;
    uint32_t number_;
    UpdateOffer offer_;  // the last one taken: one that is refused does not count
    Phase phase_ = Phase::idle;
    uint32_t since_ms_ = 0;  // of the last byte, or of the failure
    uint32_t wait_ms_ = 0;
    uint32_t fetched_ = 0;
    int attempts_ = 0;
};

}  // namespace fognav
