// A stand-in for BearSSL where it is not installed: to compile against. No signature is good.
#pragma once

#include <stddef.h>
#include <stdint.h>

#define BR_EC_secp256r1 23

struct br_sha256_context {};
struct br_ec_impl {};
struct br_ec_public_key {
    int curve;
    unsigned char* q;
    size_t qlen;
};
extern const br_ec_impl br_ec_p256_m15;

inline void br_sha256_init(br_sha256_context*) {}
inline void br_sha256_update(br_sha256_context*, const void*, size_t) {}
inline void br_sha256_out(const br_sha256_context*, void*) {}
inline uint32_t br_ecdsa_i15_vrfy_asn1(const br_ec_impl*, const void*, size_t, const br_ec_public_key*, const void*, size_t) {
    return 0;
}
