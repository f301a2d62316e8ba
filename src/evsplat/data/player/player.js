// The page: what it holds, what the reader does.

const find = (id) => document.getElementById(id);
const avatar = JSON.parse(find("data").textContent);
const bytes = (text) => Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
const floats = (text) => new Float32Array(bytes(text).buffer);

const skeleton = new Skeleton(avatar.skeleton);
const clips = avatar.clips.map((clip) => ({
  ...clip, rotations: floats(clip.rotations), transl: floats(clip.transl),
  length: (clip.count - 1) / clip.rate_hz,
}));
const joints = skeleton.names.length;
const state = { clip: 0, time: 0, playing: true, speed: 1, rest: false, scene: true, exact: null, preset: null };

const canvas = find("picture");
// Of recorded poses, and of all others, where neighbours on the skin stay together and nothing
// reaches far off the body.
const skins = [avatar.skin, avatar.skin.elsewhere ?? avatar.skin].map((skin) => {
  const bones = bytes(skin.bones), weights = bytes(skin.weights), sizes = skin.sizes && bytes(skin.sizes);
  return {
    bones: (row, k) => bones[4 * row + k], weights: (row, k) => weights[4 * row + k] / 255,
    size: (row) => (sizes ? sizes[row] / 255 : 1),
  };
});
const clouds = [{
  count: avatar.person.count, values: floats(avatar.person.values), skins,
  normals: avatar.light ? floats(avatar.light.normals) : null,
}];
if (avatar.scene) {
  clouds.push({
    count: avatar.scene.count, values: floats(avatar.scene.values),
    skins: skins.map(() => ({ bones: () => joints, weights: (_, k) => (k ? 0 : 1), size: () => 1 })),
  });
}

const correctives = avatar.correctives && new Correctives({ ...avatar.correctives, linear: floats(avatar.correctives.linear) });
const fields = avatar.correctives && {
  ...avatar.correctives, values: new Int8Array(bytes(avatar.correctives.values).buffer),
};

let renderer = null;
try {
  const linear = avatar.transfer === "linear";
  renderer = new SplatRenderer(canvas, clouds, joints + 1, avatar.low_pass_px2, avatar.camera, avatar.light, fields, linear);
  find("message").hidden = true;
} catch (error) {
  find("message").textContent = error.message;
  throw error;
}
canvas.addEventListener("webglcontextlost", () => {
  find("message").textContent = "The browser has stopped drawing here; reload the page to go on.";
  find("message").hidden = false;
});
const orbit = new Orbit(canvas, avatar.up);

function pose() {
  if (state.preset) return state.preset;
  const moving = skeleton.at(clips[state.clip], state.time);
  if (!state.rest) return moving;
  return { rotations: moving.rotations.map((turn, joint) => (joint ? [1, 0, 0, 0] : turn)), transl: moving.transl };
}

// The first clip is the recording.
const isRecorded = () => !state.preset && !state.rest && state.clip === 0
  && !skeleton.offsets.some((angles) => angles.some((angle) => angle));

// Stand where the recording camera stood and look at the person's depth.
function goHome() {
  const rows = avatar.camera.world_to_camera.slice(0, 3);
  const place = [0, 1, 2].map((c) => -rows.reduce((sum, row) => sum + row[c] * row[3], 0));
  const forward = rows[2].slice(0, 3);
  const root = V.plus(skeleton.rest[0], skeleton.at(clips[0], 0).transl);
  orbit.stand(place, forward, Math.max(V.dot(forward, root) + rows[2][3], 0.5));
}

function draw() {
  let { K, width, height, world_to_camera: view } = state.exact ?? avatar.camera;
  let lens = [K[0][0], K[1][1], K[0][2], K[1][2]];
  if (!state.exact) {
    const ratio = Math.min(devicePixelRatio, 2);
    // As much in height as the recording camera saw; on a narrow screen two thirds of its width.
    const focal = K[1][1] * ratio * Math.min(innerHeight / height, (1.5 * innerWidth) / width);
    [width, height] = [Math.round(innerWidth * ratio), Math.round(innerHeight * ratio)];
    lens = [focal, focal, width / 2, height / 2];
    view = orbit.pose();
  }
  if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
  const columns = new Float32Array([0, 1, 2, 3].flatMap((c) => view.map((row) => row[c])));
  const count = state.scene ? renderer.count : avatar.person.count;
  const background = state.exact?.background ?? (state.exact || (avatar.scene && state.scene) ? [0, 0, 0] : [0.08, 0.086, 0.1]);
  const posed = pose();
  const shares = correctives
    ? correctives.shares(posed.rotations.map((_, joint) => skeleton.turned(posed.rotations, joint))) : [];
  renderer.draw(skeleton.bones(posed), columns, lens, background, count, shares, isRecorded() ? 0 : 1);
}

function seek(seconds) {
  state.time = seconds;
  find("time").value = seconds;
  find("clock").textContent = `${seconds.toFixed(2)} s`;
}

// A pose of the list in place of the motion; null goes back to it.
function choosePreset(number) {
  if (number !== null) play(false);
  state.preset = number === null ? null : avatar.presets[number];
  [...find("presets").children].forEach((button, k) => button.setAttribute("aria-pressed", String(k === number)));
}

function play(on) {
  if (on) choosePreset(null);
  state.playing = on;
  find("play").textContent = on ? "❚❚" : "▶";
}

function chooseClip(number) {
  choosePreset(null);
  state.clip = number;
  find("time").max = clips[number].length;
  find("clip").value = number;
  seek(0);
}

function showJoint() {
  const angles = skeleton.offsets[find("joint").value];
  for (const slider of document.querySelectorAll("[data-axis]")) {
    slider.value = angles[slider.dataset.axis];
    slider.nextElementSibling.textContent = `${angles[slider.dataset.axis]}°`;
  }
}

function setOffset(joint, degrees) {
  skeleton.offsets[joint] = [...degrees];
  showJoint();
}

// Joints that people have a name for come first; the others keep that of the file.
const labels = avatar.skeleton.labels;
const named = skeleton.names.map((_, joint) => joint).sort((a, b) => !labels[a] - !labels[b] || a - b);
named.forEach((joint) => find("joint").add(new Option(labels[joint] ?? skeleton.names[joint], joint)));
avatar.presets.forEach(({ name }, number) => {
  const button = document.createElement("button");
  button.textContent = name;
  button.onclick = () => choosePreset(state.preset === avatar.presets[number] ? null : number);
  find("presets").append(button);
});
choosePreset(null);
clips.forEach((clip, number) => find("clip").add(new Option(clip.name, number)));
find("clip").hidden = clips.length < 2;
find("scene-row").hidden = !avatar.scene;
find("note").textContent = avatar.note ?? "";
document.title = avatar.capture ? `${avatar.capture} – avatar` : "Avatar";
find("play").onclick = () => play(!state.playing);
find("time").oninput = (event) => { choosePreset(null); play(false); seek(Number(event.target.value)); };
find("clip").onchange = (event) => chooseClip(Number(event.target.value));
find("speed").onchange = (event) => { state.speed = Number(event.target.value); };
find("home").onclick = goHome;
find("joint").onchange = showJoint;
find("reset-joint").onclick = () => setOffset(find("joint").value, [0, 0, 0]);
find("reset-all").onclick = () => { choosePreset(null); skeleton.offsets.forEach((angles) => angles.fill(0)); showJoint(); };
find("rest").onchange = (event) => { state.rest = event.target.checked; };
find("scene").onchange = (event) => { state.scene = event.target.checked; };
find("fold").onclick = (event) => {
  const open = event.target.getAttribute("aria-expanded") === "true";
  event.target.setAttribute("aria-expanded", String(!open));
};
for (const slider of document.querySelectorAll("[data-axis]")) {
  slider.oninput = () => {
    skeleton.offsets[find("joint").value][slider.dataset.axis] = Number(slider.value);
    slider.nextElementSibling.textContent = `${slider.value}°`;
  };
}

// Open only where it leaves the middle of the picture, in which the person is from all sides.
const beside = find("pose").offsetLeft - innerWidth / 2;
find("fold").setAttribute("aria-expanded", String(beside > innerHeight / 4));

let before = performance.now();
function frame(now) {
  const passed = Math.min(Math.max(now - before, 0) / 1000, 0.1);
  before = now;
  if (state.playing) seek((state.time + passed * state.speed) % Math.max(clips[state.clip].length, 1e-3));
  draw();
  requestAnimationFrame(frame);
}

chooseClip(0);
goHome();
play(true);
requestAnimationFrame(frame);

// For scripts: drive the page, and draw at once exactly what a calibrated camera sees.
globalThis.avatarPlayer = {
  names: skeleton.names, clips: clips.map(({ name, length }) => ({ name, length })),
  seek: (seconds) => { play(false); seek(seconds); },
  play, setOffset, chooseClip, choosePreset, orbit, draw,
  showScene: (on) => { state.scene = on; },
  look: (camera) => { state.exact = camera; draw(); },
};
