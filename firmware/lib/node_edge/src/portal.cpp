#include "portal.hpp"

#include <stdio.h>
#include <string.h>

#include "in_flash.hpp"
#include "json_writer.hpp"

namespace fognav {

namespace {

constexpr const char* kTexts[] = {"site", "node", "wifi_name", "wifi_password", "broker", "user", "password"};

constexpr const char* kLimits[] = {"range_limit_m_0", "range_limit_m_1"};

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

// The sensors of the form, on the pins of the profile.
const char* write_sonars(const Form& form, JsonWriter& json) {
    int count = 0;
    json.key("sonars");
    json.begin_array();
    for (const char* field : kLimits) {
        const char* text = form.field(field);
        if (!given(text)) continue;
        const int32_t limit_mm = millimetres(text);
        if (limit_mm == 0) return IN_FLASH("a range limit is not in metres, such as 1.8");
        json.begin_object();
        json.key("range_limit_m");
        json.thousandths(limit_mm);
        json.end_object();
        ++count;
    }
    json.end_array();
    return count > 0 ? nullptr : IN_FLASH("the range limit of the first sensor is missing, in metres");
}

const char* write_fields(const Form& form, char* buffer, size_t size, size_t& length) {
    JsonWriter json(buffer, size);
    json.begin_object();
    for (const char* name : kTexts) {
        const char* text = form.field(name);
        if (!given(text)) continue;
        json.key(name);
        json.value(text);
    }
    const char* profile = form.field("profile");
    if (given(profile)) {
        json.key("profile");
        json.value(profile);
    }
    // A browser sends nothing for a box that is not ticked.
    json.key("tls");
    json.value(given(form.field("tls")));
    json.key("port");
    json.value(static_cast<uint64_t>(given(form.field("tls")) ? 8883 : 1883));
    const char* problem = write_sonars(form, json);
    if (problem != nullptr) return problem;
    json.end_object();
    length = json.finish();
    return length > 0 ? nullptr : IN_FLASH("the settings are too long: shorten the names and passwords");
}

}  // namespace

const char* settings_from_form(const Form& form, const BoardPins& board, char* buffer, size_t size, Settings& settings) {
    size_t length = 0;
    const char* provisioning = form.field("provisioning");
    if (given(provisioning)) {
        length = strlen(provisioning);
        if (length + 1 > size) return IN_FLASH("the provisioning file is longer than 2 KB");
        memcpy(buffer, provisioning, length + 1);
    } else {
        const char* problem = write_fields(form, buffer, size, length);
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
    "input[type=checkbox]{width:auto}</style><h1>Fognav node</h1><form method=post action=/settings>"
    "<label>Provisioning file (node.json), if you have one"
    "<textarea name=provisioning rows=4></textarea></label><h2>or</h2>"
    "<label>Site <input name=site></label><label>Node <input name=node></label>"
    "<label>Wi-Fi network <input name=wifi_name></label>"
    "<label>Wi-Fi password <input name=wifi_password type=password></label>"
    "<label>Broker <input name=broker placeholder=192.168.7.1></label><label>User <input name=user></label>"
    "<label>Password <input name=password type=password></label>"
    "<label><input name=tls type=checkbox value=1 checked> encrypted (TLS)</label>"
    "<label>Pins <select name=profile><option>standard<option>thesis</select></label>"
    "<label>Range limit of the first sensor, m <input name=range_limit_m_0></label>"
    "<label>of the second, if there is one <input name=range_limit_m_1></label><h2>and</h2>"
    "<label>Certificate of the broker's authority (ca.pem)<textarea name=authority rows=4></textarea></label>"
    "<button>Save and restart</button></form></html>";

}  // namespace fognav
