// Draws skinned Gaussians with WebGL 2 by the rules of evsplat's rasteriser: EWA projection with a
// low-pass of the avatar, contributions from 1/255 on, back to front by depth.

// Of a Gaussian: centre and opacity, covariance (2) and colour with the normal in what is left of
// both, weights, bones.
const TEXELS = 6;
const WIDTH = 1020; // of its texture, a multiple of TEXELS
const MIN_ALPHA = 1 / 255;
const MOST_LAMPS = 16;
const MOST_CORRECTIVES = 8;
const CORRECTIVES_WIDTH = 1024; // of their texture, a multiple of MOST_CORRECTIVES

// Light as screens take it (IEC 61966-2-1).
const CODED = `
vec3 coded(vec3 light) {
  light = clamp(light, 0.0, 1.0);
  return mix(12.92 * light, 1.055 * pow(light, vec3(1.0 / 2.4)) - 0.055, step(0.0031308, light));
}`;

const VERTEX = `#version 300 es
precision highp float;
precision highp int;
${CODED}
uniform bool codesEach;    // colours are light, and the picture is blended as it is shown
uniform highp sampler2D gaussians, bones, correctives;
uniform int correctiveCount, correctedCount; // fields, and the Gaussians (the first) that have them
uniform float shares[${MOST_CORRECTIVES}];
uniform mat4 view;         // world to camera: x right, y down, z forward
uniform vec4 lens;         // focal lengths and principal point, pixels
uniform vec2 size;         // of the picture, pixels
uniform float lowPass;     // px²
uniform vec4 recorder;     // · (world, 1): size of the recording camera's pixels there, metres
uniform bool lit;
uniform vec4 room;         // middle and radius of the places that the light knows
uniform vec3 light[36];    // of 1, x, y, z of the place, nine each, in the order of basis below
uniform int lampCount;
uniform vec3 lampPlaces[${MOST_LAMPS}], lampColours[${MOST_LAMPS}];
in uint index;
out vec2 offset;           // pixels from the centre
flat out vec3 conic;
flat out vec4 colour;

vec4 texel(int k) {
  int at = int(index) * ${TEXELS} + k;
  return texelFetch(gaussians, ivec2(at % ${WIDTH}, at / ${WIDTH}), 0);
}

// A factor on the colour: a polynomial of degree 2 in the normal, linear in the place, and lamps
// whose light falls with the cosine and the inverse square.
vec3 shade(vec3 n, vec3 world) {
  float basis[9] = float[9](
    1.0, -0.48860251 * n.y, 0.48860251 * n.z, -0.48860251 * n.x, 1.09254843 * n.x * n.y,
    -1.09254843 * n.y * n.z, 0.31539157 * (2.0 * n.z * n.z - n.x * n.x - n.y * n.y),
    -1.09254843 * n.x * n.z, 0.54627422 * (n.x * n.x - n.y * n.y));
  vec4 place = vec4(1, clamp((world - room.xyz) / room.w, -2.0, 2.0));
  vec3 factor = vec3(1);
  for (int p = 0; p < 4; p++) for (int k = 0; k < 9; k++) factor += place[p] * basis[k] * light[9 * p + k];
  for (int k = 0; k < lampCount; k++) {
    vec3 ray = lampPlaces[k] - world, middle = lampPlaces[k] - room.xyz;
    float square = dot(ray, ray);
    float facing = max(dot(ray, n), 0.0) * inversesqrt(square);
    factor += facing * dot(middle, middle) / max(square, 0.09) * lampColours[k];
  }
  return clamp(factor, 0.2, 3.0);
}

void main() {
  gl_Position = vec4(0, 0, 2, 1);
  vec4 a = texel(0), b = texel(1), c = texel(2), weights = texel(4), chosen = texel(5);
  mat3x4 blend = mat3x4(0);
  for (int k = 0; k < 4; k++) {
    int bone = int(chosen[k]);
    blend += weights[k] * mat3x4(
      texelFetch(bones, ivec2(0, bone), 0), texelFetch(bones, ivec2(1, bone), 0),
      texelFetch(bones, ivec2(2, bone), 0));
  }
  vec4 change = vec4(0);   // offset of the centre, metres, and relative brightness
  if (int(index) < correctedCount) {
    for (int k = 0; k < correctiveCount; k++) {
      int at = int(index) * ${MOST_CORRECTIVES} + k;
      ivec2 place = ivec2(at % ${CORRECTIVES_WIDTH}, at / ${CORRECTIVES_WIDTH});
      change += shares[k] * texelFetch(correctives, place, 0);
    }
  }
  vec3 world = vec4(a.xyz + change.xyz, 1) * blend;
  vec3 local = (view * vec4(world, 1)).xyz;
  if (local.z < 0.01 || a.w < ${MIN_ALPHA}) return;

  vec2 focal = lens.xy, middle = lens.zw, tangent = local.xy / local.z;
  vec2 center = focal * tangent + middle;
  // The Jacobian is taken inside the field of view, enlarged by 30 % of its half width.
  vec2 margin = 0.15 * size / focal;
  tangent = clamp(tangent, -middle / focal - margin, (size - middle) / focal + margin);
  mat3 moved = transpose(mat3(blend[0].xyz, blend[1].xyz, blend[2].xyz));
  mat3 linear = mat3(view) * moved;
  mat3 covariance = mat3(b.x, b.y, b.z, b.y, b.w, c.x, b.z, c.x, c.y);
  mat3 seen = linear * covariance * transpose(linear);
  vec3 right = vec3(focal.x, 0, -focal.x * tangent.x) / local.z;
  vec3 down = vec3(0, focal.y, -focal.y * tangent.y) / local.z;
  // Pixels that are finer than the recorded ones show Gaussians as wide as those did.
  float finer = max(1.0, dot(recorder, vec4(world, 1)) * focal.x / local.z), widened = lowPass * finer * finer;
  float xx = dot(right, seen * right) + widened, xy = dot(right, seen * down);
  float yy = dot(down, seen * down) + widened, determinant = xx * yy - xy * xy;
  if (determinant <= 0.0) return;

  conic = vec3(yy, -xy, xx) / determinant;
  vec4 paint = texel(3);
  vec3 normal = vec3(c.zw, paint.w);
  colour = vec4(paint.rgb * max(1.0 + change.w, 0.0), a.w);
  if (lit && dot(normal, normal) > 0.5) colour.rgb *= shade(normalize(moved * normal), world);
  if (codesEach) colour.rgb = coded(colour.rgb);
  float extent = sqrt(2.0 * log(a.w / ${MIN_ALPHA}));
  vec2 reach = ceil(extent * sqrt(vec2(xx, yy)));
  vec2 corner = vec2(gl_VertexID & 1, gl_VertexID >> 1) * 2.0 - 1.0;
  offset = corner * reach;
  vec2 place = (center + offset) / size * 2.0 - 1.0;
  gl_Position = vec4(place.x, -place.y, 0, 1);
}`;

const FRAGMENT = `#version 300 es
precision highp float;
in vec2 offset;
flat in vec3 conic;
flat in vec4 colour;
out vec4 result;
void main() {
  float distance = dot(conic * vec3(1, 2, 1), vec3(offset.x * offset.x, offset.x * offset.y, offset.y * offset.y));
  float alpha = min(0.999, colour.a * exp(-0.5 * distance));
  if (alpha < ${MIN_ALPHA}) discard;
  result = vec4(colour.rgb * alpha, alpha);
}`;

const COPY_VERTEX = `#version 300 es
void main() { gl_Position = vec4(vec2(gl_VertexID & 1, gl_VertexID >> 1) * 4.0 - 1.0, 0, 1); }`;
const COPY_FRAGMENT = `#version 300 es
precision highp float;
${CODED}
uniform highp sampler2D picture;
uniform bool codes;        // what was blended is light
out vec4 result;
void main() {
  vec3 blended = texelFetch(picture, ivec2(gl_FragCoord.xy), 0).rgb;
  result = vec4(codes ? coded(blended) : blended, 1);
}`;

class SplatRenderer {
  // clouds: lists of rows (centre, rotation wxyz, scales, opacity, RGB) with skins (bones, weights and
  // factors on the scales, as many of each cloud) and, where light falls on them, normals. lowPass:
  // px² of the camera recorder. light: center, radius_m, coefficients (4 x 9 x 3), lamps and their
  // intensities (L x 3), or null. correctives: count of fields, steps and values (count x Gaussians x 4)
  // for the first cloud, or null. linear: RGB are light.
  constructor(canvas, clouds, boneCount, lowPass, recorder, light, correctives, linear) {
    const gl = canvas.getContext("webgl2", { antialias: false, alpha: false, preserveDrawingBuffer: true });
    if (!gl) throw new Error("This browser has no WebGL 2, which drawing Gaussians needs.");
    this.gl = gl;
    this.canvas = canvas;
    this.boneCount = boneCount;
    this.lowPass = lowPass;
    this.recorder = recorder.world_to_camera[2].map((value) => value / recorder.K[0][0]);
    this.light = light;
    this.linear = linear;
    // Sixteen bits per channel where the device can blend them: eight add a rounding per Gaussian.
    this.fine = gl.getExtension("EXT_color_buffer_float") || gl.getExtension("EXT_color_buffer_half_float");
    this.count = clouds.reduce((sum, cloud) => sum + cloud.count, 0);
    this.program = program(gl, VERTEX, FRAGMENT);
    this.copy = program(gl, COPY_VERTEX, COPY_FRAGMENT);
    this.skins = clouds[0].skins.map((_, number) => this.pack(clouds, number));
    this.correctives = this.packCorrectives(correctives, clouds[0].count);
    this.bones = texture(gl);
    this.order = new Uint32Array(this.count);
    this.depths = new Float32Array(this.count);
    this.buffer = gl.createBuffer();
    this.array = gl.createVertexArray();
    gl.bindVertexArray(this.array);
    gl.bindBuffer(gl.ARRAY_BUFFER, this.buffer);
    const index = gl.getAttribLocation(this.program, "index");
    gl.enableVertexAttribArray(index);
    gl.vertexAttribIPointer(index, 1, gl.UNSIGNED_INT, 0, 0);
    gl.vertexAttribDivisor(index, 1);
    gl.bindVertexArray(null);
    this.target = null;
  }

  // Gaussians with one of their skins: for the device, and what sorting them takes.
  pack(clouds, number) {
    const gl = this.gl, rows = Math.ceil((this.count * TEXELS) / WIDTH);
    checkRows(gl, rows);
    const texels = new Float32Array(4 * WIDTH * rows);
    this.centers = new Float32Array(3 * this.count);
    const skin = { bones: new Uint16Array(4 * this.count), weights: new Float32Array(4 * this.count) };
    let k = 0;
    for (const { count, values, skins, normals } of clouds) {
      const { bones, weights, size } = skins[number];
      for (let row = 0; row < count; row++, k++) {
        const v = values.subarray(14 * row, 14 * row + 14), at = 4 * TEXELS * k;
        const c = covarianceOf(v.subarray(3, 7), v.subarray(7, 10).map((scale) => scale * size(row)));
        const n = normals ? normals.subarray(3 * row, 3 * row + 3) : [0, 0, 0];
        texels.set([v[0], v[1], v[2], v[10], ...c, n[0], n[1], v[11], v[12], v[13], n[2]], at);
        for (let j = 0; j < 4; j++) {
          texels[at + 16 + j] = skin.weights[4 * k + j] = weights(row, j);
          texels[at + 20 + j] = skin.bones[4 * k + j] = bones(row, j);
        }
        this.centers.set([v[0], v[1], v[2]], 3 * k);
      }
    }
    const made = texture(gl);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA32F, WIDTH, rows, 0, gl.RGBA, gl.FLOAT, texels);
    return { gaussians: made, ...skin };
  }

  packCorrectives(correctives, gaussians) {
    const gl = this.gl;
    if (correctives && correctives.count > MOST_CORRECTIVES) throw new Error("Too many correctives.");
    this.corrected = correctives ? { count: correctives.count, gaussians } : { count: 0, gaussians: 0 };
    const rows = Math.max(1, Math.ceil((this.corrected.gaussians * MOST_CORRECTIVES) / CORRECTIVES_WIDTH));
    checkRows(gl, rows);
    const texels = new Float32Array(4 * CORRECTIVES_WIDTH * rows);
    for (let k = 0; k < this.corrected.count; k++) {
      for (let row = 0; row < gaussians; row++) {
        for (let c = 0; c < 4; c++) {
          const value = correctives.values[4 * (k * gaussians + row) + c];
          texels[4 * (row * MOST_CORRECTIVES + k) + c] = correctives.steps[k][c] * value;
        }
      }
    }
    const made = texture(gl);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA32F, CORRECTIVES_WIDTH, rows, 0, gl.RGBA, gl.FLOAT, texels);
    return made;
  }

  // Far to near, by a counting sort of 16 bits of depth.
  sort(bones, view, count, { bones: chosen, weights }) {
    const depthOf = new Float32Array(4 * this.boneCount);
    for (let bone = 0; bone < this.boneCount; bone++) {
      for (let column = 0; column < 4; column++) {
        let sum = column === 3 ? view[14] : 0;
        for (let row = 0; row < 3; row++) sum += view[4 * row + 2] * bones[12 * bone + 4 * row + column];
        depthOf[4 * bone + column] = sum;
      }
    }
    const { centers, depths, order } = this;
    let low = Infinity, high = -Infinity;
    for (let k = 0; k < count; k++) {
      let depth = 0;
      for (let j = 4 * k; j < 4 * k + 4; j++) {
        if (!weights[j]) continue;
        const d = 4 * chosen[j];
        depth += weights[j] * (depthOf[d] * centers[3 * k] + depthOf[d + 1] * centers[3 * k + 1]
          + depthOf[d + 2] * centers[3 * k + 2] + depthOf[d + 3]);
      }
      depths[k] = depth;
      if (depth < low) low = depth;
      if (depth > high) high = depth;
    }
    const scale = 65535 / Math.max(high - low, 1e-9), starts = new Uint32Array(65537);
    const bucket = (k) => 65535 - Math.round((depths[k] - low) * scale);
    for (let k = 0; k < count; k++) starts[bucket(k) + 1]++;
    for (let b = 1; b < 65537; b++) starts[b] += starts[b - 1];
    for (let k = 0; k < count; k++) order[starts[bucket(k)]++] = k;
  }

  // bones: rows of 3x4 matrices; view: 4x4 by columns; lens: fx, fy, cx, cy in pixels; count: how
  // many Gaussians from the start; shares: of the correctives; number: of the skin.
  draw(bones, view, lens, background, count = this.count, shares = [], number = 0) {
    const gl = this.gl, { width, height } = this.canvas;
    const skin = this.skins[number];
    this.sort(bones, view, count, skin);
    gl.bindTexture(gl.TEXTURE_2D, this.bones);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA32F, 3, this.boneCount, 0, gl.RGBA, gl.FLOAT, bones);
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.fine ? this.framebuffer(width, height) : null);
    gl.viewport(0, 0, width, height);
    // Light is blended as the model does, and coded once; eight bits are too few for that.
    const codesOnce = this.linear && this.fine;
    gl.clearColor(...(codesOnce ? background.map(lightOf) : background), 1);
    gl.clear(gl.COLOR_BUFFER_BIT);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    gl.useProgram(this.program);
    bind(gl, this.program, "gaussians", 0, skin.gaussians);
    bind(gl, this.program, "bones", 1, this.bones);
    bind(gl, this.program, "correctives", 2, this.correctives);
    gl.uniform1i(gl.getUniformLocation(this.program, "correctiveCount"), shares.length);
    gl.uniform1i(gl.getUniformLocation(this.program, "correctedCount"), this.corrected.gaussians);
    if (shares.length) gl.uniform1fv(gl.getUniformLocation(this.program, "shares"), shares);
    gl.uniform1i(gl.getUniformLocation(this.program, "codesEach"), this.linear && !this.fine ? 1 : 0);
    gl.uniformMatrix4fv(gl.getUniformLocation(this.program, "view"), false, view);
    gl.uniform4fv(gl.getUniformLocation(this.program, "lens"), lens);
    gl.uniform2f(gl.getUniformLocation(this.program, "size"), width, height);
    gl.uniform1f(gl.getUniformLocation(this.program, "lowPass"), this.lowPass);
    gl.uniform4fv(gl.getUniformLocation(this.program, "recorder"), this.recorder);
    gl.uniform1i(gl.getUniformLocation(this.program, "lit"), this.light ? 1 : 0);
    if (this.light) {
      const { center, radius_m, coefficients, lamps, intensities } = this.light;
      gl.uniform1i(gl.getUniformLocation(this.program, "lampCount"), lamps.length);
      if (lamps.length) {
        gl.uniform3fv(gl.getUniformLocation(this.program, "lampPlaces"), lamps.flat());
        gl.uniform3fv(gl.getUniformLocation(this.program, "lampColours"), intensities.flat());
      }
      gl.uniform4f(gl.getUniformLocation(this.program, "room"), ...center, radius_m);
      gl.uniform3fv(gl.getUniformLocation(this.program, "light"), coefficients.flat(2));
    }
    gl.bindVertexArray(this.array);
    gl.bindBuffer(gl.ARRAY_BUFFER, this.buffer);
    gl.bufferData(gl.ARRAY_BUFFER, this.order.subarray(0, count), gl.DYNAMIC_DRAW);
    gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, count);
    gl.bindVertexArray(null);
    if (!this.fine) return;
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.disable(gl.BLEND);
    gl.useProgram(this.copy);
    bind(gl, this.copy, "picture", 0, this.target.picture);
    gl.uniform1i(gl.getUniformLocation(this.copy, "codes"), codesOnce ? 1 : 0);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }

  framebuffer(width, height) {
    const gl = this.gl, { target } = this;
    if (target && target.width === width && target.height === height) return target.buffer;
    if (target) { gl.deleteTexture(target.picture); gl.deleteFramebuffer(target.buffer); }
    const picture = texture(gl), buffer = gl.createFramebuffer();
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA16F, width, height, 0, gl.RGBA, gl.HALF_FLOAT, null);
    gl.bindFramebuffer(gl.FRAMEBUFFER, buffer);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, picture, 0);
    this.target = { width, height, picture, buffer };
    return buffer;
  }
}

// The light of an sRGB-coded value.
function lightOf(coded) {
  return coded <= 0.04045 ? coded / 12.92 : ((coded + 0.055) / 1.055) ** 2.4;
}

// xx, xy, xz, yy, yz, zz of R S S R^T.
function covarianceOf([w, x, y, z], scales) {
  const rows = [
    [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
    [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
    [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
  ];
  const product = (a, b) => rows[a].reduce((sum, v, k) => sum + v * rows[b][k] * scales[k] ** 2, 0);
  return [product(0, 0), product(0, 1), product(0, 2), product(1, 1), product(1, 2), product(2, 2)];
}

function program(gl, vertex, fragment) {
  const made = gl.createProgram();
  for (const [kind, source] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, source);
    gl.compileShader(shader);
    if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
    gl.attachShader(made, shader);
  }
  gl.linkProgram(made);
  if (!gl.getProgramParameter(made, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(made));
  return made;
}

// Rows that a texture cannot have would leave the picture black without a word.
function checkRows(gl, rows) {
  const most = gl.getParameter(gl.MAX_TEXTURE_SIZE);
  if (rows > most) throw new Error(`These are more Gaussians than this device can draw: ${rows} rows of a texture, at most ${most}.`);
}

function texture(gl) {
  const made = gl.createTexture();
  gl.bindTexture(gl.TEXTURE_2D, made);
  for (const name of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, name, gl.NEAREST);
  for (const name of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) gl.texParameteri(gl.TEXTURE_2D, name, gl.CLAMP_TO_EDGE);
  return made;
}

function bind(gl, used, name, unit, bound) {
  gl.activeTexture(gl.TEXTURE0 + unit);
  gl.bindTexture(gl.TEXTURE_2D, bound);
  gl.uniform1i(gl.getUniformLocation(used, name), unit);
  gl.activeTexture(gl.TEXTURE0);
}
