#include "inbox.hpp"

#include <stdio.h>
#include <string.h>

namespace fognav {

static_assert(FOGNAV_NODE_COMMAND_TOPIC_SIZE >= FOGNAV_NODE_CONFIG_TOPIC_SIZE, "a topic may not fit");
static_assert(FOGNAV_NODE_COMMAND_TOPIC_SIZE >= FOGNAV_NODE_UPDATE_TOPIC_SIZE, "a topic may not fit");

namespace {

constexpr size_t kLimits[] = {FOGNAV_NODE_CONFIG_LIMIT, FOGNAV_NODE_COMMAND_LIMIT, FOGNAV_NODE_UPDATE_LIMIT};

}  // namespace

void Inbox::begin(const char* site, const char* node) {
    snprintf(topics_[static_cast<int>(Topic::config)], sizeof topics_[0], FOGNAV_NODE_CONFIG_TOPIC, site, node);
    snprintf(topics_[static_cast<int>(Topic::command)], sizeof topics_[0], FOGNAV_NODE_COMMAND_TOPIC, site, node);
    snprintf(topics_[static_cast<int>(Topic::update)], sizeof topics_[0], FOGNAV_NODE_UPDATE_TOPIC, site, node);
}

bool Inbox::take(const char* topic, const uint8_t* part, size_t length, size_t index, size_t total) {
    if (index == 0) {
        size_ = 0;
        topic_ = Topic::other;
        for (int i = 0; i < 3; ++i) {
            if (strcmp(topic, topics_[i]) == 0 && total <= kLimits[i]) topic_ = static_cast<Topic>(i);
        }
    }
    if (topic_ == Topic::other || index != size_ || length > total - index) {
        topic_ = Topic::other;
        return false;
    }
    if (length > 0) memcpy(text_ + index, part, length);
    size_ += length;
    return size_ == total;
}

}  // namespace fognav
