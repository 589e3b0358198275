#include "portal.hpp"

#include <stdio.h>
#include <string.h>

#include "in_flash.hpp"
#include "json_reader.hpp"
#include "json_writer.hpp"

namespace fognav {

namespace {

constexpr const char* kTexts[] = {"site", "node", "wifi_name", "wifi_password", "broker", "user", "password", "profile"};

constexpr int kLimitCount = 2;
constexpr const char* kLimits[kLimitCount] = {"range_limit_m_0", "range_limit_m_1"};

// Metres as somebody types them, with up to three decimals: millimetres, or 0 for anything else.
int32_t millimetres(const char* text) {
    int32_t whole = 0;
    int digits = 0;
    for (; *text >= '0' && *text <= '9' && digits < 3; ++text, ++digits) whole = whole * 10 + (*text - '0');
    if (digits == 0) return 0;
    int32_t part = 0;
    int32_t scale = 1000;
    if (*text == '.' || *text == ',') {
        for (++text; *text >= '0' && *text <= '9' && scale > 1; ++text, scale /= 10) part = part * 10 + (*text - '0');
    }
    return *text == 0 ? whole * 1000 + part * scale : 0;
}

bool given(const char* text) { return text != nullptr && *text != 0; }

// Copies what a form leaves of the settings of before, and adds what is filled in.
class Merge {
public:
    Merge(const Form& form, const char* before, char* buffer, size_t size)
        : form_(form), before_(before, strlen(before)), json_(buffer, size) {}

    const char* write(size_t& length) {
        const char* key = nullptr;
        size_t size = 0;
        bool sonars = false;
        json_.begin_object();
        if (before_.begin_object()) {
            while (before_.next_member(key, size)) {
                if (is(key, size, "sonars")) {
                    write_sonars();
                    sonars = true;
                } else {
                    copy(key, replaced(key, size));
                }
            }
        }
        if (!sonars) write_sonars();
        for (const char* name : kTexts) {
            const char* text = form_.field(name);
            if (!given(text)) continue;
            json_.key(name);
            json_.value(text);
        }
        const char* tls = form_.field("tls");
        if (given(tls)) {
            const bool encrypted = strcmp(tls, "1") == 0;
            json_.key("tls");
            json_.value(encrypted);
            json_.key("port");
            json_.value(static_cast<uint64_t>(encrypted ? 8883 : 1883));
        }
        json_.end_object();
        if (problem_ != nullptr) return problem_;
        length = json_.finish();
        return length > 0 ? nullptr : IN_FLASH("the settings are too long: shorten the names and passwords");
    }

private:
    static bool is(const char* key, size_t length, const char* name) {
        return strlen(name) == length && memcmp(key, name, length) == 0;
    }

    // Whether the form says something else than a member. A password is that of its network or broker: another one may be
    // open, and is not told what opens the one before.
    bool replaced(const char* key, size_t length) const {
        if (is(key, length, "wifi_password") && given(form_.field("wifi_name"))) return true;
        static constexpr const char* kOfBroker[] = {"second_broker", "user", "password"};
        for (const char* name : kOfBroker) {
            if (is(key, length, name) && given(form_.field("broker"))) return true;
        }
        for (const char* name : kTexts) {
            if (is(key, length, name)) return given(form_.field(name));
        }
        return (is(key, length, "tls") || is(key, length, "port")) && given(form_.field("tls"));
    }

    void copy(const char* key, bool replaced) {
        before_.skip_value();
        const char* begin = key - 1;  // its quotation mark
        if (!replaced) json_.raw(begin, static_cast<size_t>(before_.position() - begin));
    }

    // The sensors of before, with the form's limits; then those that only the form has, on the pins of the profile.
    void write_sonars() {
        const char* key = nullptr;
        size_t size = 0;
        int count = 0;
        json_.key("sonars");
        json_.begin_array();
        if (before_.begin_array()) {
            for (; before_.next_element(); ++count) {
                const int32_t limit_mm = limit(count);
                json_.begin_object();
                if (before_.begin_object()) {
                    while (before_.next_member(key, size)) copy(key, limit_mm != 0 && is(key, size, "range_limit_m"));
                }
                write_limit(limit_mm);
                json_.end_object();
            }
        }
        bool any = count > 0;
        for (; count < kLimitCount; ++count) {
            const int32_t limit_mm = limit(count);
            if (limit_mm == 0) continue;
            json_.begin_object();
            write_limit(limit_mm);
            json_.end_object();
            any = true;
        }
        json_.end_array();
        if (!any) refuse(IN_FLASH("the range limit of the first sensor is missing, in metres"));
    }

    void write_limit(int32_t limit_mm) {
        if (limit_mm == 0) return;
        json_.key("range_limit_m");
        json_.thousandths(limit_mm);
    }

    // The limit that the form has for a sensor (mm); 0: none.
    int32_t limit(int sonar) {
        const char* text = sonar < kLimitCount ? form_.field(kLimits[sonar]) : nullptr;
        if (!given(text)) return 0;
        const int32_t limit_mm = millimetres(text);
        if (limit_mm == 0) refuse(IN_FLASH("a range limit is not in metres, such as 1.8"));
        return limit_mm;
    }

    void refuse(const char* problem) {
        if (problem_ == nullptr) problem_ = problem;
    }

    const Form& form_;
    JsonReader before_;
    JsonWriter json_;
    const char* problem_ = nullptr;
};

}  // namespace

const char* settings_from_form(const Form& form, const char* before, const BoardPins& board, char* buffer, size_t size,
                               Settings& settings) {
    size_t length = 0;
    const char* provisioning = form.field("provisioning");
    if (given(provisioning)) {
        length = strlen(provisioning);
        if (length + 1 > size) return IN_FLASH("the provisioning file is longer than 2 KB");
        memcpy(buffer, provisioning, length + 1);
    } else {
        const bool valid = read_settings(before, strlen(before), board, settings) == nullptr;
        const char* problem = Merge(form, valid ? before : "", buffer, size).write(length);
        if (problem != nullptr) return problem;
    }
    return read_settings(buffer, length, board, settings);
}

const char* authority_problem(const char* pem, const Settings& settings) {
    if (!settings.tls) return nullptr;
    if (!given(pem)) return IN_FLASH("ca.pem is missing: the certificate of the authority that signed the broker's");
    if (strlen(pem) > kAuthorityMax) return IN_FLASH("ca.pem is longer than 4 KB: it is one certificate, not a list of them");
    const bool whole =
        strstr(pem, "-----BEGIN CERTIFICATE-----") != nullptr && strstr(pem, "-----END CERTIFICATE-----") != nullptr;
    return whole ? nullptr : IN_FLASH("ca.pem is no certificate: it begins with -----BEGIN CERTIFICATE-----");
}

void portal_name(uint32_t chip, char (&name)[16]) {
    snprintf(name, sizeof name, "fognav-%06lx", static_cast<unsigned long>(chip & 0xFFFFFF));
}

void PortalSwitch::step(bool pressed, uint32_t now_ms) {
    if (pressed && !pressed_) pressed_ms_ = now_ms;
    pressed_ = pressed;
    if (!open_ && pressed && now_ms - pressed_ms_ >= kHoldMs) {
        open_ = true;
        used_ms_ = now_ms;
    }
    if (open_ && has_settings_ && now_ms - used_ms_ >= kPortalMs) open_ = false;
}

// Escapes: what somebody types is never put into the page.
const char kPortalPage[] FLASH_SECTION =
    "<!doctype html><html lang=en><meta charset=utf-8><meta name=viewport content='width=device-width'>"
    "<title>Fognav node</title><style>body{font:16px sans-serif;max-width:34em;margin:2em auto;padding:0 1em}"
    "label{display:block;margin:.6em 0}input,textarea,select{width:100%;box-sizing:border-box;font:inherit}"
    "</style><h1>Fognav node</h1><form method=post action=/settings>"
    "<label>Provisioning file (node.json), if you have one"
    "<textarea name=provisioning rows=4></textarea></label><h2>or</h2>"
    "<p>What is left empty stays as it is. A network or broker that is filled in has the user and password that are filled in "
    "with it, or none.</p>"
    "<label>Site <input name=site></label><label>Node <input name=node></label>"
    "<label>Wi-Fi network <input name=wifi_name></label>"
    "<label>Wi-Fi password <input name=wifi_password type=password></label>"
    "<label>Broker <input name=broker placeholder=192.168.7.1></label><label>User <input name=user></label>"
    "<label>Password <input name=password type=password></label>"
    "<label>Encrypted (TLS) <select name=tls><option value=''>as it is; a new node: yes<option value=1>yes"
    "<option value=0>no</select></label>"
    "<label>Pins <select name=profile><option value=''>as they are; a new node: standard<option>standard<option>thesis"
    "</select></label>"
    "<label>Range limit of the first sensor, m <input name=range_limit_m_0></label>"
    "<label>of the second, if there is one <input name=range_limit_m_1></label><h2>and</h2>"
    "<label>Certificate of the broker's authority (ca.pem)<textarea name=authority rows=4></textarea></label>"
    "<button>Save and restart</button></form></html>";

}  // namespace fognav
