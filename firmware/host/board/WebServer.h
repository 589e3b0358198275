// A stand-in for the board's web server: requests come from world.cpp.
#pragma once

#include <functional>
#include <map>

#include "Arduino.h"

enum HTTPMethod { HTTP_GET, HTTP_POST };

class WebServer {
public:
    using Handler = std::function<void()>;
    explicit WebServer(int) {}
    void on(const char* path, Handler handler) { handlers_[path] = handler; }
    void on(const char* path, HTTPMethod, Handler handler) { handlers_[path] = handler; }
    void onNotFound(Handler handler) { not_found_ = handler; }
    void begin() {}
    void handleClient();
    void send(int code, const char* type, const char* text);
    void send_P(int code, const char* type, const char* text) { send(code, type, text); }
    void sendHeader(const char* name, const char* value);
    String arg(const char* name);

private:
    std::map<std::string, Handler> handlers_;
    Handler not_found_;
};
