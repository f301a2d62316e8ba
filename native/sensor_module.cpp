// Python bindings of the simulated sensor; evsplat/events/simulator.py calls them.

#include "bindings.h"
#include "sensor.h"

using namespace evsplat;

namespace {

using Plane = nb::ndarray<const float, nb::ndim<2>, nb::c_contig, nb::device::cpu>;

class PySensor {
  public:
    PySensor(Plane on, Plane off, std::optional<Plane> leak, std::optional<Plane> phase, std::optional<Plane> hot_hz,
             bool lin_log, float eps, float cutoff_hz, float shot_hz, double refractory_us, uint64_t seed)
        : height_(on.shape(0)), width_(on.shape(1)) {
        require(width_ > 0 && width_ <= 65536 && height_ > 0 && height_ <= 65536, "the sensor");
        require(width_ * height_ < size_t(1) << 31, "the sensor");
        const auto plane = [&](const std::optional<Plane>& p) -> const float* {
            if (!p) return nullptr;
            check(*p);
            return p->data();
        };
        const SensorModel model = {lin_log, eps, cutoff_hz, shot_hz, refractory_us, seed};
        sensor_.emplace(int(width_), int(height_), model,
                        PixelSettings{plane(on), plane(off), plane(leak), plane(phase), plane(hot_hz)});
    }

    bool step(Plane luma, int64_t time_us, int threads) {
        check(luma);
        nb::gil_scoped_release release;
        return sensor_->step(luma.data(), time_us, threads);
    }

    size_t count() const { return sensor_->count(); }

    void take(Column<int64_t> t, Column<uint16_t> x, Column<uint16_t> y, Column<int8_t> p) const {
        const size_t n = sensor_->count();
        require(t.size() == n && x.size() == n && y.size() == n && p.size() == n, "the events");
        nb::gil_scoped_release release;
        sensor_->take(t.data(), x.data(), y.data(), p.data());
    }

  private:
    void check(const Plane& p) const {
        require(p.shape(0) == height_ && p.shape(1) == width_, "an array of the sensor");
    }

    size_t height_, width_;
    std::optional<Sensor> sensor_;
};

}  // namespace

void evsplat::bind_sensor(nb::module_& m) {
    nb::class_<PySensor>(m, "Sensor", "An event camera: the state of its pixels, moved from picture to picture.")
        .def(nb::init<Plane, Plane, std::optional<Plane>, std::optional<Plane>, std::optional<Plane>, bool, float, float,
                      float, double, uint64_t>(),
             nb::arg("on"), nb::arg("off"), nb::arg("leak").none(), nb::arg("phase").none(), nb::arg("hot_hz").none(),
             nb::arg("lin_log"), nb::arg("eps"), nb::arg("cutoff_hz"), nb::arg("shot_hz"), nb::arg("refractory_us"),
             nb::arg("seed"))
        .def("step", &PySensor::step, nb::arg("luma"), nb::arg("time_us"), nb::arg("threads"),
             "Move to a later picture; False where a value is not finite.")
        .def_prop_ro("count", &PySensor::count, "Events of the last step.")
        .def("take", &PySensor::take, nb::arg("t"), nb::arg("x"), nb::arg("y"), nb::arg("p"),
             "Write the events of the last step, sorted by time.");
}
