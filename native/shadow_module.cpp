// Python bindings of the shadows; evsplat/models/discs/shadow_grids.py calls them.

#include "bindings.h"
#include "shadow.h"

namespace evsplat {
namespace {

Shadow shadow_of(const In& body, const In& lamps, const In& widths, float strength, bool layered, const In& grids) {
    require(body.ndim() == 3 && body.shape(1) > 0 && body.shape(2) == 3, "the body");
    const size_t count = widths.size();
    require(count >= 1 && count <= size_t(kMaxLamps) && lamps.size() == count * 3, "the lamps");
    const Shadow shadow = {body.shape(0), body.shape(1), int(count), body.data(), lamps.data(), widths.data(), strength, layered};
    require(grids.size() == count * shadow.times * shadow.grid(), "the grids");
    return shadow;
}

ShadowPlaces places_of(const Shadow& shadow, const In& places, const std::optional<In>& shares, size_t results) {
    require(shadow.layered != shares.has_value() && (!shares || shares->size() == size_t(shadow.lamps)), "the shares");
    const size_t count = places.size() / 3 / (shadow.layered ? shadow.times : 1);
    require(places.size() == count * 3 * (shadow.layered ? shadow.times : 1), "the places");
    require(results == count * shadow.times * (shadow.layered ? shadow.lamps : 1), "the result");
    return {count, places.data(), data_of(shares)};
}

void py_cast(In body, In places, In lamps, In widths, std::optional<In> shares, float strength, Out grids, Out result,
             int threads) {
    const Shadow shadow = shadow_of(body, lamps, widths, strength, !shares, In(grids));
    const ShadowPlaces at = places_of(shadow, places, shares, result.size());
    nb::gil_scoped_release release;
    cast_shadow(shadow, at, threads, grids.data(), result.data());
}

void py_cast_backward(In body, In places, In lamps, In widths, std::optional<In> shares, float strength, In grids,
                      In above, std::optional<Out> body_grad, std::optional<Out> places_grad, Out lamps_grad,
                      Out widths_grad, std::optional<Out> shares_grad, int threads) {
    const Shadow shadow = shadow_of(body, lamps, widths, strength, !shares, grids);
    const ShadowPlaces at = places_of(shadow, places, shares, above.size());
    require(!body_grad || body_grad->size() == body.size(), "the body's gradient");
    require(!places_grad || (!shadow.layered && places_grad->size() == places.size()), "the places' gradient");
    require(lamps_grad.size() == lamps.size() && widths_grad.size() == widths.size() &&
                shares_grad.has_value() == shares.has_value() && (!shares || shares_grad->size() == shares->size()),
            "the lamps' gradients");
    nb::gil_scoped_release release;
    cast_shadow_backward(shadow, at, grids.data(), above.data(), threads,
                         {data_of(body_grad), lamps_grad.data(), widths_grad.data(), data_of(shares_grad),
                          data_of(places_grad)});
}

}  // namespace

void bind_shadow(nb::module_& m) {
    m.def("shadow_grid", [](bool layered) { return Shadow{0, 0, 0, {}, {}, {}, 0.f, layered}.grid(); },
          nb::arg("layered"), "Floats of the grid of one lamp at one time.");
    m.def("cast_shadow", &py_cast, nb::arg("body"), nb::arg("places"), nb::arg("lamps"), nb::arg("widths"),
          nb::arg("shares").none(), nb::arg("strength"), nb::arg("grids"), nb::arg("result"), nb::arg("threads"),
          "Shadows of a body on the scene or, without shares, on itself; writes what going back needs.");
    m.def("cast_shadow_backward", &py_cast_backward, nb::arg("body"), nb::arg("places"), nb::arg("lamps"),
          nb::arg("widths"), nb::arg("shares").none(), nb::arg("strength"), nb::arg("grids"), nb::arg("above"),
          nb::arg("body_grad").none(), nb::arg("places_grad").none(), nb::arg("lamps_grad"), nb::arg("widths_grad"),
          nb::arg("shares_grad").none(), nb::arg("threads"),
          "Gradients of the body's points, the scene's places, the lamps, their widths and shares.");
}

}  // namespace evsplat
