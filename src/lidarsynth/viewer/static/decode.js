// A scan's bytes (packing.py) to arrays.

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

// Sixteen passes over the points, each every sixteenth of them in their own order: neighbours stay near each other, as
// memory likes it, and the first passes are an even sample.
const PASSES = [0, 8, 4, 12, 2, 10, 6, 14, 1, 9, 5, 13, 3, 11, 7, 15];

function spread(header, blocks) {
  const n = header.points, names = Object.keys(blocks).filter((name) => name !== "xyz" && name !== "row");
  const scan = { n, boxes: header.boxes, notes: header.notes, name: header.name, strip: header.strip, fields: {} };
  scan.xyz = new Float32Array(n * 3);
  scan.range = new Float32Array(n);
  scan.row = new Int16Array(n);
  for (const name of names) scan.fields[name] = new Uint8Array(n);
  let i = 0;
  for (const first of PASSES) {
    for (let j = first; j < n; j += PASSES.length, i++) {
      const x = blocks.xyz[3 * j] * header.step, y = blocks.xyz[3 * j + 1] * header.step, z = blocks.xyz[3 * j + 2] * header.step;
      scan.xyz[3 * i] = x; scan.xyz[3 * i + 1] = y; scan.xyz[3 * i + 2] = z;
      scan.range[i] = Math.hypot(x, y, z);
      scan.row[i] = blocks.row[j];
      for (const name of names) scan.fields[name][i] = blocks[name][j];
    }
  }
  return scan;
}
