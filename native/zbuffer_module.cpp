// Python bindings of the z-buffer renderer; evsplat/staging/renderer.py calls them.

#include "bindings.h"
#include "thread_pool.h"
#include "zbuffer.h"

using namespace evsplat;

namespace {

using Floats = In;
using Ints = Array<const int32_t>;
using Bytes = Array<const uint8_t>;

void require_below(const Ints& indices, size_t limit, const char* what) {
    for (size_t i = 0; i < indices.size(); ++i) require(indices.data()[i] >= 0 && size_t(indices.data()[i]) < limit, what);
}

zbuffer::Texture texture_of(const std::vector<Floats>& levels, const char* what) {
    require(!levels.empty() && levels.size() <= zbuffer::kMaxLevels, what);
    zbuffer::Texture t;
    t.levels = int(levels.size());
    for (int k = 0; k < t.levels; ++k) {
        const Floats& level = levels[k];
        require(level.ndim() == 4 && level.shape(3) == 3 && level.size() > 0, what);
        if (k == 0) t.layers = int(level.shape(0)), t.height = int(level.shape(1)), t.width = int(level.shape(2));
        require(int(level.shape(0)) == t.layers && int(level.shape(1)) == t.height >> k && int(level.shape(2)) == t.width >> k,
                what);
        t.level[k] = level.data();
    }
    return t;
}

class Stage {
  public:
    Stage(Floats corners, Floats normals, Floats uv, Ints layer, Floats tint, Floats direct, Floats ambient,
          std::vector<Floats> room_texture, Ints faces, Floats person_uv, Bytes cutout, Ints bones, Floats weights,
          Ints contact, Floats rest_joints, std::vector<Floats> atlas, Bytes alpha, zbuffer::Light light)
        : floats_{corners, normals, uv, tint, direct, ambient, person_uv, weights, rest_joints},
          ints_{layer, faces, bones, contact}, bytes_{cutout, alpha}, light_(light) {
        floats_.insert(floats_.end(), room_texture.begin(), room_texture.end());
        floats_.insert(floats_.end(), atlas.begin(), atlas.end());
        const size_t f = layer.size();
        require(corners.size() == 9 * f && normals.size() == 3 * f && uv.size() == 6 * f && tint.size() == 3 * f &&
                    direct.size() == 3 * f && ambient.size() == 9 * f,
                "the room");
        room_.triangles = f, room_.corners = corners.data(), room_.normals = normals.data(), room_.uv = uv.data();
        room_.layer = layer.data(), room_.tint = tint.data(), room_.direct = direct.data();
        room_.ambient = ambient.data(), room_.texture = texture_of(room_texture, "the room's texture");
        require_below(layer, room_.texture.layers, "the room's layers");

        require(bones.ndim() == 2 && weights.size() == bones.size() && rest_joints.ndim() == 2 && faces.ndim() == 2,
                "the person");
        person_.vertices = bones.shape(0), person_.influences = bones.shape(1), person_.triangles = faces.shape(0);
        person_.joints = rest_joints.shape(0), person_.contacts = contact.size();
        require(faces.shape(1) == 3 && rest_joints.shape(1) == 3 && person_uv.size() == 2 * person_.vertices &&
                    cutout.size() == person_.triangles,
                "the person");
        require_below(faces, person_.vertices, "the person's faces");
        require_below(bones, person_.joints, "the person's bones");
        require_below(contact, person_.joints, "the contacts");
        person_.faces = faces.data(), person_.uv = person_uv.data(), person_.cutout = cutout.data();
        person_.bones = bones.data(), person_.weights = weights.data(), person_.contact = contact.data();
        person_.rest_joints = rest_joints.data(), person_.texture = texture_of(atlas, "the atlas");
        person_.alpha = alpha.data();
        require(alpha.size() == size_t(person_.texture.width) * person_.texture.height, "the atlas's alpha");
        require(light.shadow_size > 0 && light.shadow_size <= 1 << 14, "the shadow map");
    }

    // One instant per set of bones; one view, or one per instant.
    void draw(Floats k, Floats world_to_camera, Floats bones, Floats vertices, Floats normals, bool shadows, int samples,
              Out image, int threads) {
        require(bones.ndim() == 4 && bones.shape(1) == person_.joints && bones.shape(2) == 4 && bones.shape(3) == 4, "bones");
        const size_t times = bones.shape(0);
        require(image.ndim() == 4 && image.shape(0) == times && image.shape(3) == 4, "the image");
        require(k.size() == 9 && world_to_camera.ndim() == 3 && world_to_camera.shape(1) == 4 && world_to_camera.shape(2) == 4,
                "the camera");
        const size_t views = world_to_camera.shape(0), shapes = vertices.ndim() == 3 ? vertices.shape(0) : 0;
        require(views == times || views == 1, "the camera");
        require((shapes == times || shapes == 1) && vertices.size() == shapes * 3 * person_.vertices &&
                    normals.size() == vertices.size(),
                "vertices or normals");
        const size_t height = image.shape(1), width = image.shape(2);
        require(height > 0 && width > 0 && height <= 1 << 14 && width <= 1 << 14 && samples > 0 && samples <= 8, "the image");
        const auto view_of = [&](size_t t) {
            zbuffer::View v;
            v.width = int(width), v.height = int(height);
            v.fx = k.data()[0], v.cx = k.data()[2], v.fy = k.data()[4], v.cy = k.data()[5];
            const float* pose = world_to_camera.data() + 16 * t;
            for (int i = 0; i < 3; ++i) {
                for (int j = 0; j < 3; ++j) v.r[3 * i + j] = pose[4 * i + j];
                v.t[i] = pose[4 * i + 3];
            }
            return v;
        };
        const size_t step = shapes == 1 ? 0 : 3 * person_.vertices;
        nb::gil_scoped_release release;
        const bool still = views == 1;
        if (still) {
            const zbuffer::View view = view_of(0);
            // a camera that stands still sees the same room in every call
            if (!(layers_.view == view) || layers_.samples != samples) layers_ = zbuffer::draw_room(room_, view, samples);
        }
        run(threads, times, [&](size_t t) {
            const zbuffer::Pose pose = {bones.data() + t * 16 * person_.joints, vertices.data() + t * step,
                                        normals.data() + t * step};
            float* out = image.data() + t * 4 * width * height;
            if (still)
                zbuffer::draw_person(person_, light_, layers_, pose, shadows, out);
            else
                zbuffer::draw_person(person_, light_, zbuffer::draw_room(room_, view_of(t), samples), pose, shadows, out);
        });
    }

  private:
    // The arrays keep the memory alive that room_ and person_ point into.
    std::vector<Floats> floats_;
    std::vector<Ints> ints_;
    std::vector<Bytes> bytes_;
    zbuffer::Room room_;
    zbuffer::Person person_;
    zbuffer::Light light_;
    zbuffer::Layers layers_;
};

}  // namespace

void evsplat::bind_zbuffer(nb::module_& m) {
    using zbuffer::Light;
    nb::class_<Light>(m, "Light", "A lamp, light from all around, and how surfaces answer; metres and texels.")
        .def(nb::init<>())
        .def_rw("position", &Light::position)
        .def_rw("facing", &Light::facing)
        .def_rw("power", &Light::power)
        .def_rw("world_to_light", &Light::world_to_light)
        .def_rw("shadow_focal", &Light::shadow_focal)
        .def_rw("shadow_radius", &Light::shadow_radius)
        .def_rw("shadow_size", &Light::shadow_size)
        .def_rw("shadow_bias", &Light::shadow_bias)
        .def_rw("ambient_below", &Light::ambient_below)
        .def_rw("ambient_above", &Light::ambient_above)
        .def_rw("rim", &Light::rim)
        .def_rw("wrap", &Light::wrap)
        .def_rw("specular", &Light::specular)
        .def_rw("shininess", &Light::shininess);
    nb::class_<Stage>(m, "Stage", "A person in a room, drawn with a z-buffer.")
        .def(nb::init<Floats, Floats, Floats, Ints, Floats, Floats, Floats, std::vector<Floats>, Ints, Floats, Bytes, Ints,
                      Floats, Ints, Floats, std::vector<Floats>, Bytes, Light>(),
             nb::arg("corners"), nb::arg("normals"), nb::arg("uv"), nb::arg("layer"), nb::arg("tint"), nb::arg("direct"),
             nb::arg("ambient"), nb::arg("room_texture"), nb::arg("faces"), nb::arg("person_uv"), nb::arg("cutout"),
             nb::arg("bones"), nb::arg("weights"), nb::arg("contact"), nb::arg("rest_joints"), nb::arg("atlas"),
             nb::arg("alpha"), nb::arg("light"))
        .def("draw", &Stage::draw, nb::arg("K"), nb::arg("world_to_camera"), nb::arg("bones"), nb::arg("vertices"),
             nb::arg("normals"), nb::arg("shadows"), nb::arg("samples"), nb::arg("image"), nb::arg("threads"),
             "Writes linear RGB and the person's share of each pixel, (T, H, W, 4).");
}
