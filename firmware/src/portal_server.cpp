#include "portal_server.hpp"

#include "files.hpp"
#include "in_flash.hpp"
#include "scratch.hpp"

namespace fognav {

namespace {

constexpr uint16_t kDnsPort = 53;
constexpr uint32_t kAnswerMs = 1000;  // until the answer has left, before the restart
static_assert(sizeof scratch > kSettingsMax, "settings may not fit");

}  // namespace

void PortalServer::begin() {
    char name[16];
    portal_name(chip_number(), name);
    WiFi.persistent(false);
    WiFi.mode(WIFI_AP);
    WiFi.softAP(name);
    names_.start(kDnsPort, "*", WiFi.softAPIP());
    server_.on("/", [this] {
        portal_.on_request(millis());
        server_.send_P(200, "text/html", kPortalPage);
    });
    server_.on("/settings", HTTP_POST, [this] { submit(); });
    // Phones ask for pages of their makers, and show what they get instead as the place to log in.
    server_.onNotFound([this] {
        server_.sendHeader("Location", "http://192.168.4.1/");
        server_.send(302, "text/plain", "");
    });
    server_.begin();
    Serial.printf(IN_FLASH("set-up: join the network %s and open http://192.168.4.1/\n"), name);
}

void PortalServer::loop() {
    names_.processNextRequest();
    server_.handleClient();
}

const char* PortalServer::field(const char* name) const {
    field_ = server_.arg(name);
    return field_.c_str();
}

// nullptr, or why nothing was saved.
const char* PortalServer::save() {
    const char* problem = nullptr;
    {
        const String before = read_file(kSettingsFile, kSettingsMax);
        if (portal_.has_settings() && before.length() == 0) return IN_FLASH("there is too little memory: restart the node, and try again");
        problem = settings_from_form(*this, before.c_str(), kBoard, scratch, kSettingsMax + 1, settings_);
    }
    if (problem != nullptr) return problem;
    // A whole file may be another site's, which has another one.
    if (!had_authority_ || *field("authority") != 0 || *field("provisioning") != 0) {
        problem = authority_problem(field("authority"), settings_);
        if (problem != nullptr) return problem;
        if (settings_.tls && !write_file(kAuthorityFile, field("authority"))) return "the flash is full";
    }
    if (calibrated_mark(settings_) != mark_) remove_file(kCalibrationFile);
    // Last: only with it the node counts as set up.
    return write_file(kSettingsFile, scratch) ? nullptr : "the flash is full";
}

void PortalServer::submit() {
    portal_.on_request(millis());
    const char* problem = save();
    if (problem != nullptr) {
        server_.send(400, "text/plain", problem);
        return;
    }
    server_.send(200, "text/plain", IN_FLASH("Saved. The node restarts and joins your network."));
    delay(kAnswerMs);
    ESP.restart();
}

}  // namespace fognav
