// A camera that circles a point: drag turns, the second button or two fingers shift, the wheel or a
// pinch comes nearer; arrow keys, + and - do the same for what has the focus. Camera axes are x right, y down, z forward.

const V = {
  dot: (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2],
  cross: (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]],
  scaled: (a, s) => a.map((v) => v * s),
  plus: (a, b) => a.map((v, k) => v + b[k]),
  unit: (a) => V.scaled(a, 1 / Math.hypot(...a)),
};

class Orbit {
  constructor(element, up) {
    this.up = V.unit(up);
    const other = Math.abs(this.up[0]) < 0.9 ? [1, 0, 0] : [0, 1, 0];
    this.east = V.unit(V.cross(other, this.up));
    this.north = V.cross(this.up, this.east);
    Object.assign(this, { target: [0, 0, 0], distance: 3, heading: 0, pitch: 0, fingers: new Map() });
    element.addEventListener("contextmenu", (event) => event.preventDefault());
    element.addEventListener("pointerdown", (event) => {
      element.setPointerCapture(event.pointerId);
      this.fingers.set(event.pointerId, [event.clientX, event.clientY]);
    });
    for (const end of ["pointerup", "pointercancel"]) {
      element.addEventListener(end, (event) => this.fingers.delete(event.pointerId));
    }
    element.addEventListener("pointermove", (event) => this.moved(event, element.clientHeight));
    element.addEventListener("wheel", (event) => {
      event.preventDefault();
      this.distance *= Math.exp(0.001 * event.deltaY);
    }, { passive: false });
    element.addEventListener("keydown", (event) => {
      if (event.ctrlKey || event.metaKey || event.altKey || !this.pressed(event.key)) return;
      event.preventDefault();
    });
  }

  // Whether a key means something here.
  pressed(key) {
    const turns = { ArrowLeft: [0.1, 0], ArrowRight: [-0.1, 0], ArrowUp: [0, 0.1], ArrowDown: [0, -0.1] };
    const nearer = { "+": 0.9, "=": 0.9, "-": 1 / 0.9 };
    if (turns[key]) this.turn(...turns[key]);
    if (nearer[key]) this.distance *= nearer[key];
    return Boolean(turns[key] || nearer[key]);
  }

  moved(event, height) {
    const before = this.fingers.get(event.pointerId);
    if (!before) return;
    const [dx, dy] = [event.clientX - before[0], event.clientY - before[1]];
    const others = [...this.fingers].filter(([id]) => id !== event.pointerId).map(([, place]) => place);
    this.fingers.set(event.pointerId, [event.clientX, event.clientY]);
    if (others.length) {
      const far = (place) => Math.hypot(place[0] - others[0][0], place[1] - others[0][1]);
      // Fingers that meet do not end at no distance, from which nothing leads back.
      this.distance *= Math.max(far(before), 1) / Math.max(far([event.clientX, event.clientY]), 1);
    }
    if (others.length || event.buttons & 6) this.shift(dx / height, dy / height);
    else this.turn((-5 * dx) / height, (-5 * dy) / height);
  }

  turn(heading, pitch) {
    this.heading += heading;
    this.pitch = Math.min(Math.max(this.pitch + pitch, -1.55), 1.55);
  }

  shift(x, y) {
    const { right, down } = this.axes();
    this.target = V.plus(this.target, V.plus(V.scaled(right, -x * this.distance), V.scaled(down, -y * this.distance)));
  }

  // Stand at a place and look along a direction, at a point in the given distance.
  stand(place, forward, distance) {
    this.distance = distance;
    this.target = V.plus(place, V.scaled(forward, distance));
    this.heading = Math.atan2(V.dot(forward, this.north), V.dot(forward, this.east));
    this.pitch = 0;
    // Not straight up or down, where no direction is right.
    this.turn(0, Math.asin(Math.min(Math.max(V.dot(forward, this.up), -1), 1)));
  }

  axes() {
    const flat = V.plus(V.scaled(this.east, Math.cos(this.heading)), V.scaled(this.north, Math.sin(this.heading)));
    const forward = V.plus(V.scaled(flat, Math.cos(this.pitch)), V.scaled(this.up, Math.sin(this.pitch)));
    const right = V.unit(V.cross(forward, this.up));
    return { right, down: V.cross(forward, right), forward };
  }

  // World to camera, 4x4 in rows.
  pose() {
    const { right, down, forward } = this.axes();
    const place = V.plus(this.target, V.scaled(forward, -this.distance));
    return [...[right, down, forward].map((axis) => [...axis, -V.dot(axis, place)]), [0, 0, 0, 1]];
  }
}
