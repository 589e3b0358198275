#include "signature.hpp"

#if defined(ESP8266)
#include <StackThunk.h>

// BearSSL's arithmetic takes 5.9 KB of stack, and the loop has 4 KB: as the core's TLS does, it runs on the core's second one.
make_stack_thunk(br_ecdsa_i15_vrfy_asn1);
extern "C" uint32_t thunk_br_ecdsa_i15_vrfy_asn1(const br_ec_impl*, const void*, size_t, const br_ec_public_key*, const void*,
                                                 size_t);
#else
#include <mbedtls/ecdsa.h>
#endif

namespace fognav {

#if defined(ESP8266)

Sha256::Sha256() { br_sha256_init(&context_); }
void Sha256::add(const void* data, size_t size) { br_sha256_update(&context_, data, size); }
void Sha256::end(uint8_t (&hash)[32]) { br_sha256_out(&context_, hash); }

bool verify(const uint8_t* key, size_t key_size, const void* text, size_t size, const uint8_t* signature,
            size_t signature_size) {
    uint8_t hash[32];
    Sha256 sha;
    sha.add(text, size);
    sha.end(hash);
    // BearSSL does not write to the key, although its structure could.
    const br_ec_public_key point = {BR_EC_secp256r1, const_cast<unsigned char*>(key), key_size};
    stack_thunk_add_ref();
    const bool good =
        thunk_br_ecdsa_i15_vrfy_asn1(&br_ec_p256_m15, hash, sizeof hash, &point, signature, signature_size) == 1;
    stack_thunk_del_ref();
    return good;
}

#else

Sha256::Sha256() {
    mbedtls_sha256_init(&context_);
    mbedtls_sha256_starts_ret(&context_, 0);
}
void Sha256::add(const void* data, size_t size) {
    mbedtls_sha256_update_ret(&context_, static_cast<const unsigned char*>(data), size);
}
void Sha256::end(uint8_t (&hash)[32]) {
    mbedtls_sha256_finish_ret(&context_, hash);
    mbedtls_sha256_free(&context_);
}

bool verify(const uint8_t* key, size_t key_size, const void* text, size_t size, const uint8_t* signature,
            size_t signature_size) {
    uint8_t hash[32];
    Sha256 sha;
    sha.add(text, size);
    sha.end(hash);
    mbedtls_ecdsa_context context;
    mbedtls_ecdsa_init(&context);
    const bool good = mbedtls_ecp_group_load(&context.grp, MBEDTLS_ECP_DP_SECP256R1) == 0 &&
                      mbedtls_ecp_point_read_binary(&context.grp, &context.Q, key, key_size) == 0 &&
                      mbedtls_ecp_check_pubkey(&context.grp, &context.Q) == 0 &&
                      mbedtls_ecdsa_read_signature(&context, hash, sizeof hash, signature, signature_size) == 0;
    mbedtls_ecdsa_free(&context);
    return good;
}

#endif

}  // namespace fognav
