// A scan's bytes (packing.py) to arrays, its points in an order of which every beginning is an even sample.

const ARRAYS = { i2: Int16Array, u1: Uint8Array, f4: Float32Array };

function decode(buffer) {
  const view = new DataView(buffer);
  if (view.getUint32(0, false) !== 0x4c535631) throw new Error("expected a scan of lidarsynth, found other bytes");
  const length = view.getUint32(4, true);
  const header = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 8, length)));
  const blocks = {};
  let place = 8 + length;
  for (const { name, type, count } of header.blocks) {
    blocks[name] = new ARRAYS[type](buffer, place, count);
    place += Math.ceil(blocks[name].byteLength / 4) * 4;
  }
  return spread(header, blocks);
}

// The same points, each step of the way nearly the golden section of the whole: no part comes twice before all were met.
function spread(header, blocks) {
  const n = header.points;
  const step = coprime(n, Math.round(n * 0.61803398875));
  const scan = { n, boxes: header.boxes, notes: header.notes, strip: header.strip, fields: {} };
  scan.xyz = new Float32Array(n * 3);
  scan.range = new Float32Array(n);
  scan.row = new Int16Array(n);
  const names = Object.keys(blocks).filter((name) => name !== "xyz" && name !== "row");
  for (const name of names) scan.fields[name] = new Uint8Array(n);
  for (let i = 0, j = 0; i < n; i++, j = (j + step) % n) {
    const x = blocks.xyz[3 * j] * header.step, y = blocks.xyz[3 * j + 1] * header.step, z = blocks.xyz[3 * j + 2] * header.step;
    scan.xyz[3 * i] = x; scan.xyz[3 * i + 1] = y; scan.xyz[3 * i + 2] = z;
    scan.range[i] = Math.hypot(x, y, z);
    scan.row[i] = blocks.row[j];
    for (const name of names) scan.fields[name][i] = blocks[name][j];
  }
  return scan;
}

function coprime(n, near) {
  const common = (a, b) => (b ? common(b, a % b) : a);
  let step = Math.max(near, 1);
  while (n > 1 && common(n, step) !== 1) step++;
  return step;
}
