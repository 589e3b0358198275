// Connects to a broker with the TLS library of the ESP8266, with the buffers and the name that the firmware gives it, and prints what
// the broker answers to MQTT, in hexadecimal, or the library's error:
//   probe PORT NAME SUBJECT POINT RECEIVE SEND MQTT
// SUBJECT and POINT are the name (DER) and the key of the authority that is trusted, MQTT what is sent; all in hexadecimal.
#include <arpa/inet.h>
#include <bearssl/bearssl.h>
#include <stdio.h>
#include <stdlib.h>
#include <sys/socket.h>
#include <unistd.h>

#include <string>

static std::string bytes(const char* hex) {
    std::string found;
    for (; hex[0] != 0 && hex[1] != 0; hex += 2) {
        const char pair[] = {hex[0], hex[1], 0};
        found.push_back(static_cast<char>(strtoul(pair, nullptr, 16)));
    }
    return found;
}

static int read_some(void* socket, unsigned char* data, size_t size) {
    const ssize_t count = read(*static_cast<int*>(socket), data, size);
    return count > 0 ? static_cast<int>(count) : -1;
}

static int write_some(void* socket, const unsigned char* data, size_t size) {
    const ssize_t count = write(*static_cast<int*>(socket), data, size);
    return count > 0 ? static_cast<int>(count) : -1;
}

int main(int count, char** arguments) {
    if (count != 8) return 2;
    std::string subject = bytes(arguments[3]);
    std::string point = bytes(arguments[4]);
    const std::string mqtt = bytes(arguments[7]);
    br_x509_trust_anchor anchor = {};
    anchor.dn = {reinterpret_cast<unsigned char*>(&subject[0]), subject.size()};
    anchor.flags = BR_X509_TA_CA;
    anchor.pkey.key_type = BR_KEYTYPE_EC;
    anchor.pkey.key.ec = {BR_EC_secp256r1, reinterpret_cast<unsigned char*>(&point[0]), point.size()};

    // As the core does: an overhead of 325 and 85 bytes for a record.
    std::string receive(strtoul(arguments[5], nullptr, 10) + 325, 0);
    std::string send(strtoul(arguments[6], nullptr, 10) + 85, 0);
    static br_ssl_client_context client;
    static br_x509_minimal_context checker;
    br_ssl_client_init_full(&client, &checker, &anchor, 1);
    br_ssl_engine_set_buffers_bidi(&client.eng, &receive[0], receive.size(), &send[0], send.size());
    br_ssl_client_reset(&client, arguments[2], 0);

    int connection = socket(AF_INET, SOCK_STREAM, 0);
    sockaddr_in broker = {};
    broker.sin_family = AF_INET;
    broker.sin_port = htons(static_cast<uint16_t>(atoi(arguments[1])));
    broker.sin_addr.s_addr = htonl(INADDR_LOOPBACK);
    if (connect(connection, reinterpret_cast<sockaddr*>(&broker), sizeof broker) != 0) return 2;
    br_sslio_context io;
    br_sslio_init(&io, &client.eng, read_some, &connection, write_some, &connection);
    br_sslio_write_all(&io, mqtt.data(), mqtt.size());
    br_sslio_flush(&io);
    unsigned char byte = 0;
    for (int i = 0; i < 4 && br_sslio_read(&io, &byte, 1) == 1; ++i) printf("%02x", byte);
    const int error = br_ssl_engine_last_error(&client.eng);
    if (error != 0) printf("error %d", error);
    printf("\n");
    close(connection);
}
