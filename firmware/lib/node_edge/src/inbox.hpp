// Puts messages together that the MQTT library delivers in parts: a configuration, a command and an update may wait for a
// node when it connects. The library never mixes the parts of two messages.
#pragma once

#include <stddef.h>
#include <stdint.h>

#include "fognav_contract.h"

namespace fognav {

enum class Topic : uint8_t { config, command, update, other };

class Inbox {
public:
    // Set the topics of this node: to be called once, before the first part.
    void begin(const char* site, const char* node);

    const char* topic(Topic topic) const { return topics_[static_cast<int>(topic)]; }

    // Take a part: `length` bytes from `index` on of a message of `total` bytes. True once a message is complete: then
    // `received`, `text` and `size` hold it until the next part. What is longer than its channel allows, or of another
    // topic, is left out, and so is a message of which a part is missing.
    bool take(const char* topic, const uint8_t* part, size_t length, size_t index, size_t total);

    Topic received() const { return topic_; }
    const char* text() const { return text_; }
    size_t size() const { return size_; }

private:
    static constexpr size_t kSize = FOGNAV_NODE_UPDATE_LIMIT;
    static_assert(kSize >= FOGNAV_NODE_CONFIG_LIMIT && kSize >= FOGNAV_NODE_COMMAND_LIMIT, "a message may not fit");

    char topics_[3][FOGNAV_NODE_COMMAND_TOPIC_SIZE] = {};
    Topic topic_ = Topic::other;
    size_t size_ = 0;
    char text_[kSize] = {};
};

}  // namespace fognav
