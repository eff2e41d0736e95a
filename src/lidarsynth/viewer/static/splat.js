// The processor draws: each point is a few pixels of an image with a depth for each. Software WebGL, which browsers fall
// back to, takes ten times as long for points.

class Splat {
  constructor(canvas) {
    this.canvas = canvas;
    this.context = canvas.getContext("2d", { alpha: false });
    this.setPoints(Float32Array.of(), Uint8Array.of());
    this.lines = [];
    this.back = word(BACKGROUND);
  }

  setPoints(xyz, rgba) { this.xyz = xyz; this.recolour(rgba); }

  recolour(rgba) { this.colours = new Uint32Array(rgba.buffer); }

  setLines(layers) { this.lines = layers.map(({ xyz, rgba }) => ({ xyz, colours: new Uint32Array(rgba.buffer) })); }

  finish() {}

  draw(camera, pixels, share = 1) {
    if (fit(this.canvas, 1) || !this.image) {
      this.image = this.context.createImageData(this.canvas.width, this.canvas.height);
      this.depth = new Float32Array(this.image.width * this.image.height);
      this.out = new Uint32Array(this.image.data.buffer);
    }
    const { width, height } = this.image, m = camera.matrix(width / height);
    this.out.fill(this.back);
    this.depth.fill(0); // one over the distance: what is nearer has more
    splatPoints(this, m, pointScale(pixels, height, share), Math.ceil(this.colours.length * share));
    for (const { xyz, colours } of this.lines) splatLines(this, m, xyz, colours);
    this.context.putImageData(this.image, 0, 0);
  }
}

function word([r, g, b]) { return (255 << 24 | b << 16 | g << 8 | r) >>> 0; }

function splatPoints({ image, depth, out, xyz, colours }, m, scale, count) {
  const { width, height } = image, halfWidth = width / 2, halfHeight = height / 2;
  const [a0, a1, , a3, b0, b1, , b3, c0, c1, , c3, d0, d1, , d3] = m; // constants of the loop
  const largest = largestOf(height), single = (1.5 / scale) ** 2; // one over the distance from which on a point is one pixel
  for (let i = 0, k = 0; i < count; i++, k += 3) {
    const x = xyz[k], y = xyz[k + 1], z = xyz[k + 2];
    const w = a3 * x + b3 * y + c3 * z + d3;
    if (w < NEAR) continue;
    const near = 1 / w;
    const px = ((a0 * x + b0 * y + c0 * z + d0) * near + 1) * halfWidth;
    const py = (1 - (a1 * x + b1 * y + c1 * z + d1) * near) * halfHeight;
    if (!(px >= 0 && py >= 0 && px < width && py < height)) continue;
    const colour = colours[i];
    if (near < single) {
      const at = (py | 0) * width + (px | 0);
      if (near > depth[at]) { depth[at] = near; out[at] = colour; }
      continue;
    }
    const side = Math.min((scale * Math.sqrt(near) + 0.5) | 0, largest | 0);
    const left = Math.max((px - side / 2 + 0.5) | 0, 0), top = Math.max((py - side / 2 + 0.5) | 0, 0);
    const right = Math.min(left + side, width), bottom = Math.min(top + side, height);
    for (let row = top * width; row < bottom * width; row += width) {
      for (let at = row + left; at < row + right; at++) {
        if (near > depth[at]) { depth[at] = near; out[at] = colour; }
      }
    }
  }
}

function splatLines({ image, depth, out }, m, xyz, colours) {
  const clip = (k) => [0, 1, 3].map((row) => m[row] * xyz[k] + m[4 + row] * xyz[k + 1] + m[8 + row] * xyz[k + 2] + m[12 + row]);
  for (let i = 0; 3 * i < xyz.length; i += 2) {
    let from = clip(3 * i), to = clip(3 * i + 3);
    if (from[2] < NEAR && to[2] < NEAR) continue;
    if (from[2] < NEAR) from = cutAtNear(from, to);
    if (to[2] < NEAR) to = cutAtNear(to, from);
    stroke(image, depth, out, onScreen(image, from), onScreen(image, to), colours[i]);
  }
}

// The place between a corner behind the eye and one before it that lies just before the eye.
function cutAtNear(behind, before) {
  const share = (NEAR - behind[2]) / (before[2] - behind[2]);
  return behind.map((value, k) => value + share * (before[k] - value));
}

function onScreen({ width, height }, [x, y, w]) {
  return [((x / w + 1) * width) / 2, ((1 - y / w) * height) / 2, 1 / w];
}

function stroke({ width, height }, depth, out, [x0, y0, n0], [x1, y1, n1], colour) {
  const dx = x1 - x0, dy = y1 - y0, steps = Math.ceil(Math.max(Math.abs(dx), Math.abs(dy), 1));
  let low = 0, high = 1; // the part on the screen (Liang and Barsky, 1984)
  for (const [p, q] of [[-dx, x0], [dx, width - 1 - x0], [-dy, y0], [dy, height - 1 - y0]]) {
    if (p === 0 && q < 0) return;
    if (p < 0) low = Math.max(low, q / p);
    if (p > 0) high = Math.min(high, q / p);
  }
  for (let s = Math.ceil(low * steps); s <= high * steps; s++) {
    const t = s / steps, at = ((y0 + dy * t) | 0) * width + ((x0 + dx * t) | 0), near = n0 + (n1 - n0) * t;
    if (near > depth[at]) { depth[at] = near; out[at] = colour; }
  }
}
