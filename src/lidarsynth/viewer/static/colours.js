// One colour per point, RGBA in four bytes, by a colouring of the settings (colouring.py).

const PLAIN = [118, 126, 140]; // of points that lack the field

function prepareColourings(colourings) {
  for (const by of Object.values(colourings)) {
    if (by.shades) by.shades = Uint8Array.from(atob(by.shades), (c) => c.charCodeAt(0));
  }
  return colourings;
}

// Where a value lies on a scale, 0 to 1, not cut off.
function placeOn(scale, value) {
  if (scale.kind === "log") return Math.log2((value + 1) / (scale.low + 1)) / Math.log2((scale.high + 1) / (scale.low + 1));
  const share = (value - scale.low) / (scale.high - scale.low);
  return scale.kind === "sqrt" ? Math.sqrt(Math.max(share, 0)) : share;
}

function canColour(scan, by) {
  return by.fields.every((field) => scan.fields[field]);
}

function shadeAt(scale, value) {
  return 3 * Math.round(255 * Math.min(Math.max(placeOn(scale, value), 0), 1));
}

function valueOf(scan, word, i) {
  if (word === "range") return scan.range[i];
  if (word === "height") return scan.xyz[3 * i + 2];
  const value = scan.fields[word][i];
  return word === "reflectance" || word === "confidence" ? value / 255 : value;
}

function coloursOf(scan, word, by) {
  const rgba = new Uint8Array(scan.n * 4).fill(255);
  const put = (i, table, at) => {
    rgba[4 * i] = table[at]; rgba[4 * i + 1] = table[at + 1]; rgba[4 * i + 2] = table[at + 2];
  };
  if (!canColour(scan, by)) {
    for (let i = 0; i < scan.n; i++) put(i, PLAIN, 0);
  } else if (by.classes) {
    const table = by.classes.flatMap(([, rgb]) => rgb);
    for (let i = 0; i < scan.n; i++) put(i, table, 3 * Math.min(scan.fields[word][i], by.classes.length - 1));
  } else if (word === "reflectance" || word === "confidence") {
    const bytes = Uint8Array.from({ length: 256 }, (_, v) => shadeAt(by, v / 255) / 3);
    for (let i = 0; i < scan.n; i++) put(i, by.shades, 3 * bytes[scan.fields[word][i]]);
  } else {
    for (let i = 0; i < scan.n; i++) put(i, by.shades, shadeAt(by, valueOf(scan, word, i)));
  }
  return rgba;
}
