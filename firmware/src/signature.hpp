// SHA-256 and signatures by the library that the board's core brings along: BearSSL or Mbed TLS.
#pragma once

#include <stddef.h>
#include <stdint.h>

#if defined(ESP8266)
#include <bearssl/bearssl.h>
#else
#include <mbedtls/sha256.h>
#endif

namespace fognav {

class Sha256 {
public:
    Sha256();
    void add(const void* data, size_t size);
    void end(uint8_t (&hash)[32]);

private:
#if defined(ESP8266)
    br_sha256_context context_;
#else
    mbedtls_sha256_context context_;
#endif
};

// Whether the text is signed (ECDSA with SHA-256, ASN.1) by the owner of a public key: a point of P-256, uncompressed.
bool verify(const uint8_t* key, size_t key_size, const void* text, size_t size, const uint8_t* signature,
            size_t signature_size);

}  // namespace fognav
