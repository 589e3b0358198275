// The set-up portal on the board: its own network, on which every name leads to its page.
#pragma once

#include <DNSServer.h>

#include "board.hpp"

#if defined(ESP8266)
#include <ESP8266WebServer.h>
#else
#include <WebServer.h>
#endif

#include "portal.hpp"

namespace fognav {

class PortalServer final : Form {
public:
    // `settings` receives what is typed: the node restarts then, or when the portal closes.
    PortalServer(PortalSwitch& portal, Settings& settings)
        : portal_(portal), settings_(settings), had_authority_(portal.has_settings() && settings.tls), mark_(calibrated_mark(settings)) {}

    void begin();
    void loop();

    const char* field(const char* name) const override;

private:
    void submit();
    const char* save();

#if defined(ESP8266)
    using Server = ESP8266WebServer;
#else
    using Server = WebServer;
#endif
    PortalSwitch& portal_;
    Settings& settings_;
    const bool had_authority_;  // in its file
    const uint32_t mark_;       // of the settings of before
    DNSServer names_;
    mutable Server server_{80};
    mutable String field_;  // what `field` returned last
};

}  // namespace fognav
