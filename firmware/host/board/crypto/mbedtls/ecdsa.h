// A stand-in for Mbed TLS where it is not installed: to compile against. No signature is good.
#pragma once

#include <stddef.h>

enum mbedtls_ecp_group_id { MBEDTLS_ECP_DP_SECP256R1 };
struct mbedtls_ecp_group {};
struct mbedtls_ecp_point {};
struct mbedtls_ecdsa_context {
    mbedtls_ecp_group grp;
    mbedtls_ecp_point Q;
};
inline void mbedtls_ecdsa_init(mbedtls_ecdsa_context*) {}
inline void mbedtls_ecdsa_free(mbedtls_ecdsa_context*) {}
inline int mbedtls_ecp_group_load(mbedtls_ecp_group*, mbedtls_ecp_group_id) { return 0; }
inline int mbedtls_ecp_point_read_binary(const mbedtls_ecp_group*, mbedtls_ecp_point*, const unsigned char*, size_t) { return 0; }
inline int mbedtls_ecp_check_pubkey(const mbedtls_ecp_group*, const mbedtls_ecp_point*) { return 0; }
inline int mbedtls_ecdsa_read_signature(mbedtls_ecdsa_context*, const unsigned char*, size_t, const unsigned char*, size_t) {
    return -1;
}
