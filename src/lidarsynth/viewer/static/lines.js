// What is drawn beside the points: rings of distance, the sensor's axes, boxes.

// Lines as { xyz, rgba }: pairs of corners, each pair in one colour.
function linesOf(pairs) {
  const xyz = new Float32Array(pairs.length * 6), rgba = new Uint8Array(pairs.length * 8);
  pairs.forEach(([from, to, colour], i) => {
    xyz.set(from, 6 * i); xyz.set(to, 6 * i + 3);
    rgba.set([...colour, 255], 8 * i); rgba.set([...colour, 255], 8 * i + 4);
  });
  return { xyz, rgba };
}

function ringLines(distances, ground) {
  const pairs = [], parts = 128, colour = [46, 54, 68];
  for (const d of distances) {
    const at = (k) => [d * Math.cos((2 * Math.PI * k) / parts), d * Math.sin((2 * Math.PI * k) / parts), ground];
    for (let k = 0; k < parts; k++) pairs.push([at(k), at(k + 1), colour]);
  }
  pairs.push([[0, 0, 0], [1.5, 0, 0], [230, 90, 90]], [[0, 0, 0], [0, 1.5, 0], [100, 200, 110]], [[0, 0, 0], [0, 0, 1.5], [90, 150, 250]]);
  return linesOf(pairs);
}

const BOX_COLOURS = {
  car: [100, 170, 255], van: [100, 170, 255], truck: [164, 120, 255], bus: [164, 120, 255], trailer: [164, 120, 255],
  lorry: [164, 120, 255], coach: [164, 120, 255],
  person: [255, 92, 92], pedestrian: [255, 92, 92], bicyclist: [255, 110, 210], motorcyclist: [255, 110, 210],
  bicycle: [120, 230, 235], motorcycle: [120, 230, 235],
};

// Twelve edges, a stroke through the front, and where it moves a white line of the way of one second; dim without points.
function boxLines(boxes) {
  const pairs = [];
  for (const box of boxes) {
    const [l, w, h] = box.size, [cx, cy, cz] = box.centre, c = Math.cos(box.yaw), s = Math.sin(box.yaw);
    const bright = BOX_COLOURS[box.kind] || [235, 235, 235], colour = box.points === 0 ? bright.map((v) => v * 0.4) : bright;
    const at = (x, y, z) => [cx + (c * x * l - s * y * w) / 2, cy + (s * x * l + c * y * w) / 2, cz + (z * h) / 2];
    const round = [[1, 1], [-1, 1], [-1, -1], [1, -1]];
    round.forEach(([x, y], k) => {
      const [u, v] = round[(k + 1) % 4];
      pairs.push([at(x, y, -1), at(u, v, -1), colour], [at(x, y, 1), at(u, v, 1), colour], [at(x, y, -1), at(x, y, 1), colour]);
    });
    pairs.push([at(0, 0, -1), at(1.3, 0, -1), colour]);
    const moved = box.velocity || [0, 0, 0];
    if (Math.hypot(...moved) > 0.2) pairs.push([[cx, cy, cz], [cx + moved[0], cy + moved[1], cz + moved[2]], [255, 255, 255]]);
  }
  return linesOf(pairs);
}
