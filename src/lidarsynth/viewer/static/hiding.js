// Which points are drawn: of classes and of kinds that the legend shows, and of the least confidence that is asked for.

// (n) 1 where a point is drawn, 0 where it is hidden; null where all are drawn. hidden: by word, the classes that are not.
function drawnOf(scan, hidden, least) {
  const tests = Object.entries(hidden).filter(([word, classes]) => classes.size && scan.fields[word])
    .map(([word, classes]) => (i) => classes.has(scan.fields[word][i]));
  if (least > 0 && scan.fields.confidence) tests.push((i) => scan.fields.confidence[i] < Math.round(255 * least));
  return tests.length ? Uint8Array.from({ length: scan.n }, (_, i) => (tests.some((test) => test(i)) ? 0 : 1)) : null;
}

// The places and colours of those alone, in their order, so that the first passes stay an even sample.
function onlyDrawn(xyz, rgba, drawn) {
  if (!drawn) return [xyz, rgba];
  const count = counted(drawn), places = new Float32Array(3 * count), shades = new Uint32Array(count);
  const from = new Uint32Array(rgba.buffer);
  for (let i = 0, k = 0; i < drawn.length; i++) {
    if (!drawn[i]) continue;
    places.set(xyz.subarray(3 * i, 3 * i + 3), 3 * k);
    shades[k++] = from[i];
  }
  return [places, new Uint8Array(shades.buffer)];
}

function counted(drawn) { return drawn.reduce((sum, one) => sum + one, 0); }

// A click on a class hides it or shows it again; with Shift that class alone is shown, or all again.
function toggleClass(word, k, alone) {
  const classes = state.hidden[word] ?? (state.hidden[word] = new Set()), all = colourings[word].classes.map((_, one) => one);
  if (alone) state.hidden[word] = new Set(classes.size === all.length - 1 && !classes.has(k) ? [] : all.filter((one) => one !== k));
  else if (!classes.delete(k)) classes.add(k);
  rehide();
}
