// The first set-up: a node without settings opens a network of its own, and a page on it takes them. A node that has
// settings never does so by itself (after a power cut it boots faster than the building's router, and must go on trying),
// only when somebody holds its button.
#pragma once

#include <stddef.h>
#include <stdint.h>

#include "settings.hpp"

namespace fognav {

// What somebody has filled in; nullptr for a field that is not there.
class Form {
public:
    virtual const char* field(const char* name) const = 0;

protected:
    ~Form() = default;
};

constexpr size_t kSettingsMax = 2048;   // bytes of node.json
constexpr size_t kAuthorityMax = 4096;  // bytes of ca.pem
constexpr uint32_t kHoldMs = 3000;      // how long the button is held
constexpr uint32_t kPortalMs = 600000;  // a portal that a button has opened closes after so long without a request

// Make node.json of a form: its field `provisioning` as it is, where there is one. Else of single fields: what is filled in
// replaces what `before` says, the node.json that the node has (one that is not valid counts as none), and all else of that
// stays; further sensors are on the board's pins. Return nullptr, its text and what it says, or what is wrong with it and what
// to do.
const char* settings_from_form(const Form& form, const char* before, const BoardPins& board, char* buffer, size_t size,
                               Settings& settings);

// nullptr, or what is wrong with a certificate of the broker's authority.
const char* authority_problem(const char* pem, const Settings& settings);

// The name of the portal's network: "fognav-" and the last digits of the chip's number.
void portal_name(uint32_t chip, char (&name)[16]);

// Whether a portal is open.
class PortalSwitch {
public:
    explicit PortalSwitch(bool has_settings) : has_settings_(has_settings), open_(!has_settings) {}

    // Take the button's level (millis(), 32 bits that wrap).
    void step(bool pressed, uint32_t now_ms);

    // Somebody uses the portal.
    void on_request(uint32_t now_ms) { used_ms_ = now_ms; }

    bool open() const { return open_; }

    // Whether the node has begun with settings that are valid.
    bool has_settings() const { return has_settings_; }

private:
    bool has_settings_;
    bool open_;
    bool pressed_ = false;
    uint32_t pressed_ms_ = 0;
    uint32_t used_ms_ = 0;
};

extern const char kPortalPage[];  // HTML

}  // namespace fognav
