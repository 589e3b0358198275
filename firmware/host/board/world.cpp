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
#include "espMqttClient.h"

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
bool broker = true;
bool joined = false;
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
        loop();
        pass(kTurnUs);
    }
}

void obey(const std::string& line) {
    const auto [word, rest] = split(line);
    const auto [first, second] = split(rest);
    if (word == "run") run(static_cast<unsigned>(atoi(rest.c_str())));
    if (word == "network") network = rest == "1";
    if (word == "broker") broker = rest == "1";
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
uint32_t esp_random() {
    const char* chosen = getenv("RANDOM_BITS");
    return chosen == nullptr ? 4 : static_cast<uint32_t>(strtoul(chosen, nullptr, 10));
}
void enableLoopWDT() { printf("watchdog\n"); }
uint16_t ranger_mm() { return static_cast<uint16_t>(range_mm); }
float thermometer_c() { return static_cast<float>(celsius); }
void I2cBus::begin(int sda, int scl) { printf("i2c %d %d\n", sda, scl); }

void Radio::begin(const char* name, const char*) {
    printf("join %s\n", name);
    joined = true;
}
wl_status_t Radio::status() { return joined && network ? WL_CONNECTED : WL_DISCONNECTED; }
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
bool FileSystem::begin() { return !folder().empty(); }
File FileSystem::open(const char* name, const char* mode) { return File(folder() + name, mode); }
bool FileSystem::rename(const char* from, const char* to) {
    printf("write %s\n", to);
    return ::rename((folder() + from).c_str(), (folder() + to).c_str()) == 0;
}

bool HTTPClient::begin(WiFiClient& client, const char* url) {
    printf("fetch %s\n", url);
    client_ = &client;
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
void HTTPClient::end() {
    if (client_->connected()) fclose(client_->body());
    client_->set_body(nullptr);
}
int WiFiClient::available() {
    const int next = body_ != nullptr ? fgetc(body_) : EOF;
    if (next == EOF) return 0;
    ungetc(next, body_);
    return 1460;
}
int WiFiClient::read(uint8_t* buffer, size_t size) { return static_cast<int>(fread(buffer, 1, size, body_)); }
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

BearSSL::X509List::X509List(const char*) {}
espMqttClientSecure& espMqttClientSecure::setTrustAnchors(const BearSSL::X509List*) {
    printf("trust\n");
    return *this;
}
espMqttClientSecure& espMqttClientSecure::setCACert(const char*) {
    printf("trust\n");
    return *this;
}
espMqttClient& espMqttClient::setServer(const char* host, uint16_t port) {
    printf("server %s %d\n", host, port);
    return *this;
}
espMqttClient& espMqttClient::setClientId(const char* id) {
    printf("client %s\n", id);
    return *this;
}
espMqttClient& espMqttClient::setCredentials(const char* user, const char*) {
    printf("user %s\n", user);
    return *this;
}
espMqttClient& espMqttClient::setWill(const char* topic, uint8_t qos, bool retain, const char* payload) {
    printf("will %s %d %d %s\n", topic, qos, retain, payload);
    return *this;
}
espMqttClient& espMqttClient::onDisconnect(espMqttClientTypes::OnDisconnectCallback callback) {
    on_disconnect_ = callback;
    return *this;
}
espMqttClient& espMqttClient::onMessage(espMqttClientTypes::OnMessageCallback callback) {
    on_message_ = callback;
    return *this;
}
bool espMqttClient::connect() {
    printf("connect\n");
    connecting_ = true;
    return true;
}
bool espMqttClient::disconnect(bool) {
    connected_ = connecting_ = false;
    return true;
}
uint16_t espMqttClient::subscribe(const char* topic, uint8_t qos) {
    printf("subscribe %s %d\n", topic, qos);
    return 1;
}
uint16_t espMqttClient::publish(const char* topic, uint8_t qos, bool retain, const char* payload) {
    printf("publish %s|%d|%d|%s\n", topic, qos, retain, payload);
    return 1;
}
void espMqttClient::loop() {
    const bool reached = network && joined && broker;
    if (connecting_ && !reached) on_disconnect_(espMqttClientTypes::DisconnectReason::TCP_DISCONNECTED);
    if (connecting_ && reached) connected_ = true;
    if (connected_ && !reached) {
        connected_ = false;
        on_disconnect_(espMqttClientTypes::DisconnectReason::TCP_DISCONNECTED);
    }
    connecting_ = false;
    while (connected_ && !messages.empty()) {
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
