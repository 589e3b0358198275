// Feeds arbitrary bytes to the node: as settings, as a configuration, and as a program of edges, steps and commands. A fuzzer of LLVM
// calls the first function; without one, `main` reads a file of inputs, each preceded by its length (32 bits, little-endian).
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "discovery.hpp"
#include "fognav_contract.h"
#include "json_reader.hpp"
#include "node.hpp"
#include "settings.hpp"
#include "update.hpp"

extern "C" int LLVMFuzzerTestOneInput(const uint8_t* data, size_t size);

int LLVMFuzzerTestOneInput(const uint8_t* data, size_t size) {
    // Copies on the heap: a read beyond their ends is a fault that a sanitizer sees.
    char* text = static_cast<char*>(malloc(size));
    if (size > 0) memcpy(text, data, size);
    fognav::NodeSettings settings;
    settings.config.sonars = size == 0 ? 1 : 1 + data[0] % fognav::kMaxSonars;
    settings.boot = static_cast<uint32_t>(size);
    settings.firmware = "fuzz \"\\";
    fognav::Node node(settings);
    node.configure(text, size);
    node.command(text, size);
    node.restore(text, size);
    fognav::JsonReader(text, size).skip_value();
    fognav::UpdateOffer offer;
    char lines[fognav::kSignedTextSize];
    if (fognav::read_update(text, size, offer) == nullptr && fognav::signed_text(offer, lines, sizeof lines) >= sizeof lines) abort();
    fognav::Settings found;
    static char description[FOGNAV_HOME_ASSISTANT_LIMIT];
    if (size > 0 && fognav::read_settings(text, size, data[0] % 2 != 0 ? fognav::kD1Mini : fognav::kD1Mini32, found) == nullptr &&
        fognav::write_discovery(found, settings.firmware, description, sizeof description) == 0) {
        abort();
    }
    uint32_t now_us = 0;
    for (size_t i = 0; i + 2 < size; i += 3) {
        now_us += static_cast<uint32_t>(data[i + 1]) << (data[i + 2] % 16);
        switch (data[i] % 8) {
            case 0: {
                static constexpr const char* kCommands[] = {
                    FOGNAV_NODE_COMMAND_CALIBRATE, FOGNAV_NODE_COMMAND_LEARN_NO_ECHO, FOGNAV_NODE_COMMAND_KEEP};
                const char* command = kCommands[data[i + 1] % 3];
                node.command(command, strlen(command));
                break;
            }
            case 1:
                node.configure(text + i, size - i);
                break;
            case 2:
            case 3:
                node.on_edge(data[i + 2] % settings.config.sonars, data[i] % 2 != 0, now_us);
                break;
            case 4:
                node.set_temperature(static_cast<int16_t>(data[i + 1] * 4 - 400));
                break;
            default:
                switch (node.step(now_us)) {
                    case fognav::Node::Event::none:
                    case fognav::Node::Event::trigger:
                        continue;
                    case fognav::Node::Event::replaced:
                        if (node.message_length() == 0) continue;
                        [[fallthrough]];
                    case fognav::Node::Event::calibrated:
                    case fognav::Node::Event::kept:
                        // What a node has stored, it must be able to read.
                        if (node.restore(node.message(), node.message_length()) != nullptr) abort();
                        break;
                    case fognav::Node::Event::publish:
                        break;
                }
                if (node.message_length() == 0 || node.message_length() >= FOGNAV_NODE_READING_LIMIT) abort();
                if (node.message_length() != strlen(node.message())) abort();
        }
    }
    free(text);
    return 0;
}

#ifndef FOGNAV_LIBFUZZER
int main(int count, char** arguments) {
    FILE* file = count > 1 ? fopen(arguments[1], "rb") : nullptr;
    if (file == nullptr) {
        fprintf(stderr, "usage: fuzz FILE, inputs each preceded by its length\n");
        return 2;
    }
    uint8_t length[4];
    long inputs = 0;
    for (; fread(length, 1, sizeof length, file) == sizeof length; ++inputs) {
        const size_t size = length[0] | length[1] << 8 | length[2] << 16 | static_cast<size_t>(length[3]) << 24;
        uint8_t* data = static_cast<uint8_t*>(malloc(size + 1));
        if (fread(data, 1, size, file) != size) return 2;
        LLVMFuzzerTestOneInput(data, size);
        free(data);
    }
    fclose(file);
    printf("%ld inputs\n", inputs);
    return 0;
}
#endif
