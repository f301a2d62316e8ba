// Python bindings of the event decoders, which evsplat/events/formats/words.py and text.py call, and of event windows.

#include <tuple>

#include "bindings.h"
#include "event_text.h"
#include "event_windows.h"
#include "event_words.h"

namespace evsplat {
namespace {

using State = nb::ndarray<int64_t, nb::shape<sizeof(EventState) / sizeof(int64_t)>, nb::c_contig, nb::device::cpu>;

EventWords words_of(const std::string& kind) {
    constexpr const char* names[] = {"evt2", "evt21", "evt21_swapped", "evt3", "es_dvs", "es_atis"};
    for (int i = 0; i < 6; ++i)
        if (kind == names[i]) return EventWords(i);
    throw std::invalid_argument("evsplat._native: no event words " + kind);
}

std::tuple<size_t, size_t> decode(const std::string& kind, Column<const uint8_t> data, State state, Column<int64_t> t,
                                  Column<uint16_t> x, Column<uint16_t> y, Column<int8_t> p) {
    const EventWords words = words_of(kind);
    const size_t capacity = t.size();
    require(x.size() == capacity && y.size() == capacity && p.size() == capacity, "the columns");
    size_t events = 0;
    nb::gil_scoped_release release;
    const size_t taken = decode_events(words, data.data(), data.size(), *reinterpret_cast<EventState*>(state.data()),
                                       {t.data(), x.data(), y.data(), p.data(), capacity}, events);
    return {taken, events};
}

std::tuple<size_t, size_t, int, int> parse(Column<const uint8_t> text, bool last, std::vector<int> roles,
                                           const std::string& delimiter, int time_exponent,
                                           nb::ndarray<int64_t, nb::ndim<2>, nb::c_contig, nb::device::cpu> columns) {
    require(columns.shape(0) == kTextComponents && !roles.empty(), "the columns t, x, y, p");
    for (const int role : roles) require(role >= -1 && role < kTextComponents, "the roles");
    int64_t* pointers[kTextComponents];
    for (int i = 0; i < kTextComponents; ++i) pointers[i] = columns.data() + i * columns.shape(1);
    const TextLayout layout = {roles.data(), int(roles.size()), delimiter.empty() ? '\0' : delimiter[0], time_exponent};
    nb::gil_scoped_release release;
    const TextResult result = parse_events(reinterpret_cast<const char*>(text.data()), text.size(), last, layout,
                                           columns.shape(1), pointers);
    return {result.rows, result.bytes, int(result.error), result.field};
}

void py_window_counts(Column<const int64_t> t, Column<const uint16_t> x, Column<const uint16_t> y, Column<const int8_t> p,
                      Column<const int64_t> times, int64_t reach, Out maps) {
    const size_t count = times.size();
    require(x.size() == t.size() && y.size() == t.size() && p.size() == t.size(), "the columns");
    require(count >= 2 && maps.ndim() == 4 && maps.shape(0) == count - 1 && maps.shape(1) == 2, "the maps");
    const size_t height = maps.shape(2), width = maps.shape(3);
    for (size_t i = 0; i < t.size(); ++i) require(x.data()[i] < width && y.data()[i] < height, "the maps: events outside");
    nb::gil_scoped_release release;
    window_counts({t.size(), t.data(), x.data(), y.data(), p.data(), height, width}, times.data(), count, reach, maps.data());
}

std::array<double, 4> py_window_difference(In brightness, In maps, std::optional<In> drift, In sound, In weights,
                                           float whole, const std::array<float, 2>& thresholds, Out slope, int threads) {
    const size_t windows = weights.size(), pixels = sound.size();
    require(brightness.size() == (windows + 1) * pixels && slope.size() == brightness.size(), "the brightness");
    require(maps.size() == windows * 2 * pixels && (!drift || drift->size() == windows * pixels), "the maps");
    nb::gil_scoped_release release;
    const WindowSums sums = window_difference({windows, pixels, brightness.data(), maps.data(), data_of(drift), sound.data(),
                                               weights.data(), whole, thresholds[0], thresholds[1]},
                                              threads, slope.data());
    return {sums.value, sums.on, sums.off, sums.lag};
}

}  // namespace

void bind_events(nb::module_& m) {
    m.def("decode_events", &decode, nb::arg("kind"), nb::arg("data"), nb::arg("state"), nb::arg("t"), nb::arg("x"),
          nb::arg("y"), nb::arg("p"), "Words into columns; gives the bytes taken and the events written.");
    m.def("parse_events", &parse, nb::arg("text"), nb::arg("last"), nb::arg("roles"), nb::arg("delimiter"),
          nb::arg("time_exponent"), nb::arg("columns"),
          "Lines into columns t, x, y, p; gives rows, bytes, error and the field that it is in.");
    m.def("window_counts", &py_window_counts, nb::arg("t"), nb::arg("x"), nb::arg("y"), nb::arg("p"), nb::arg("times"),
          nb::arg("reach"), nb::arg("maps"), "Adds events between neighbouring times, by polarity, to maps.");
    m.def("window_difference", &py_window_difference, nb::arg("brightness"), nb::arg("maps"), nb::arg("drift").none(),
          nb::arg("sound"), nb::arg("weights"), nb::arg("whole"), nb::arg("thresholds"), nb::arg("slope"),
          nb::arg("threads"),
          "Weighted size of what events do not explain, its slopes by thresholds and lag; writes that by brightness.");
}

}  // namespace evsplat
