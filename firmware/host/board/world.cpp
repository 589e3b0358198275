// What lies behind the stand-ins: a program that runs the whole firmware on this computer, in simulated time, as lines on
// its input ask. A line `run MS` lets time pass; what the firmware does is told on the output, a line for each deed. The
// flash is the folder in FLASH. A restart ends the program, as it ends the firmware; the next start is another process.
#include <stdlib.h>
#include <sys/stat.h>

#include <map>
#include <vector>

#include "DallasTemperature.h"
#include "HTTPClient.h"
#include "LittleFS.h"
#include "Update.h"
#include "VL53L1X.h"
#include "WebServer.h"
#include "WiFiClientSecure.h"
#include "espMqttClient.h"
#if defined(ESP8266)
#include "StackThunk.h"
#else
#include "esp_ota_ops.h"
#include "esp_task_wdt.h"

extern "C" __attribute__((weak)) bool verifyRollbackLater() { return false; }
#endif

SerialPort Serial;
Chip ESP;
Radio WiFi;
FileSystem LittleFS;
FlashWriter Update;
I2cBus Wire;

namespace {

constexpr double kUsPerMm = 2e6 / 343420.0;  // at 20 degrees
constexpr unsigned kTurnUs = 1000;           // of the loop
constexpr unsigned kBurstUs = 450;

struct Interrupt {
    void (*handler)(void*);
    void* argument;
};
struct Edge {
    uint64_t at_us;
    int pin;
    int level;
};
struct Part {
    std::string topic;
    std::string payload;
};

uint64_t now_us = 1000;
std::map<int, int> levels;
std::map<int, Interrupt> interrupts;
std::map<int, std::pair<int, double>> sonars;  // trigger pin: echo pin, range (mm; negative: no echo)
std::vector<Edge> edges;
std::vector<Part> messages;
std::map<std::string, std::string> request;
std::string path;
bool network = true;
std::string wifi = "reachable";  // or "absent", "secret"
// Whether it is there: "1", "0" (it refuses connections), "silent" (nobody is there), "ends" (it hangs up), or the code by which
// it refuses clients.
std::string broker = "1";
std::string names = "mosquitto";  // in its certificate, between spaces
std::string authority = "ours";   // that signed it, or "theirs"
bool joined = false;
size_t heap_free = 0;  // in one piece
uint32_t watchdog_s = 0;
double range_mm = 1500;
double celsius = 20;
int analog = 0;

void pass(uint64_t us) {
    const uint64_t until = now_us + us;
    while (!edges.empty() && edges.front().at_us <= until) {
        const Edge edge = edges.front();
        edges.erase(edges.begin());
        if (edge.at_us > now_us) now_us = edge.at_us;
        levels[edge.pin] = edge.level;
        const auto found = interrupts.find(edge.pin);
        if (found != interrupts.end()) found->second.handler(found->second.argument);
    }
    now_us = until;
}

std::string folder() {
    const char* named = getenv("FLASH");
    return named != nullptr ? named : "";
}

// The first word of a line, and the rest.
std::pair<std::string, std::string> split(const std::string& line) {
    const size_t at = line.find(' ');
    return at == std::string::npos ? std::make_pair(line, std::string())
                                   : std::make_pair(line.substr(0, at), line.substr(at + 1));
}

void run(unsigned ms) {
    for (const uint64_t until = now_us + ms * 1000ULL; now_us < until;) {
        const uint64_t begun_us = now_us;
        loop();
        if (watchdog_s != 0 && now_us - begun_us > watchdog_s * 1000000ULL) {
            printf("watchdog reset\n");
            ESP.restart();
        }
        pass(kTurnUs);
    }
}

size_t number_of(const char* variable, size_t otherwise) {
    const char* chosen = getenv(variable);
    return chosen == nullptr ? otherwise : strtoul(chosen, nullptr, 10);
}

void obey(const std::string& line) {
    const auto [word, rest] = split(line);
    const auto [first, second] = split(rest);
    if (word == "run") run(static_cast<unsigned>(atoi(rest.c_str())));
    if (word == "network") network = rest == "1";
    if (word == "wifi") wifi = rest;
    if (word == "broker") broker = rest;
    if (word == "certificate") names = rest;
    if (word == "authority") authority = rest;
    if (word == "heap") heap_free = strtoul(rest.c_str(), nullptr, 10);
    if (word == "pin") levels[atoi(first.c_str())] = atoi(second.c_str());
    if (word == "range") range_mm = atof(rest.c_str());
    if (word == "celsius") celsius = atof(rest.c_str());
    if (word == "analog") analog = atoi(rest.c_str());
    if (word == "field") request[first] = second;
    if (word == "request") path = rest;
    if (word == "message") messages.push_back({first, second});
    if (word == "sonar") {
        const auto [echo, mm] = split(second);
        sonars[atoi(first.c_str())] = {atoi(echo.c_str()), atof(mm.c_str())};
    }
    printf("done\n");
    fflush(stdout);
}

}  // namespace

void Chip::restart() {
    printf("restart\n");
    fflush(stdout);
    exit(0);
}

unsigned long millis() { return static_cast<uint32_t>(now_us / 1000); }
unsigned long micros() { return static_cast<uint32_t>(now_us); }
void delay(unsigned long ms) { pass(ms * 1000); }
void delayMicroseconds(unsigned int us) { pass(us); }
void pinMode(uint8_t pin, uint8_t mode) {
    if (mode == INPUT_PULLUP) levels[pin] = HIGH;
}
void digitalWrite(uint8_t pin, uint8_t value) {
    const auto found = sonars.find(pin);
    if (value == HIGH && found != sonars.end()) {
        const auto [echo, mm] = found->second;
        const uint64_t rise = now_us + kBurstUs;
        edges.push_back({rise, echo, HIGH});
        edges.push_back({rise + (mm < 0 ? 38000 : static_cast<uint64_t>(mm * kUsPerMm)), echo, LOW});
    }
    levels[pin] = value;
}
int digitalRead(uint8_t pin) { return levels[pin]; }
int analogRead(uint8_t) { return analog; }
int digitalPinToInterrupt(int pin) { return pin; }
void attachInterruptArg(uint8_t pin, void (*handler)(void*), void* argument, int) { interrupts[pin] = {handler, argument}; }
void configTime(long, int, const char* server) { printf("time from %s\n", server); }
// A number that the test chooses: else every start would be the same boot.
uint32_t esp_random() { return static_cast<uint32_t>(number_of("RANDOM_BITS", 4)); }
uint32_t firmware_number() { return static_cast<uint32_t>(number_of("FIRMWARE_NUMBER", 1)); }
uint32_t Chip::getMaxFreeBlockSize() { return static_cast<uint32_t>(heap_free); }
#if defined(ESP32)
static uint32_t configured_watchdog_s = 5;
void esp_task_wdt_init(uint32_t timeout_s, bool) { configured_watchdog_s = timeout_s; }
void enableLoopWDT() {
    printf("watchdog\n");
    watchdog_s = configured_watchdog_s;
}
void esp_ota_mark_app_valid_cancel_rollback() { printf("image kept\n"); }
#else
static bool take_memory(size_t size) {
    if (size > heap_free) return false;
    heap_free -= size;
    return true;
}
static uint32_t stack_users = 0;
static bool second_stack = false;
void stack_thunk_add_ref() {
    if (stack_users++ == 0 && !take_memory(6200)) abort();
}
void stack_thunk_del_ref() {
    if (--stack_users == 0) heap_free += 6200;
}
void on_second_stack(bool entered) {
    if (stack_users == 0) abort();
    second_stack = entered;
}
// The linker puts it in the place of the library's own, where that is installed.
extern "C" __attribute__((weak)) uint32_t __real_br_ecdsa_i15_vrfy_asn1(const br_ec_impl*, const void*, size_t,
                                                                        const br_ec_public_key*, const void*, size_t);
extern "C" uint32_t __wrap_br_ecdsa_i15_vrfy_asn1(const br_ec_impl* curve, const void* hash, size_t hash_size,
                                                  const br_ec_public_key* key, const void* signature, size_t size) {
    if (!second_stack) {
        printf("stack overflow\n");
        ESP.restart();
    }
    return __real_br_ecdsa_i15_vrfy_asn1(curve, hash, hash_size, key, signature, size);
}
#endif
uint16_t ranger_mm() { return static_cast<uint16_t>(range_mm); }
float thermometer_c() { return static_cast<float>(celsius); }
void I2cBus::begin(int sda, int scl) { printf("i2c %d %d\n", sda, scl); }

void Radio::begin(const char* name, const char*) {
    printf("join %s\n", name);
    joined = true;
}
wl_status_t Radio::status() {
    if (wifi == "absent") return WL_NO_SSID_AVAIL;
    if (wifi == "secret") return WL_WRONG_PASSWORD;
    return joined && network ? WL_CONNECTED : WL_DISCONNECTED;
}
bool IPAddress::fromString(const char* text) {
    text_ = text;
    return text_.find_first_not_of("0123456789.") == std::string::npos;
}
int Radio::hostByName(const char* name, IPAddress& address, uint32_t timeout_ms) {
    if (address.fromString(name)) return 1;
    const std::string searched = name;
    bool known = searched != "nowhere.lan";
#if defined(ESP8266)
    // Its lwIP asks the name server, and no multicast.
    if (searched.size() > 6 && searched.rfind(".local") == searched.size() - 6) known = false;
#endif
    if (known) return address.fromString("192.168.7.1");
    pass(timeout_ms * 1000ULL);
    return 0;
}

int WiFiClient::connect(IPAddress, uint16_t) {
    const bool reached = joined && network;
    open_ = reached && broker != "0" && broker != "silent";
    if (!reached || broker == "silent") pass(timeout_ms_ * 1000ULL);
    return open_;
}
int WiFiClient::connect(const IPAddress& address, uint16_t port, int32_t timeout_ms) {
    timeout_ms_ = static_cast<uint32_t>(timeout_ms);
    return connect(address, port);
}
uint8_t WiFiClient::connected() {
    if (!joined || !network || broker == "0" || broker == "silent") open_ = false;
    return open_ || body_ != nullptr;
}
void WiFiClient::stop() {
    if (body_ != nullptr) fclose(body_);
    body_ = nullptr;
    open_ = false;
}
void Radio::softAP(const char* name) { printf("network %s\n", name); }

File::File(const std::string& name, const char* mode) {
    FILE* opened = fopen(name.c_str(), mode);
    if (opened != nullptr) file_ = std::shared_ptr<FILE>(opened, fclose);
}
size_t File::size() const {
    struct stat found;
    return fstat(fileno(file_.get()), &found) == 0 ? static_cast<size_t>(found.st_size) : 0;
}
String File::readString() {
    String text;
    for (int character = fgetc(file_.get()); character != EOF; character = fgetc(file_.get())) text.push_back(static_cast<char>(character));
    close();
    return text;
}
size_t File::write(const uint8_t* data, size_t size) { return fwrite(data, 1, size, file_.get()); }
#if defined(ESP8266)
bool FileSystem::begin() { return !folder().empty(); }
#else
// A fresh board has no file system, and gets one only on request.
bool FileSystem::begin(bool format_on_fail) {
    if (getenv("FRESH") != nullptr && format_on_fail) printf("format\n");
    return !folder().empty() && (getenv("FRESH") == nullptr || format_on_fail);
}
#endif
File FileSystem::open(const char* name, const char* mode) { return File(folder() + name, mode); }
bool FileSystem::rename(const char* from, const char* to) {
    printf("write %s\n", to);
    return ::rename((folder() + from).c_str(), (folder() + to).c_str()) == 0;
}
bool FileSystem::remove(const char* name) {
    if (::remove((folder() + name).c_str()) != 0) return false;
    printf("remove %s\n", name);
    return true;
}

bool HTTPClient::begin(WiFiClient& client, const char* url) {
    printf("fetch %s\n", url);
#if defined(ESP8266)
    copy_ = client.clone();
    client_ = copy_.get();
#else
    client_ = &client;
#endif
    return true;
}
int HTTPClient::GET() {
    client_->set_body(fopen((folder() + "/served").c_str(), "rb"));
    return client_->connected() ? HTTP_CODE_OK : -1;
}
int HTTPClient::getSize() {
    struct stat found;
    return fstat(fileno(client_->body()), &found) == 0 ? static_cast<int>(found.st_size) : -1;
}
WiFiClient* HTTPClient::getStreamPtr() { return client_ != nullptr && client_->connected() ? client_ : nullptr; }
void HTTPClient::end() {
    if (client_ != nullptr) client_->stop();
    client_ = nullptr;
}
int WiFiClient::available() {
    const int next = body_ != nullptr ? fgetc(body_) : EOF;
    if (next == EOF) return 0;
    ungetc(next, body_);
    return 1460;
}
int WiFiClient::read(uint8_t* buffer, size_t size) {
    return body_ != nullptr ? static_cast<int>(fread(buffer, 1, size, body_)) : 0;
}
bool FlashWriter::begin(size_t size) {
    if (image_ != nullptr) fclose(image_);
    image_ = fopen((folder() + "/flashed").c_str(), "wb");
    missing_ = size;
    return image_ != nullptr;
}
size_t FlashWriter::write(uint8_t* data, size_t size) {
    missing_ -= size;
    return fwrite(data, 1, size, image_);
}
bool FlashWriter::end() {
    const bool whole = image_ != nullptr && missing_ == 0;
    if (image_ != nullptr) fclose(image_);
    image_ = nullptr;
    printf("flash %s\n", whole ? "complete" : "discarded");
    return whole;
}

// What the certificate of the broker lacks, or nullptr.
static const char* mistrust(const char* name) {
    if (authority != "ours") return "Chain could not be linked to a trust anchor.";
    const bool named = name == nullptr || (" " + names + " ").find(" " + std::string(name) + " ") != std::string::npos;
    return named ? nullptr : "Expected server name was not found in the chain.";
}

#if defined(ESP8266)
// In bytes, by the headers of the core 3.1.2; the rest of a handshake is freed when it ends.
constexpr size_t kTlsContext = 3408;
constexpr size_t kTlsHandshake = 3064;
constexpr size_t kTlsOverhead = 325 + 85;

BearSSL::X509List::X509List(const char* pem) : count(strstr(pem, "BEGIN CERTIFICATE") != nullptr) {}
BearSSL::WiFiClientSecureCtx::WiFiClientSecureCtx() { stack_thunk_add_ref(); }
int BearSSL::WiFiClientSecureCtx::connect(IPAddress address, uint16_t port) {
    return WiFiClient::connect(address, port) && _connectSSL(nullptr);
}
bool BearSSL::WiFiClientSecureCtx::_connectSSL(const char* name) {
#if defined(PIO_FRAMEWORK_ARDUINO_MMU_CACHE16_IRAM48_SECHEAP_SHARED)
    const size_t buffers = 0;  // they are in the instruction RAM
#else
    const size_t buffers = static_cast<size_t>(receive_size_ + send_size_) + kTlsOverhead;
#endif
    error_ = heap_free < kTlsContext + kTlsHandshake + buffers ? "Unable to allocate memory for SSL structures and buffers." : mistrust(name);
    if (error_ != nullptr) return false;
    printf("verified %s\n", name == nullptr ? "nothing" : name);
    taken_ = kTlsContext + buffers;
    return take_memory(taken_);
}
int BearSSL::WiFiClientSecureCtx::getLastSSLError(char* text, size_t size) {
    snprintf(text, size, "%s", error_ != nullptr ? error_ : "OK");
    return error_ != nullptr;
}
void BearSSL::WiFiClientSecureCtx::stop() {
    WiFiClient::stop();
    heap_free += taken_;
    taken_ = 0;
}
#else
int WiFiClientSecure::connect(IPAddress address, uint16_t port, const char* name, const char*, const char*, const char*) {
    error_ = -1;
    if (!WiFiClient::connect(address, port)) return 0;
    error_ = mistrust(name) == nullptr ? 0 : -0x2700;
    if (error_ == 0) printf("verified %s\n", name);
    open_ = error_ == 0;
    return open_;
}
int WiFiClientSecure::lastError(char* text, size_t size) {
    if (error_ == 0) return 0;
    snprintf(text, size, "%s", error_ == -1 ? "UNKNOWN ERROR CODE (0001)" : "X509 - Certificate verification failed");
    return error_;
}
#endif

void MqttClient::told_server(const char* host, uint16_t port) {
    host_ = host;
    port_ = port;
    printf("server %s %d\n", host, port);
}
void MqttClient::told_client(const char* id) { printf("client %s\n", id); }
void MqttClient::told_user(const char* user) { printf("user %s\n", user); }
void MqttClient::told_will(const char* topic, uint8_t qos, bool retain, const char* payload) {
    printf("will %s %d %d %s\n", topic, qos, retain, payload);
}
bool MqttClient::connect() {
    if (state_ != State::disconnected) return false;
    printf("connect\n");
    state_ = State::connecting_tcp;
    return true;
}
bool MqttClient::disconnect(bool) {
    if (state_ == State::disconnected || state_ == State::stopped) return false;
    state_ = State::disconnecting;
    return true;
}
uint16_t MqttClient::subscribe(const char* topic, uint8_t qos) {
    if (!connected() || heap_free < EMC_MIN_FREE_MEMORY) return 0;
    printf("subscribe %s %d\n", topic, qos);
    return 1;
}
uint16_t MqttClient::publish(const char* topic, uint8_t qos, bool retain, const char* payload) {
    if (heap_free < EMC_MIN_FREE_MEMORY) return 0;
    printf("publish %s|%d|%d|%s\n", topic, qos, retain, payload);
    return 1;
}
void MqttClient::loop() {
    switch (state_) {
        case State::disconnected:
            return;
        case State::connecting_tcp:
            reason_ = espMqttClientTypes::DisconnectReason::TCP_DISCONNECTED;
            state_ = _transport->connect(host_, port_) ? State::connecting_mqtt : State::disconnecting;
            return;
        case State::connecting_mqtt:
            if (broker == "1" && _transport->connected()) {
                state_ = State::connected;
                on_connect_(false);
                return;
            }
            if (broker.size() == 1 && broker > "1") reason_ = static_cast<espMqttClientTypes::DisconnectReason>(broker[0] - '0');
            state_ = State::disconnecting;
            return;
        case State::connected:
            if (!_transport->connected()) {
                state_ = State::disconnecting;
            } else {
                deliver();
            }
            return;
        case State::disconnecting:
            _transport->stop();
            state_ = State::stopped;
            return;
        case State::stopped:
            state_ = State::disconnected;
            on_disconnect_(reason_);
    }
}
void MqttClient::deliver() {
    while (connected() && !messages.empty()) {
        const Part message = messages.front();
        messages.erase(messages.begin());
        // In parts, as the library gives a message that is longer than its buffer.
        for (size_t at = 0; at < message.payload.size(); at += 16) {
            const std::string part = message.payload.substr(at, 16);
            on_message_({1, false, false, 1}, message.topic.c_str(), reinterpret_cast<const uint8_t*>(part.data()),
                        part.size(), at, message.payload.size());
        }
    }
}

void WebServer::handleClient() {
    if (path.empty()) return;
    const auto found = handlers_.find(path);
    path.clear();
    found != handlers_.end() ? found->second() : not_found_();
}
void WebServer::send(int code, const char*, const char* text) { printf("answer %d %.60s\n", code, text); }
void WebServer::sendHeader(const char* name, const char* value) { printf("header %s %s\n", name, value); }
String WebServer::arg(const char* name) {
    const auto found = request.find(name);
    return found == request.end() ? String() : String(found->second.c_str());
}

int main() {
    heap_free = number_of("HEAP", 100000);
#if defined(ESP32)
    if (!verifyRollbackLater()) esp_ota_mark_app_valid_cancel_rollback();
#endif
    setup();
    printf("done\n");
    fflush(stdout);
    std::string line;
    for (int character = getchar(); character != EOF; character = getchar()) {
        if (character != '\n') {
            line.push_back(static_cast<char>(character));
            continue;
        }
        obey(line);
        line.clear();
    }
}
