// A robot of ROS 2 on Fast DDS, ROS's default: hears a keepout mask and sends a goal, reading and writing CDR itself.
//
// Usage: fast_dds_peer DOMAIN SITE ROBOT. Prints what it heard of each mask as a line of JSON.

#include <chrono>
#include <cstdint>
#include <cstring>
#include <iostream>
#include <memory>
#include <string>
#include <thread>
#include <vector>

#include <fastdds/dds/domain/DomainParticipant.hpp>
#include <fastdds/dds/domain/DomainParticipantFactory.hpp>
#include <fastdds/dds/publisher/DataWriter.hpp>
#include <fastdds/dds/publisher/Publisher.hpp>
#include <fastdds/dds/subscriber/DataReader.hpp>
#include <fastdds/dds/subscriber/SampleInfo.hpp>
#include <fastdds/dds/subscriber/Subscriber.hpp>
#include <fastdds/dds/topic/TopicDataType.hpp>
#include <fastdds/dds/topic/TypeSupport.hpp>
#include <fastdds/rtps/transport/UDPv4TransportDescriptor.h>
#include <fastrtps/utils/IPLocator.h>

namespace fast = eprosima::fastdds::dds;
namespace rtps = eprosima::fastrtps::rtps;
using Bytes = std::vector<std::uint8_t>;

// A type of which only the name is known: its messages are their bytes, after the header of the encapsulation.
class Named : public fast::TopicDataType {
public:
    explicit Named(const char* name) {
        setName(name);
        m_typeSize = 4096;
    }
    bool serialize(void* data, rtps::SerializedPayload_t* payload) override {
        const Bytes& bytes = *static_cast<Bytes*>(data);
        payload->reserve(static_cast<std::uint32_t>(bytes.size()));
        payload->length = static_cast<std::uint32_t>(bytes.size());
        payload->encapsulation = CDR_LE;
        std::memcpy(payload->data, bytes.data(), bytes.size());
        return true;
    }
    bool deserialize(rtps::SerializedPayload_t* payload, void* data) override {
        static_cast<Bytes*>(data)->assign(payload->data, payload->data + payload->length);
        return true;
    }
    std::function<std::uint32_t()> getSerializedSizeProvider(void* data) override {
        return [data] { return static_cast<std::uint32_t>(static_cast<Bytes*>(data)->size()); };
    }
    void* createData() override { return new Bytes; }
    void deleteData(void* data) override { delete static_cast<Bytes*>(data); }
    bool getKey(void*, rtps::InstanceHandle_t*, bool) override { return false; }
};

// CDR, little-endian: each number stands at a multiple of its size after the header of 4 bytes.
struct Cdr {
    Bytes bytes{0, 1, 0, 0};
    std::size_t at = 4;

    void align(std::size_t size) { at = 4 + (at - 4 + size - 1) / size * size; }
    template <typename T> T get() {
        T value;
        align(sizeof value);
        std::memcpy(&value, bytes.data() + at, sizeof value);
        at += sizeof value;
        return value;
    }
    template <typename T> void put(T value) {
        align(sizeof value);
        bytes.resize(at + sizeof value);
        std::memcpy(bytes.data() + at, &value, sizeof value);
        at = bytes.size();
    }
    std::string text() {
        const auto length = get<std::uint32_t>();
        std::string found(bytes.begin() + at, bytes.begin() + at + length - 1);
        at += length;
        return found;
    }
    void put(const std::string& text) {
        put(static_cast<std::uint32_t>(text.size() + 1));
        bytes.insert(bytes.end(), text.begin(), text.end());
        bytes.push_back(0);
        at = bytes.size();
    }
};

int main(int, char** argument) {
    const std::string site = argument[2], robot = argument[3];
    fast::DomainParticipantQos quality;
    auto udp = std::make_shared<eprosima::fastdds::rtps::UDPv4TransportDescriptor>();
    udp->interfaceWhiteList = {"127.0.0.1"};
    quality.transport().use_builtin_transports = false;
    quality.transport().user_transports = {udp};
    rtps::Locator_t here;
    rtps::IPLocator::setIPv4(here, "127.0.0.1");
    quality.wire_protocol().builtin.initialPeersList.push_back(here);
    auto* participant = fast::DomainParticipantFactory::get_instance()->create_participant(std::stoi(argument[1]), quality);
    const fast::TypeSupport grid(new Named("nav_msgs::msg::dds_::OccupancyGrid_"));
    const fast::TypeSupport pose(new Named("geometry_msgs::msg::dds_::PoseStamped_"));
    grid.register_type(participant);
    pose.register_type(participant);

    fast::DataReaderQos latched;
    latched.reliability().kind = fast::RELIABLE_RELIABILITY_QOS;
    latched.durability().kind = fast::TRANSIENT_LOCAL_DURABILITY_QOS;
    latched.history().depth = 1;
    latched.endpoint().history_memory_policy = rtps::PREALLOCATED_WITH_REALLOC_MEMORY_MODE;
    auto* masks = participant->create_subscriber(fast::SUBSCRIBER_QOS_DEFAULT)->create_datareader(
        participant->create_topic("rt/fognav/" + site + "/keepout_mask", grid.get_type_name(), fast::TOPIC_QOS_DEFAULT),
        latched);
    fast::DataWriterQos plain;
    plain.reliability().kind = fast::RELIABLE_RELIABILITY_QOS;
    plain.endpoint().history_memory_policy = rtps::PREALLOCATED_WITH_REALLOC_MEMORY_MODE;
    auto* goals = participant->create_publisher(fast::PUBLISHER_QOS_DEFAULT)->create_datawriter(
        participant->create_topic("rt/" + robot + "/goal_pose", pose.get_type_name(), fast::TOPIC_QOS_DEFAULT), plain);
    if (masks == nullptr || goals == nullptr) {
        std::cerr << "no reader or writer\n";
        return 1;
    }

    while (true) {
        Cdr heard;
        fast::SampleInfo info;
        while (masks->take_next_sample(&heard.bytes, &info) == eprosima::fastrtps::types::ReturnCode_t::RETCODE_OK) {
            if (!info.valid_data) continue;
            heard.at = 4;
            heard.get<std::int32_t>();
            heard.get<std::uint32_t>();
            const std::string frame = heard.text();
            heard.get<std::int32_t>();
            heard.get<std::uint32_t>();
            heard.get<float>();
            const auto width = heard.get<std::uint32_t>(), height = heard.get<std::uint32_t>();
            for (int n = 0; n < 7; ++n) heard.get<double>();
            const auto length = heard.get<std::uint32_t>();
            int blocked = 0;
            for (std::uint32_t n = 0; n < length; ++n) blocked += heard.bytes[heard.at + n] == 100;
            std::cout << "{\"frame\": \"" << frame << "\", \"size\": [" << width << ", " << height << "], \"blocked\": "
                      << blocked << "}" << std::endl;
        }
        Cdr goal;
        goal.put(static_cast<std::int32_t>(1));
        goal.put(static_cast<std::uint32_t>(0));
        goal.put(std::string("map"));
        for (const double value : {4.0, 3.0, 0.0, 0.0, 0.0, 0.0, 1.0}) goal.put(value);
        goals->write(&goal.bytes);
        std::this_thread::sleep_for(std::chrono::milliseconds(200));
    }
}
