#include "broker_transport.hpp"

#include "fognav_contract.h"
#include "in_flash.hpp"

namespace fognav {

namespace {

// Each step of connecting may take so long. The node measures nothing meanwhile.
constexpr uint32_t kStepMs = 5000;
#if defined(ESP8266)
// A record of TLS that comes and one that goes: instead of the 16 KB that the core takes, which an ESP8266 has not. The broker
// is asked to send no longer ones (RFC 6066, maximum fragment length); of ours, messages to a node are shorter anyway.
constexpr int kReceiveSize = 2048;
constexpr int kSendSize = 512;
#endif

bool look_up(const char* host, IPAddress& address) {
#if defined(ESP8266)
    return WiFi.hostByName(host, address, kStepMs) == 1;
#else
    return WiFi.hostByName(host, address) == 1;
#endif
}

void say_unreachable(const char* host, uint16_t port) {
    Serial.printf(IN_FLASH("nobody answers at %s, port %u: is it the fog node's address, and does its broker run?\n"), host,
                  static_cast<unsigned>(port));
}

void say_not_trusted(const char* reason, const char* name) {
    Serial.printf(IN_FLASH("TLS with the broker failed: %s\n  Is ca.pem that of the fog node's authority (fognav node replace), and "
                  "is its certificate for %s (fognav ca issue)?\n"),
                  reason, name);
}

}  // namespace

bool BrokerTransport::connect(const char* host, uint16_t port) {
    IPAddress address;
    reached_ = false;
    if (address.fromString(host)) return reach(host, address, port);
    if (look_up(host, address)) {
        reached_ = open(host, address, port, host);
        return reached_;
    }
    Serial.printf(IN_FLASH("the name %s is not known in this network: give broker the fog node's address in node.json\n"), host);
    return false;
}

bool BrokerTransport::reach(const char* host, IPAddress address, uint16_t port) {
    // BearSSL and Mbed TLS compare a certificate's names with what they are told, never its addresses.
    reached_ = open(host, address, port, FOGNAV_BROKER_NAME);
    return reached_;
}

bool PlainTransport::open(const char* host, IPAddress address, uint16_t port, const char*) {
#if defined(ESP8266)
    plain_.setTimeout(kStepMs);
    const bool open = plain_.connect(address, port) != 0;
#else
    const bool open = plain_.connect(address, port, static_cast<int32_t>(kStepMs)) != 0;
#endif
    if (open) {
        plain_.setNoDelay(true);
    } else {
        say_unreachable(host, port);
    }
    return open;
}

#if defined(ESP8266)

TlsTransport::TlsTransport(const char* authority) : BrokerTransport(secure_), trusted_(authority) {
    if (trusted_.getCount() == 0) Serial.printf(IN_FLASH("ca.pem can't be read: paste the whole file of the fog node's authority\n"));
    secure_.setTrustAnchors(&trusted_);
    secure_.setBufferSizes(kReceiveSize, kSendSize);
}

bool TlsTransport::open(const char* host, IPAddress address, uint16_t port, const char* name) {
    secure_.setTimeout(kStepMs);
    if (!secure_.WiFiClient::connect(address, port)) {
        say_unreachable(host, port);
        return false;
    }
    if (secure_.greet(name)) {
        secure_.setNoDelay(true);
        return true;
    }
    char reason[96];
    secure_.getLastSSLError(reason, sizeof reason);
    say_not_trusted(reason, name);
    secure_.stop();
    return false;
}

#else

TlsTransport::TlsTransport(const char* authority) : BrokerTransport(secure_), trusted_(authority) {
    secure_.setCACert(authority);
    secure_.setTimeout(kStepMs / 1000);
    secure_.setHandshakeTimeout(kStepMs / 1000);
}

bool TlsTransport::open(const char* host, IPAddress address, uint16_t port, const char* name) {
    if (secure_.connect(address, port, name, trusted_, nullptr, nullptr) != 0) return true;
    char reason[96] = "";
    // -1 is not an error of TLS: the client did not come so far.
    if (secure_.lastError(reason, sizeof reason) == -1) {
        say_unreachable(host, port);
    } else {
        say_not_trusted(reason, name);
    }
    return false;
}

#endif

}  // namespace fognav
