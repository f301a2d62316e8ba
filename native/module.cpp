// Python bindings of the rasteriser, of networks and of kernels on pictures.

#include <memory>

#include "bindings.h"
#include "kept_memory.h"
#include "levels.h"
#include "mlp.h"
#include "picture.h"
#include "rasterizer.h"
#include "skinning.h"
#include "ssim.h"

using namespace evsplat;

namespace {

using Fields = std::vector<std::optional<In>>;  // means, quaternions, scales, opacities, channels, linear, offset
using OutFields = std::vector<std::optional<Out>>;
using OutInt = Array<int32_t>;
using Camera = nb::ndarray<const float, nb::shape<3, 3>, nb::c_contig, nb::device::cpu>;
using Pose = nb::ndarray<const float, nb::shape<4, 4>, nb::c_contig, nb::device::cpu>;

// (T or 1, count, inner...) with `inner` floats per Gaussian.
template <class Given>
size_t step_of(const Given& a, size_t times, size_t count, size_t inner, const char* what) {
    require(a.ndim() >= 1 && (a.shape(0) == times || a.shape(0) == 1), what);
    require(a.size() == a.shape(0) * count * inner, what);
    return a.shape(0) == 1 ? 0 : count * inner;
}

constexpr size_t kInner[] = {3, 4, 3, 1, 0, 9, 2};  // floats per Gaussian of each field; 0: the channels
constexpr const char* kFieldNames[] = {"means", "quaternions", "scales", "opacities", "channels", "linear", "offset"};
constexpr size_t kFields = 7, kMeans = 0, kChannels = 4;

template <class T>
FieldOf<T>& field_of(LayerOf<T>& l, size_t i) {
    FieldOf<T>* fields[] = {&l.means, &l.quaternions, &l.scales, &l.opacities, &l.values, &l.linear, &l.offset};
    return *fields[i];
}

class Render {
  public:
    Render(int width, int height, const Camera& k, const Pose& pose, float near_plane, float low_pass, Fields moving,
           Fields still, std::optional<In> background, std::optional<In> light, int times, int threads)
        : moving_(std::move(moving)), still_(std::move(still)), background_(background), light_(light), threads_(threads) {
        require(width > 0 && height > 0 && width <= 1 << 16 && height <= 1 << 16 && times > 0, "the image");
        View& v = scene_.view;
        for (int i = 0; i < 3; ++i) {
            for (int j = 0; j < 3; ++j) v.r[3 * i + j] = pose.data()[4 * i + j];
            v.t[i] = pose.data()[4 * i + 3];
        }
        v.fx = k.data()[0], v.cx = k.data()[2], v.fy = k.data()[4], v.cy = k.data()[5];
        v.near_plane = near_plane, v.low_pass = low_pass;
        v.width = width, v.height = height;
        v.tiles_x = (width + kTile - 1) / kTile, v.tiles_y = (height + kTile - 1) / kTile;
        scene_.times = times;
        require(moving_.size() == kFields && moving_[kChannels] && moving_[kChannels]->ndim() == 3, "channels");
        const size_t c = moving_[kChannels]->shape(2);
        require(c > 0 && c < 65536, "channels");
        scene_.channels = int(c);
        fill(scene_.moving, moving_, times);
        if (!still_.empty()) fill(scene_.still, still_, 1);
        require(size_t(scene_.moving.count) + scene_.still.count < size_t(1) << 31, "means");
        scene_.background_is_image = background && background->ndim() == 3;
        if (background) {
            require(background->size() == c * (scene_.background_is_image ? size_t(width) * height : 1), "background");
            scene_.background = background->data();
        }
        if (light) {
            require(light->size() == size_t(times) * width * height && c >= kLitChannels && c <= kMaxChannels, "the light");
            scene_.light = light->data();
        }
    }

    // With `keep` a later render can take the still layer over; `earlier` is one that kept the same.
    void forward(Out image, Out alpha, OutInt radii, OutInt still_radii, bool keep, const Render* earlier) {
        const size_t pixels = size_t(scene_.view.width) * scene_.view.height * scene_.times;
        require(image.size() == pixels * scene_.channels, "image");
        require(alpha.size() == pixels, "alpha");
        require(radii.size() == size_t(scene_.moving.count) * scene_.times, "radii");
        require(still_radii.size() == scene_.still.count, "radii of what stands still");
        std::shared_ptr<Still> still;
        if (earlier) {
            const View &a = scene_.view, &b = earlier->scene_.view;
            require(earlier->record_ && earlier->record_->still->kept && a.width == b.width && a.height == b.height &&
                        earlier->scene_.channels == scene_.channels &&
                        earlier->scene_.still.count == scene_.still.count &&
                        earlier->scene_.moving.count == scene_.moving.count,
                    "the earlier render");
            still = earlier->record_->still;
        }
        nb::gil_scoped_release release;
        record_ = render_forward(scene_, threads_, keep, std::move(still), image.data(), alpha.data(), radii.data(),
                                 still_radii.data());
    }

    // `image_grad`: of groups of channels (H, W, c), of all times of the first group, of all of the second, ...; none is
    // zero, as is an empty list.
    void backward(const std::vector<std::optional<Strided>>& image_grad, const std::vector<size_t>& groups,
                  std::optional<Strided> alpha_grad, OutFields moving, OutFields still, std::optional<Out> view,
                  std::optional<Out> background, std::optional<Out> light) {
        if (!record_) throw std::runtime_error("evsplat._native: backward before forward");
        const size_t h = scene_.view.height, w = scene_.view.width, t = scene_.times, c = scene_.channels;
        OutputGrads out;
        require(image_grad.size() == groups.size() * t, "image gradient");
        out.image.resize(image_grad.empty() ? 0 : t * c);
        size_t first = 0;
        for (size_t g = 0; g < groups.size(); first += groups[g++]) {
            require(groups[g] <= c && first + groups[g] <= c, "image gradient");
            for (size_t i = 0; i < t; ++i) {
                const auto& part = image_grad[g * t + i];
                if (!part) continue;
                require(part->ndim() == 3 && part->shape(0) == h && part->shape(1) == w && part->shape(2) == groups[g],
                        "image gradient");
                for (size_t k = 0; k < groups[g]; ++k)
                    out.image[i * c + first + k] = {part->data() + ptrdiff_t(k) * part->stride(2), part->stride(0),
                                                    part->stride(1)};
            }
        }
        if (alpha_grad) {
            require(alpha_grad->ndim() == 3 && alpha_grad->shape(0) == t && alpha_grad->shape(1) == h &&
                        alpha_grad->shape(2) == w,
                    "alpha gradient");
            for (size_t i = 0; i < t; ++i)
                out.alpha.push_back({alpha_grad->data() + ptrdiff_t(i) * alpha_grad->stride(0), alpha_grad->stride(1),
                                     alpha_grad->stride(2)});
        }
        InputGrads in;
        fill_grads(in.moving, moving, scene_.moving, t);
        fill_grads(in.still, still, scene_.still, 1);
        if (view) {
            require(view->size() == 12, "camera gradient");
            in.view = view->data();
        }
        if (background && scene_.background) {
            require(background->size() == c * (scene_.background_is_image ? h * w : 1), "background gradient");
            in.background = background->data();
        }
        if (light && scene_.light) {
            require(light->size() == t * h * w, "the light's gradient");
            in.light = light->data();
        }
        nb::gil_scoped_release release;
        render_backward(scene_, *record_, threads_, out, in);
    }

    nb::dict seconds() const {
        constexpr const char* names[] = {"project", "sort", "composite", "composite_backward", "project_backward"};
        nb::dict result;
        for (int i = 0; record_ && i < kStages; ++i) result[names[i]] = 1e-9 * double(record_->nanoseconds[i]);
        return result;
    }

    size_t bytes() const { return record_ ? record_->bytes() : 0; }
    size_t intersections() const { return record_ ? record_->intersections() : 0; }
    size_t patch_steps() const { return record_ ? record_->patch_steps() : 0; }

  private:
    size_t inner(size_t field) const { return field == kChannels ? scene_.channels : kInner[field]; }

    void fill(Layer& layer, const Fields& fields, size_t times) {
        require(fields.size() == kFields && fields[kMeans] && fields[kMeans]->ndim() == 3, "means");
        const size_t count = fields[kMeans]->shape(1);
        require(count < size_t(1) << 31, "means");
        layer.count = uint32_t(count);
        for (size_t i = 0; i < kFields; ++i) {
            require(fields[i] || i > kChannels, kFieldNames[i]);
            if (!fields[i]) continue;
            field_of<const float>(layer, i) = {fields[i]->data(),
                                               step_of(*fields[i], times, count, inner(i), kFieldNames[i])};
        }
    }

    void fill_grads(LayerGrads& grads, OutFields& fields, const Layer& layer, size_t times) {
        require(fields.empty() || fields.size() == kFields, "the gradients");
        for (size_t i = 0; i < fields.size(); ++i) {
            const FieldOf<const float>& like = field_of<const float>(const_cast<Layer&>(layer), i);
            if (!fields[i] || !like.data) continue;
            require(step_of(*fields[i], times, layer.count, inner(i), kFieldNames[i]) == like.step, kFieldNames[i]);
            field_of<float>(grads, i) = {fields[i]->data(), like.step};
        }
    }

    // The arrays keep the memory that scene_ points into alive.
    Fields moving_, still_;
    std::optional<In> background_, light_;
    Scene scene_ = {};
    int threads_;
    std::unique_ptr<Record> record_;
};

// Later layers are passed as (weight, bias) pairs in one flat list, as are their gradients.
class PyMlp {
  public:
    PyMlp(In point, std::optional<In> both, In bias, In point_weight, In both_weight, std::vector<In> layers,
          float slope, bool keep, int threads)
        : point_(point), bias_(bias), point_weight_(point_weight), both_weight_(both_weight), both_(both),
          layers_(std::move(layers)) {
        require(point.ndim() == 2 && bias.ndim() == 2 && bias.shape(0) > 0, "point or bias");
        require(point_weight.ndim() == 2 && both_weight.ndim() == 2, "the first layer's weights");
        require(!layers_.empty() && layers_.size() % 2 == 0, "layers");
        MlpInputs in = {};
        in.points = point.shape(0), in.times = bias.shape(0);
        in.per_point = int(point.shape(1)), in.width = int(bias.shape(1)), in.slope = slope;
        require(point_weight.shape(0) == bias.shape(1) && point_weight.shape(1) == point.shape(1), "point_weight");
        if (both) {
            require(both->ndim() == 3 && both->shape(0) == in.times && both->shape(1) == in.points, "both");
            in.per_both = int(both->shape(2)), in.both = both->data();
            require(both_weight.shape(0) == bias.shape(1) && both_weight.shape(1) == both->shape(2), "both_weight");
        }
        in.point = point.data(), in.bias = bias.data();
        in.point_weight = point_weight.data(), in.both_weight = both_weight.data();
        for (size_t l = 0; l < layers_.size(); l += 2) {
            const In &w = layers_[l], &b = layers_[l + 1];
            const bool last = l + 2 == layers_.size();
            require(w.ndim() == 2 && w.shape(1) == bias.shape(1) && b.size() == w.shape(0), "a layer");
            require(last || w.shape(0) == bias.shape(1), "a hidden layer");
            in.weights.push_back(w.data()), in.biases.push_back(b.data());
            in.out = int(w.shape(0));
        }
        in_ = in;
        mlp_ = std::make_unique<Mlp>(in, keep, threads);
    }

    void forward(Out output) {
        require(output.size() == in_.points * in_.times * in_.out, "output");
        nb::gil_scoped_release release;
        mlp_->forward(output.data());
    }

    void backward(In output_grad, std::optional<Out> point, std::optional<Out> both, Out bias, Out point_weight,
                  Out both_weight, std::vector<Out> layers) {
        require(output_grad.size() == in_.points * in_.times * in_.out, "output gradient");
        require(!point || point->size() == point_.size(), "point gradient");
        require(!both || (both_ && both->size() == both_->size()), "both gradient");
        require(bias.size() == bias_.size() && point_weight.size() == point_weight_.size() &&
                    both_weight.size() == both_weight_.size() && layers.size() == layers_.size(),
                "the gradients of parameters");
        MlpGrads grads = {};
        grads.point = data_of(point), grads.both = data_of(both);
        grads.bias = bias.data(), grads.point_weight = point_weight.data(), grads.both_weight = both_weight.data();
        for (size_t l = 0; l < layers.size(); ++l) {
            require(layers[l].size() == layers_[l].size(), "a layer's gradient");
            (l % 2 ? grads.biases : grads.weights).push_back(layers[l].data());
        }
        nb::gil_scoped_release release;
        mlp_->backward(output_grad.data(), grads);
    }

  private:
    In point_, bias_, point_weight_, both_weight_;
    std::optional<In> both_;
    std::vector<In> layers_;
    MlpInputs in_ = {};
    std::unique_ptr<Mlp> mlp_;
};

// Sums over all planes: of the similarity over window positions, whose gradient is `grad`, and of absolute
// differences over pixels.
std::pair<double, double> ssim(In image, In reference, In window, float c1, float c2, std::optional<Out> grad, int threads) {
    require(image.ndim() == 3 && image.size() == reference.size() && window.size() == kSsimWindow, "the images");
    const size_t planes = image.shape(0), height = image.shape(1), width = image.shape(2);
    require(height >= kSsimWindow && width >= kSsimWindow && height < 1 << 20 && width < 1 << 20, "the images");
    require(!grad || grad->size() == image.size(), "the gradient");
    nb::gil_scoped_release release;
    const SsimSums sums = ssim_planes(planes, int(height), int(width), image.data(), reference.data(), window.data(),
                                      c1, c2, threads, data_of(grad));
    return {sums.similarity, sums.difference};
}

// Means in the windows of (n, H, W) planes with `pad` zeros around them.
void ssim_window_means(Array<const double> planes, Column<const double> window, int pad, Array<double> means, int threads) {
    require(planes.ndim() == 3 && means.ndim() == 3 && means.shape(0) == planes.shape(0), "the planes");
    require(planes.shape(1) < 1 << 20 && planes.shape(2) < 1 << 20, "the planes");
    require(window.size() > 0 && window.size() < 1 << 10 && pad >= 0 && size_t(pad) < window.size(), "the window");
    const WindowMeans job = {int(planes.shape(1)), int(planes.shape(2)), int(window.size()), pad, planes.data(),
                             window.data(), means.data()};
    require(job.rows() > 0 && job.columns() > 0, "the window");
    require(means.shape(1) == size_t(job.rows()) && means.shape(2) == size_t(job.columns()), "the means");
    nb::gil_scoped_release release;
    window_means(job, planes.shape(0), threads);
}

void picture_share_of_range(Array<const uint8_t> levels, Out shares, int threads) {
    require(shares.size() == levels.size(), "the shares");
    nb::gil_scoped_release release;
    share_of_range(levels.data(), levels.size(), threads, shares.data());
}

void picture_add_sign(In image, In reference, float by_difference, float scale, Out grad, int threads) {
    require(image.size() == reference.size() && grad.size() == image.size(), "the pictures");
    nb::gil_scoped_release release;
    add_sign(image.data(), reference.data(), by_difference, scale, image.size(), threads, grad.data());
}

void picture_power(In from, float exponent, Out value, std::optional<Out> slope, int threads) {
    require(value.size() == from.size() && (!slope || slope->size() == from.size()), "the picture");
    require(exponent > 1.f, "the exponent: above 1");
    nb::gil_scoped_release release;
    power({from.data(), exponent, value.data(), data_of(slope)}, from.size(), threads);
}

// The planes of pictures (H, W, 3), planar in memory, for a job with places for them.
template <class Job>
void take_pictures(const std::vector<Strided>& pictures, Job& job) {
    require(!pictures.empty() && pictures.size() <= kMostPictures, "the pictures");
    job.pictures = int(pictures.size());
    for (size_t i = 0; i < pictures.size(); ++i) {
        const Strided& p = pictures[i];
        require(p.ndim() == 3 && p.shape(2) == 3, "a picture");
        const size_t count = p.shape(0) * p.shape(1);
        require((!i || count == job.count) && p.stride(1) == 1 && size_t(p.stride(0)) == p.shape(1) && size_t(p.stride(2)) == count,
                "a picture: planar");
        job.coded[i] = p.data(), job.count = count;
    }
}

// Where their gradients go, which follow each other.
template <class Job>
std::vector<float*> gradients_of(const Job& job, const Out& grads) {
    require(grads.size() == 3 * job.pictures * job.count, "the gradients");
    std::vector<float*> to(job.pictures);
    for (int i = 0; i < job.pictures; ++i) to[i] = grads.data() + 3 * i * job.count;
    return to;
}

PowerMean mean_of(const std::vector<Strided>& pictures, float exponent) {
    PowerMean job = {};
    take_pictures(pictures, job);
    job.exponent = exponent;
    return job;
}

void picture_power_mean(const std::vector<Strided>& pictures, float exponent, Out mean, int threads) {
    PowerMean job = mean_of(pictures, exponent);
    require(mean.size() == 3 * job.count, "the mean");
    job.mean = mean.data();
    nb::gil_scoped_release release;
    power_mean(job, threads);
}

void picture_power_mean_backward(const std::vector<Strided>& pictures, float exponent, In above, Out grads, int threads) {
    const PowerMean job = mean_of(pictures, exponent);
    require(above.size() == 3 * job.count, "the mean's gradient");
    const std::vector<float*> to = gradients_of(job, grads);
    nb::gil_scoped_release release;
    power_mean_backward(job, above.data(), threads, to.data());
}

// Whole pictures, or back from their gradient.
void picture_enlarge(In from, int factor, Out to, bool back, int threads) {
    require(from.ndim() == 3 && to.ndim() == 3 && from.shape(0) == to.shape(0) && factor >= 1, "the pictures");
    const auto small = [&](size_t i) { return back ? to.shape(i) : from.shape(i); };
    const auto large = [&](size_t i) { return back ? from.shape(i) : to.shape(i); };
    for (size_t i = 1; i < 3; ++i)
        require(small(i) > 0 && large(i) <= small(i) * factor && large(i) < 1 << 20, "the pictures");
    const Enlarge job = {small(0), int(small(1)), int(small(2)), int(large(1)), int(large(2)), factor};
    nb::gil_scoped_release release;
    (back ? enlarge_backward : enlarge)(job, from.data(), threads, to.data());
}

// `curve`: gamma, the darkest value and eps.
LogBrightness brightness_of(const std::vector<Strided>& pictures, const std::array<float, 3>& weight,
                            const std::array<float, 3>& curve, bool keeps_hue, bool change, size_t values) {
    LogBrightness job = {};
    take_pictures(pictures, job);
    for (int c = 0; c < 3; ++c) job.weight[c] = weight[c];
    job.gamma = curve[0], job.darkest = curve[1], job.eps = curve[2], job.keeps_hue = keeps_hue, job.change = change;
    require(!change || job.pictures == 2, "the pictures: two");
    require(values == job.count * (change ? 1 : job.pictures), "the logarithms");
    return job;
}

void picture_log_brightness(const std::vector<Strided>& pictures, const std::array<float, 3>& weight,
                            const std::array<float, 3>& curve, bool keeps_hue, bool change, Out value, int threads) {
    const LogBrightness job = brightness_of(pictures, weight, curve, keeps_hue, change, value.size());
    nb::gil_scoped_release release;
    log_brightness(job, threads, value.data());
}

void picture_log_brightness_backward(const std::vector<Strided>& pictures, const std::array<float, 3>& weight,
                                     const std::array<float, 3>& curve, bool keeps_hue, bool change, In above, Out grads,
                                     int threads) {
    const LogBrightness job = brightness_of(pictures, weight, curve, keeps_hue, change, above.size());
    const std::vector<float*> to = gradients_of(job, grads);
    nb::gil_scoped_release release;
    log_brightness_backward(job, above.data(), threads, to.data());
}

Skinning skinning(const In& position, const In& weight, const In& bones) {
    require(bones.ndim() == 4 && bones.shape(2) == 4 && bones.shape(3) == 4, "the bones");
    const size_t times = bones.shape(0), joints = bones.shape(1);
    require(position.ndim() == 3 && position.shape(2) == 3, "the points");
    require(weight.ndim() == 3 && weight.shape(2) == joints && weight.shape(1) == position.shape(1), "the weights");
    const size_t points = position.shape(1);
    require(position.shape(0) == times || position.shape(0) == 1, "the points");
    require(weight.shape(0) == times || weight.shape(0) == 1, "the weights");
    return {times, points, joints, position.data(), weight.data(), position.shape(0) == 1 ? 0 : points * 3,
            weight.shape(0) == 1 ? 0 : points * joints, bones.data()};
}

void blend_skin(In position, In weight, In bones, Out moved, Out blended, std::optional<Out> linear, int threads) {
    const Skinning job = skinning(position, weight, bones);
    const size_t rows = job.times * job.points;
    require(moved.size() == rows * 3 && blended.size() == rows * 16 && (!linear || linear->size() == rows * 9),
            "the result");
    nb::gil_scoped_release release;
    skin(job, threads, moved.data(), blended.data(), data_of(linear));
}

void blend_skin_backward(In position, In weight, In bones, In blended, std::optional<In> moved_grad,
                         std::optional<In> blended_grad, std::optional<In> linear_grad,
                         std::optional<Out> position_grad, std::optional<Out> weight_grad,
                         std::optional<Out> bones_grad, int threads) {
    const Skinning job = skinning(position, weight, bones);
    const size_t rows = job.times * job.points;
    require(blended.size() == rows * 16 && (!moved_grad || moved_grad->size() == rows * 3) &&
                (!blended_grad || blended_grad->size() == rows * 16) &&
                (!linear_grad || linear_grad->size() == rows * 9),
            "the result's gradient");
    require((!position_grad || position_grad->size() == position.size()) &&
                (!weight_grad || weight_grad->size() == weight.size()) &&
                (!bones_grad || bones_grad->size() == bones.size()),
            "the gradients");
    const SkinningGrads grads = {data_of(moved_grad),    data_of(blended_grad), data_of(linear_grad),
                                 data_of(position_grad), data_of(weight_grad),  data_of(bones_grad), nullptr, 0};
    nb::gil_scoped_release release;
    skin_backward(job, blended.data(), grads, threads);
}

double multiply_add(int64_t rounds) {
    float sink = 0.f;
    nb::gil_scoped_release release;
    return select_kernels().multiply_add(rounds, &sink);
}

}  // namespace

NB_MODULE(_native, m) {
    m.doc() = "CPU kernels of evsplat.";
    nb::set_leak_warnings(false);  // images alive when the interpreter ends are no leak
    nb::class_<Render>(m, "Render", "One render of T times; keeps what its backward pass needs.")
        .def(nb::init<int, int, const Camera&, const Pose&, float, float, Fields, Fields, std::optional<In>,
                      std::optional<In>, int, int>(),
             nb::arg("width"), nb::arg("height"), nb::arg("K"), nb::arg("world_to_camera"), nb::arg("near"),
             nb::arg("low_pass"), nb::arg("moving"), nb::arg("still"), nb::arg("background").none(),
             nb::arg("light").none(), nb::arg("times"), nb::arg("threads"))
        .def("forward", &Render::forward, nb::arg("image"), nb::arg("alpha"), nb::arg("radii"),
             nb::arg("still_radii"), nb::arg("keep") = false, nb::arg("earlier").none() = nb::none())
        .def("backward", &Render::backward, nb::arg("image_grad"), nb::arg("groups"), nb::arg("alpha_grad").none(),
             nb::arg("moving"), nb::arg("still"), nb::arg("view").none(), nb::arg("background").none(),
             nb::arg("light").none())
        .def_prop_ro("seconds", &Render::seconds, "Work so far by stage, summed over threads.")
        .def_prop_ro("bytes", &Render::bytes, "Memory kept for the backward pass.")
        .def_prop_ro("intersections", &Render::intersections, "Pairs of Gaussian and tile.")
        .def_prop_ro("patch_steps", &Render::patch_steps, "Pairs of Gaussian and patch.");
    nb::class_<PyMlp>(m, "Mlp", "One evaluation of a network; keeps what its backward pass needs.")
        .def(nb::init<In, std::optional<In>, In, In, In, std::vector<In>, float, bool, int>(), nb::arg("point"),
             nb::arg("both").none(), nb::arg("bias"), nb::arg("point_weight"), nb::arg("both_weight"),
             nb::arg("layers"), nb::arg("slope"), nb::arg("keep"), nb::arg("threads"))
        .def("forward", &PyMlp::forward, nb::arg("output"))
        .def("backward", &PyMlp::backward, nb::arg("output_grad"), nb::arg("point").none(), nb::arg("both").none(),
             nb::arg("bias"), nb::arg("point_weight"), nb::arg("both_weight"), nb::arg("layers"));
    m.def("ssim", &ssim, nb::arg("image"), nb::arg("reference"), nb::arg("window"), nb::arg("c1"), nb::arg("c2"),
          nb::arg("grad").none(), nb::arg("threads"),
          "Sums of the structural similarity, whose gradient it writes, and of absolute differences.");
    m.def("window_means", &ssim_window_means, nb::arg("planes"), nb::arg("window"), nb::arg("pad"), nb::arg("means"),
          nb::arg("threads"), "Weighted means in the windows of planes with zeros around them, float64.");
    m.def("share_of_range", &picture_share_of_range, nb::arg("levels"), nb::arg("shares"), nb::arg("threads"),
          "Values of 8 bits as shares of their range.");
    m.def("add_sign", &picture_add_sign, nb::arg("image"), nb::arg("reference"), nb::arg("by_difference"),
          nb::arg("scale"), nb::arg("grad"), nb::arg("threads"),
          "grad = by_difference * sign(image - reference) + scale * grad.");
    m.def("power", &picture_power, nb::arg("given"), nb::arg("exponent"), nb::arg("value"), nb::arg("slope").none(),
          nb::arg("threads"), "value = max(from, 0)^exponent, and its slope.");
    m.def("power_mean", &picture_power_mean, nb::arg("pictures"), nb::arg("exponent"), nb::arg("mean"),
          nb::arg("threads"), "Mean of planar pictures' max(coded, 0)^exponent.");
    m.def("power_mean_backward", &picture_power_mean_backward, nb::arg("pictures"), nb::arg("exponent"),
          nb::arg("above"), nb::arg("grads"), nb::arg("threads"));
    m.def("enlarge", &picture_enlarge, nb::arg("given"), nb::arg("factor"), nb::arg("to"), nb::arg("back"),
          nb::arg("threads"), "Pictures enlarged bilinearly, or the gradient of the small ones.");
    m.def("log_brightness", &picture_log_brightness, nb::arg("pictures"), nb::arg("weight"), nb::arg("curve"),
          nb::arg("keeps_hue"), nb::arg("change"), nb::arg("value"), nb::arg("threads"),
          "Logarithm of the luminance of planar pictures' coded values, or its change between two.");
    m.def("log_brightness_backward", &picture_log_brightness_backward, nb::arg("pictures"), nb::arg("weight"),
          nb::arg("curve"), nb::arg("keeps_hue"), nb::arg("change"), nb::arg("above"), nb::arg("grads"), nb::arg("threads"));
    m.def("skin", &blend_skin, nb::arg("position"), nb::arg("weight"), nb::arg("bones"), nb::arg("moved"),
          nb::arg("blended"), nb::arg("linear").none(), nb::arg("threads"), "Linear blend skinning.");
    m.def("skin_backward", &blend_skin_backward, nb::arg("position"), nb::arg("weight"), nb::arg("bones"),
          nb::arg("blended"), nb::arg("moved_grad").none(), nb::arg("blended_grad").none(),
          nb::arg("linear_grad").none(), nb::arg("position_grad").none(), nb::arg("weight_grad").none(), nb::arg("bones_grad").none(),
          nb::arg("threads"), "Writes the gradients of skin.");
    bind_geometry(m);
    bind_sensor(m);
    bind_shadow(m);
    bind_step(m);
    bind_events(m);
    m.def("lanes", [] { return select_kernels().lanes; }, "Pixels per patch of the SIMD level in use.");
    m.def("levels", &available_levels, "SIMD levels that run here, best first.");
    m.def("level", [] { return std::string(select_kernels().name); }, "SIMD level in use.");
    m.def("keep_freed_memory", &keep_freed_memory,
          "Let the C library keep what is freed for what asks next, in huge pages; false where it is not glibc.");
    m.def("multiply_add", &multiply_add, nb::arg("rounds"),
          "Run independent multiply-adds; returns the floating-point operations done.");
    bind_zbuffer(m);
}
