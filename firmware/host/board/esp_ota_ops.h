// A stand-in for the ESP32's trial of a new image.
#pragma once

void esp_ota_mark_app_valid_cancel_rollback();
