// A stand-in for the second stack of the ESP8266's core. The loop's own has 4 KB, which BearSSL's signatures overflow: world.cpp
// ends the program when one is checked there.
#pragma once

#include "bearssl/bearssl.h"

extern "C" {
void stack_thunk_add_ref();
void stack_thunk_del_ref();
void on_second_stack(bool entered);
}

#define make_stack_thunk(function)                                                                                \
    extern "C" uint32_t thunk_##function(const br_ec_impl* curve, const void* hash, size_t hash_size,             \
                                         const br_ec_public_key* key, const void* signature, size_t size) {       \
        on_second_stack(true);                                                                                    \
        const uint32_t found = function(curve, hash, hash_size, key, signature, size);                            \
        on_second_stack(false);                                                                                   \
        return found;                                                                                             \
    }
