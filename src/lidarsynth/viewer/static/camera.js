// An orbit camera: it looks at `target` (x forward, y left, z up, metres) from `distance`, `turn` and `rise` away.

const VIEWS = {
  behind: { target: [8, 0, -1], distance: 34, turn: Math.PI, rise: 0.42 },
  above: { target: [0, 0, 0], distance: 78, turn: Math.PI, rise: 1.5 },
  driver: { target: [11, 0, -0.9], distance: 9, turn: Math.PI, rise: 0.09 },
  side: { target: [4, 0, -1], distance: 42, turn: -Math.PI / 2, rise: 0.3 },
};
const FIELD = 0.9; // radians from the upper to the lower border, or from left to right where that is less
const STREET = 80; // metres for which the views are made
const NEAR = 0.2, FAR = 1500;

class Camera {
  // far: metres that most points lie within; in a room one looks from nearer than on a street
  constructor(far) {
    this.scale = Math.min(Math.sqrt(far / STREET), 1);
    this.view("behind");
  }

  view(word) {
    const { target, distance, ...rest } = VIEWS[word];
    Object.assign(this, rest, { target: target.map((value) => value * this.scale), distance: distance * this.scale });
  }

  orbit(dx, dy) {
    this.turn -= dx * 0.006;
    this.rise = Math.min(Math.max(this.rise + dy * 0.006, -1.55), 1.55);
  }

  // Along the screen, so that what is under the pointer stays there, at the target's distance.
  pan(dx, dy, height) {
    const metres = (2 * this.distance * Math.tan(FIELD / 2)) / height;
    const { right, up } = this.axes();
    for (let k = 0; k < 3; k++) this.target[k] += (-dx * right[k] + dy * up[k]) * metres;
  }

  zoom(factor) { this.distance = Math.min(Math.max(this.distance * factor, 0.5), 700); }

  axes() {
    const c = Math.cos(this.rise), s = Math.sin(this.rise), ct = Math.cos(this.turn), st = Math.sin(this.turn);
    const back = [c * ct, c * st, s];
    return { back, right: [-st, ct, 0], up: [-s * ct, -s * st, c] };
  }

  eye() {
    const { back } = this.axes();
    return this.target.map((value, k) => value + back[k] * this.distance);
  }

  // (16) column by column, world to clip coordinates, for a picture of that width / height.
  matrix(aspect) {
    const { back, right, up } = this.axes(), eye = this.eye();
    const wide = 1 / Math.tan(FIELD / 2), f = aspect < 1 ? wide * aspect : wide;
    const a = (FAR + NEAR) / (NEAR - FAR), b = (2 * FAR * NEAR) / (NEAR - FAR);
    const dot = (v) => -(v[0] * eye[0] + v[1] * eye[1] + v[2] * eye[2]);
    const rows = [right.map((v) => (v * f) / aspect), up.map((v) => v * f), back.map((v) => v * a), back.map((v) => -v)];
    const last = [(dot(right) * f) / aspect, dot(up) * f, dot(back) * a + b, -dot(back)];
    const m = new Float32Array(16);
    for (let column = 0; column < 3; column++) for (let row = 0; row < 4; row++) m[4 * column + row] = rows[row][column];
    for (let row = 0; row < 4; row++) m[12 + row] = last[row];
    return m;
  }
}

// Where a point is drawn: [x, y] from -1 to 1 and the distance along the line of sight; behind the eye where w <= 0.
function projected(m, x, y, z) {
  const w = m[3] * x + m[7] * y + m[11] * z + m[15];
  return [(m[0] * x + m[4] * y + m[8] * z + m[12]) / w, (m[1] * x + m[5] * y + m[9] * z + m[13]) / w, w];
}
