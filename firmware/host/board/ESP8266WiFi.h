// A stand-in for the radio of the ESP8266, and for its TLS.
#pragma once

#include "WiFi.h"

namespace BearSSL {
struct X509List {
    explicit X509List(const char* pem);
    size_t getCount() const { return count; }
    size_t count;
};

// The second stack is taken when one comes to be, the buffers with each connection. A certificate is compared with a name, never
// with an address, and with nothing when there is no name.
class WiFiClientSecureCtx : public WiFiClient {
public:
    WiFiClientSecureCtx();
    int connect(IPAddress address, uint16_t port) override;
    void stop() override;
    void setTrustAnchors(const X509List*) { printf("trust\n"); }
    void setBufferSizes(int receive, int send) {
        receive_size_ = receive;
        send_size_ = send;
    }
    int getLastSSLError(char* text, size_t size);

protected:
    bool _connectSSL(const char* name);

private:
    int receive_size_ = 16384;
    int send_size_ = 512;
    size_t taken_ = 0;
    const char* error_ = nullptr;
};
}  // namespace BearSSL
