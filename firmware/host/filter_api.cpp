// The small parts of the core for their own tests.
#include "json_reader.hpp"
#include "spike_filter.hpp"

extern "C" {

// Filter `count` samples (status, range in mm) into `out`.
void fognav_filter(const int32_t* status, const int32_t* range_mm, int count, int32_t* out_status, int32_t* out_range_mm) {
    fognav::SpikeFilter filter;
    for (int i = 0; i < count; ++i) {
        const fognav::Sample sample = filter.update({static_cast<fognav::Status>(status[i]), range_mm[i]});
        out_status[i] = static_cast<int32_t>(sample.status);
        out_range_mm[i] = sample.range_mm;
    }
}

// 1 and the number times 1000, or 0 if the text is no JSON number.
int fognav_number_milli(const char* text, uint32_t size, int64_t* value) {
    fognav::JsonReader json(text, size);
    return json.number_milli(*value) && json.at_end() ? 1 : 0;
}

// 1 if the text is one JSON value.
int fognav_skip(const char* text, uint32_t size) {
    fognav::JsonReader json(text, size);
    return json.skip_value() && json.at_end() ? 1 : 0;
}

}  // extern "C"
