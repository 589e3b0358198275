#include <bearssl/bearssl.h>

const br_ec_impl br_ec_p256_m15 = {};
