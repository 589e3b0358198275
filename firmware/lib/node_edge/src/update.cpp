#include "update.hpp"

#include <stdio.h>
#include <string.h>

#include "hexadecimal.hpp"
#include "in_flash.hpp"
#include "json_reader.hpp"

namespace fognav {

namespace {

constexpr int64_t kMilli = 1000;

bool is(const char* key, size_t length, const char* field) {
    return strlen(field) == length && memcmp(key, field, length) == 0;
}

class OfferReader {
public:
    explicit OfferReader(UpdateOffer& offer) : offer_(offer) {}

    const char* read(const char* text, size_t size) {
        JsonReader json(text, size);
        const char* key = nullptr;
        size_t length = 0;
        if (json.begin_object()) {
            while (json.next_member(key, length)) member(json, key, length);
        }
        if (!json.at_end()) return IN_FLASH("the update is not a JSON object, or a member has the wrong type or is too long");
        if (problem_ != nullptr) return problem_;
        const bool complete = offer_.number != 0 && offer_.board[0] != 0 && offer_.size != 0 && has_hash_ &&
                              offer_.signature_size != 0 && offer_.url[0] != 0;
        return complete ? nullptr : IN_FLASH("the update lacks its number, board, size, sha256, signature or url");
    }

private:
    void member(JsonReader& json, const char* key, size_t length) {
        if (is(key, length, FOGNAV_NODE_UPDATE_NUMBER_FIELD)) {
            offer_.number = number(json, FOGNAV_NODE_UPDATE_NUMBER_MAX);
        } else if (is(key, length, FOGNAV_NODE_UPDATE_BOARD_FIELD)) {
            json.text(offer_.board, sizeof offer_.board);
        } else if (is(key, length, FOGNAV_NODE_UPDATE_SIZE_FIELD)) {
            offer_.size = number(json, FOGNAV_NODE_UPDATE_SIZE_MAX);
        } else if (is(key, length, FOGNAV_NODE_UPDATE_SHA256_FIELD)) {
            char text[2 * kHashSize + 1];
            if (!json.text(text, sizeof text)) return;
            has_hash_ = bytes(text, offer_.hash, kHashSize) == static_cast<int>(kHashSize);
            if (!has_hash_) problem_ = IN_FLASH("the update's sha256 is not 64 hexadecimal digits");
        } else if (is(key, length, FOGNAV_NODE_UPDATE_SIGNATURE_FIELD)) {
            char text[2 * kSignatureMax + 1];
            if (!json.text(text, sizeof text)) return;
            const int found = bytes(text, offer_.signature, kSignatureMax);
            if (found < 0) problem_ = IN_FLASH("the update's signature is not made of hexadecimal digits");
            offer_.signature_size = found < 0 ? 0 : static_cast<size_t>(found);
        } else if (is(key, length, FOGNAV_NODE_UPDATE_URL_FIELD)) {
            json.text(offer_.url, sizeof offer_.url);
        } else {
            json.skip_value();
        }
    }

    uint32_t number(JsonReader& json, int64_t most) {
        int64_t milli = 0;
        if (!json.number_milli(milli)) return 0;
        if (milli % kMilli == 0 && milli > 0 && milli / kMilli <= most) return static_cast<uint32_t>(milli / kMilli);
        problem_ = IN_FLASH("the update's number or size is not a whole number in its limits");
        return 0;
    }

    UpdateOffer& offer_;
    const char* problem_ = nullptr;
    bool has_hash_ = false;
};

bool is_same(const UpdateOffer& a, const UpdateOffer& b) {
    return a.number == b.number && a.size == b.size && memcmp(a.hash, b.hash, kHashSize) == 0 && strcmp(a.url, b.url) == 0;
}

}  // namespace

const char* read_update(const char* text, size_t size, UpdateOffer& offer) {
    // A temporary would be a second one on the stack.
    static constexpr UpdateOffer kFresh FLASH_SECTION = {};
    offer = kFresh;
    return OfferReader(offer).read(text, size);
}

size_t signed_text(const UpdateOffer& offer, char* buffer, size_t size) {
    char hash[2 * kHashSize + 1];
    for (size_t i = 0; i < kHashSize; ++i) snprintf(hash + 2 * i, 3, "%02x", offer.hash[i]);
    const int length = snprintf(buffer, size, IN_FLASH("fognav-firmware\n%s\n%lu\n%lu\n%s\n"), offer.board,
                                static_cast<unsigned long>(offer.number), static_cast<unsigned long>(offer.size), hash);
    return static_cast<size_t>(length);
}

const char* Updater::offer(const char* text, size_t size, uint32_t now_ms) {
    if (size == 0) {
        withdraw();
        return nullptr;
    }
    UpdateOffer found;
    const char* problem = read_update(text, size, found);
    if (problem != nullptr) return problem;
    if (found.number == running_) return nullptr;
    // The broker delivers it again with each connection: what is under way goes on, and what has failed is not tried anew.
    if (is_same(found, offer_)) return nullptr;
    if (found.number == number_) {
        return IN_FLASH("the update was installed and did not stay: it never reached the broker, or has another number in itself; "
               "sign one with a higher number");
    }
    if (found.number < number_) return IN_FLASH("the update is older than what runs: sign one with a higher number");
    if (strcmp(found.board, board_) != 0) return IN_FLASH("the update is for another board");
    char signed_lines[kSignedTextSize];
    const size_t length = signed_text(found, signed_lines, sizeof signed_lines);
    if (!port_.signature_is_good(signed_lines, length, found.signature, found.signature_size)) {
        return IN_FLASH("the update is not signed by the key in update_key of node.json");
    }
    withdraw();
    offer_ = found;
    attempts_ = 0;
    wait_ms_ = 0;
    since_ms_ = now_ms;
    phase_ = Phase::due;
    return nullptr;
}

void Updater::withdraw() {
    if (phase_ == Phase::fetching) {
        port_.close();
        port_.abandon_flash();
    }
    phase_ = Phase::idle;
    offer_ = UpdateOffer();
}

const char* Updater::step(uint32_t now_ms) {
    switch (phase_) {
        case Phase::idle:
            return nullptr;
        case Phase::due:
            return now_ms - since_ms_ < wait_ms_ ? nullptr : begin(now_ms);
        case Phase::fetching:
            break;
    }
    return fetch(now_ms);
}

const char* Updater::begin(uint32_t now_ms) {
    ++attempts_;
    phase_ = Phase::fetching;
    fetched_ = 0;
    since_ms_ = now_ms;
    if (!port_.open(offer_.url, offer_.size)) return fail(IN_FLASH("the update's url does not answer with its size"), now_ms);
    port_.begin_hash();
    return port_.begin_flash(offer_.size) ? nullptr : fail(IN_FLASH("the update is too large for the flash"), now_ms);
}

const char* Updater::fetch(uint32_t now_ms) {
    uint8_t piece[kPieceSize];
    const uint32_t missing = offer_.size - fetched_;
    const int count = port_.fetch(piece, missing < kPieceSize ? missing : kPieceSize);
    if (count < 0) return fail(IN_FLASH("the connection to the update's url was lost"), now_ms);
    if (count == 0) {
        const bool lost = now_ms - since_ms_ >= kFetchTimeoutMs;
        return lost ? fail(IN_FLASH("the update's url has sent nothing for 30 s"), now_ms) : nullptr;
    }
    since_ms_ = now_ms;
    port_.add_to_hash(piece, static_cast<size_t>(count));
    fetched_ += static_cast<uint32_t>(count);
    const bool last = fetched_ == offer_.size;
    // The last piece is not written before the hash is right: a board takes a flash that is complete for an image to start.
    if (last && !hash_is_right()) return fail(IN_FLASH("what the update's url sent is not what was signed"), now_ms);
    if (!port_.write_flash(piece, static_cast<size_t>(count))) return fail(IN_FLASH("the flash can't be written"), now_ms);
    if (!last) return nullptr;
    port_.close();
    return finish();
}

bool Updater::hash_is_right() {
    uint8_t hash[kHashSize];
    port_.end_hash(hash);
    return memcmp(hash, offer_.hash, kHashSize) == 0;
}

const char* Updater::finish() {
    phase_ = Phase::idle;
    // Before the commit: a board that is reset in between keeps what runs, and takes the next number.
    port_.remember(offer_.number);
    number_ = offer_.number;
    if (!port_.commit_flash()) return IN_FLASH("the board refuses the update: it is not for this board or this size of flash");
    port_.restart();
    return nullptr;
}

const char* Updater::fail(const char* problem, uint32_t now_ms) {
    port_.close();
    port_.abandon_flash();
    since_ms_ = now_ms;
    wait_ms_ = kRetryAfterMs;
    phase_ = attempts_ < kUpdateAttempts ? Phase::due : Phase::idle;
    return problem;
}

}  // namespace fognav
