// Forward kinematics: from joint rotations to one 3x4 matrix per bone, canonical pose to world.
// Quaternions are [w, x, y, z], matrices rows of numbers.

const Q = {
  multiply: ([a, b, c, d], [e, f, g, h]) => [
    a * e - b * f - c * g - d * h, a * f + b * e + c * h - d * g,
    a * g - b * h + c * e + d * f, a * h + b * g - c * f + d * e,
  ],
  rotate: ([w, x, y, z], [a, b, c]) => {
    const u = 2 * (y * c - z * b), v = 2 * (z * a - x * c), t = 2 * (x * b - y * a);
    return [a + w * u + y * t - z * v, b + w * v + z * u - x * t, c + w * t + x * v - y * u];
  },
  // Spherical, along the shorter way.
  between: (p, q, share) => {
    let cosine = p.reduce((sum, v, k) => sum + v * q[k], 0);
    const sign = cosine < 0 ? -1 : 1;
    cosine = Math.min(1, Math.abs(cosine));
    const angle = Math.acos(cosine), sine = Math.sin(angle);
    const [a, b] = sine < 1e-6 ? [1 - share, share]
      : [Math.sin((1 - share) * angle) / sine, Math.sin(share * angle) / sine];
    const mixed = p.map((v, k) => a * v + sign * b * q[k]), length = Math.hypot(...mixed);
    return mixed.map((v) => v / length);
  },
  ofDegrees: (vector) => {
    const angle = Math.hypot(...vector) * (Math.PI / 180);
    if (!angle) return [1, 0, 0, 0];
    const scale = (Math.sin(angle / 2) * (Math.PI / 180)) / angle;
    return [Math.cos(angle / 2), ...vector.map((v) => v * scale)];
  },
  rows: ([w, x, y, z]) => [
    [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
    [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
    [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
  ],
};

class Skeleton {
  constructor({ names, parents, rest, rest_from_canonical }) {
    Object.assign(this, { names, parents, rest, restFromCanonical: rest_from_canonical });
    this.offsets = names.map(() => [0, 0, 0]); // degrees, what the reader adds to each joint
  }

  // Rotations and root translation of a clip at a time in seconds.
  at(clip, seconds) {
    const place = Math.min(Math.max(seconds * clip.rate_hz, 0), clip.count - 1);
    const key = Math.min(Math.floor(place), Math.max(clip.count - 2, 0));
    const next = Math.min(key + 1, clip.count - 1), share = place - key;
    const rotation = (k, joint) => {
      const i = 4 * (k * this.names.length + joint);
      return [...clip.rotations.subarray(i, i + 4)];
    };
    return {
      rotations: this.names.map((_, j) => Q.between(rotation(key, j), rotation(next, j), share)),
      transl: [0, 1, 2].map((c) => (1 - share) * clip.transl[3 * key + c] + share * clip.transl[3 * next + c]),
    };
  }

  // A joint's rotation with what the reader adds.
  turned(rotations, joint) {
    return Q.multiply(rotations[joint], Q.ofDegrees(this.offsets[joint]));
  }

  // Rows of all bones one after the other, and an identity last, for what follows no bone.
  bones({ rotations, transl }) {
    const count = this.names.length, result = new Float32Array(12 * (count + 1));
    const turned = [], origins = [];
    for (let joint = 0; joint < count; joint++) {
      const home = this.rest[joint], above = this.parents[joint];
      const local = this.turned(rotations, joint);
      if (above < 0) {
        turned[joint] = local;
        origins[joint] = home.map((v, k) => v + transl[k]);
      } else {
        turned[joint] = Q.multiply(turned[above], local);
        const bone = Q.rotate(turned[above], home.map((v, k) => v - this.rest[above][k]));
        origins[joint] = bone.map((v, k) => v + origins[above][k]);
      }
      const rows = Q.rows(turned[joint]), moved = Q.rotate(turned[joint], home);
      const before = this.restFromCanonical[joint];
      for (let row = 0; row < 3; row++) {
        for (let column = 0; column < 4; column++) {
          let sum = column === 3 ? origins[joint][row] - moved[row] : 0;
          for (let k = 0; k < 3; k++) sum += rows[row][k] * before[k][column];
          result[12 * joint + 4 * row + column] = sum;
        }
      }
    }
    for (let k = 0; k < 3; k++) result[12 * count + 5 * k] = 1;
    return result;
  }
}

// What poses do beyond skinning: fields whose shares are linear in R - I of all joints, inside the
// range of the recorded poses, and fade outside.
class Correctives {
  constructor({ count, low, high, linear, constant, least, most, reach }) {
    Object.assign(this, { count, low, high, linear, constant, least, most, reach });
  }

  // rotations: quaternions of all joints against their parents.
  shares(rotations) {
    const features = rotations.flatMap((turn) => Q.rows(turn).flatMap((row, r) => row.map((v, c) => v - (r === c))));
    const inside = features.map((v, f) => Math.min(Math.max(v, this.low[f]), this.high[f]));
    const excess = features.reduce((sum, v, f) => sum + (v - inside[f]) ** 2, 0);
    const left = Math.exp(-excess / this.reach ** 2);
    return this.constant.map((start, k) => {
      const share = inside.reduce((sum, v, f) => sum + v * this.linear[f * this.count + k], start);
      return left * Math.min(Math.max(share, this.least[k]), this.most[k]);
    });
  }
}
