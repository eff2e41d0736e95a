// A scan as an image of its beams (rows) and directions (columns): column 0 looks backwards, the middle one ahead.

// (height * width) index of the nearest point of each pixel that is drawn, -1 where there is none.
function pixelsOf(scan, drawn = null) {
  const { height, width } = scan.strip, pixels = new Int32Array(height * width).fill(-1);
  for (let i = 0; i < scan.n; i++) {
    if (scan.row[i] < 0 || (drawn && !drawn[i])) continue;
    const turn = (1 - Math.atan2(scan.xyz[3 * i + 1], scan.xyz[3 * i]) / Math.PI) / 2;
    const at = scan.row[i] * width + (Math.floor(turn * width) % width);
    if (pixels[at] < 0 || scan.range[i] < scan.range[pixels[at]]) pixels[at] = i;
  }
  return pixels;
}

function paintStrip(canvas, scan, pixels, rgba) {
  const { height, width } = scan.strip;
  canvas.width = width;
  canvas.height = height;
  const context = canvas.getContext("2d"), image = context.createImageData(width, height);
  const from = new Uint32Array(rgba.buffer), to = new Uint32Array(image.data.buffer);
  for (let at = 0; at < pixels.length; at++) to[at] = pixels[at] < 0 ? 0 : from[pixels[at]];
  context.putImageData(image, 0, 0);
}
