// Set-up and update as a C library for their tests: the portal's form and button, messages in parts, and an update whose
// board is a table of the test's functions.
#include <string.h>

#include "inbox.hpp"
#include "portal.hpp"
#include "update.hpp"

namespace {

// A form as pairs of name and value, ended by a null pointer.
struct TestForm final : fognav::Form {
    explicit TestForm(const char* const* pairs) : fields(pairs) {}
    const char* field(const char* name) const override {
        for (const char* const* at = fields; *at != nullptr; at += 2) {
            if (strcmp(*at, name) == 0) return at[1];
        }
        return nullptr;
    }
    const char* const* fields;
};

struct Functions {
    int (*signature_is_good)(const char* text, uint32_t size, const uint8_t* signature, uint32_t signature_size);
    int (*open)(const char* url, uint32_t size);
    int (*fetch)(uint8_t* buffer, uint32_t size);
    void (*close)();
    int (*begin_flash)(uint32_t size);
    int (*write_flash)(const uint8_t* data, uint32_t size);
    int (*commit_flash)();
    void (*abandon_flash)();
    void (*begin_hash)();
    void (*add_to_hash)(const uint8_t* data, uint32_t size);
    void (*end_hash)(uint8_t* hash);
    void (*remember)(uint32_t number);
    void (*restart)();
};

struct TestBoard final : fognav::UpdateBoard {
    explicit TestBoard(const Functions& table) : call(table) {}
    bool signature_is_good(const char* text, size_t size, const uint8_t* signature, size_t length) override {
        return call.signature_is_good(text, static_cast<uint32_t>(size), signature, static_cast<uint32_t>(length)) != 0;
    }
    bool open(const char* url, uint32_t size) override { return call.open(url, size) != 0; }
    int fetch(uint8_t* buffer, size_t size) override { return call.fetch(buffer, static_cast<uint32_t>(size)); }
    void close() override { call.close(); }
    bool begin_flash(uint32_t size) override { return call.begin_flash(size) != 0; }
    bool write_flash(const uint8_t* data, size_t size) override {
        return call.write_flash(data, static_cast<uint32_t>(size)) != 0;
    }
    bool commit_flash() override { return call.commit_flash() != 0; }
    void abandon_flash() override { call.abandon_flash(); }
    void begin_hash() override { call.begin_hash(); }
    void add_to_hash(const uint8_t* data, size_t size) override { call.add_to_hash(data, static_cast<uint32_t>(size)); }
    void end_hash(uint8_t (&hash)[fognav::kHashSize]) override { call.end_hash(hash); }
    void remember(uint32_t number) override { call.remember(number); }
    void restart() override { call.restart(); }
    Functions call;
};

struct TestUpdater {
    TestUpdater(const Functions& table, uint32_t number, uint32_t remembered)
        : board(table), updater(board, fognav::kD1Mini.name, number, remembered) {}
    TestBoard board;
    fognav::Updater updater;
};

}  // namespace

extern "C" {

// nullptr and node.json in `buffer`, or what is wrong with the form; `before` is the node.json that the node has.
const char* fognav_form_settings(const char* const* pairs, const char* before, char* buffer, uint32_t size) {
    fognav::Settings settings;
    buffer[0] = 0;
    return fognav::settings_from_form(TestForm(pairs), before, fognav::kD1Mini, buffer, size, settings);
}

const char* fognav_authority_problem(const char* pem, int tls) {
    fognav::Settings settings;
    settings.tls = tls != 0;
    return fognav::authority_problem(pem, settings);
}

const char* fognav_portal_page() { return fognav::kPortalPage; }

void fognav_portal_name(uint32_t chip, char* name) {
    char buffer[16];
    fognav::portal_name(chip, buffer);
    strcpy(name, buffer);
}

fognav::PortalSwitch* fognav_portal_new(int has_settings) { return new fognav::PortalSwitch(has_settings != 0); }
void fognav_portal_free(fognav::PortalSwitch* portal) { delete portal; }
void fognav_portal_request(fognav::PortalSwitch* portal, uint32_t now_ms) { portal->on_request(now_ms); }
int fognav_portal_step(fognav::PortalSwitch* portal, int pressed, uint32_t now_ms) {
    portal->step(pressed != 0, now_ms);
    return portal->open() ? 1 : 0;
}

fognav::Inbox* fognav_inbox_new(const char* site, const char* node) {
    auto* inbox = new fognav::Inbox;
    inbox->begin(site, node);
    return inbox;
}
void fognav_inbox_free(fognav::Inbox* inbox) { delete inbox; }

// The topic of a message that is now complete (0: config, 1: command, 2: update) with its text, or -1.
int fognav_inbox_take(fognav::Inbox* inbox, const char* topic, const uint8_t* part, uint32_t length, uint32_t index,
                      uint32_t total, char* text, uint32_t* size) {
    if (!inbox->take(topic, part, length, index, total)) return -1;
    memcpy(text, inbox->text(), inbox->size());
    *size = static_cast<uint32_t>(inbox->size());
    return static_cast<int>(inbox->received());
}

TestUpdater* fognav_updater_new(const Functions* table, uint32_t number, uint32_t remembered) {
    return new TestUpdater(*table, number, remembered);
}
void fognav_updater_free(TestUpdater* test) { delete test; }
const char* fognav_updater_offer(TestUpdater* test, const char* text, uint32_t size, uint32_t now_ms) {
    return test->updater.offer(text, size, now_ms);
}
const char* fognav_updater_step(TestUpdater* test, uint32_t now_ms) { return test->updater.step(now_ms); }
int fognav_updater_busy(const TestUpdater* test) { return test->updater.busy() ? 1 : 0; }

}  // extern "C"
