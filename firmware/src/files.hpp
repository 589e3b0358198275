// The board's file system: settings, certificate, and what a node has learned.
#pragma once

#include <Arduino.h>

namespace fognav {

constexpr const char* kSettingsFile = "/node.json";
constexpr const char* kAuthorityFile = "/ca.pem";
constexpr const char* kCalibrationFile = "/calibration.json";
constexpr const char* kUpdateFile = "/update.txt";

// A file as text; an empty one if it is missing or larger than `size_max`.
String read_file(const char* name, size_t size_max);

// Write a file so that after a loss of power it is the old one or the new one. False if the flash is full.
bool write_file(const char* name, const char* text);

// Afterwards there is no such file.
void remove_file(const char* name);

}  // namespace fognav
