// The page's state, and what changes it: slider, switch, colours, pointer, keys.

const $ = (id) => document.getElementById(id);
const settings = JSON.parse($("settings").textContent);
const colourings = prepareColourings(settings.colourings);
const source = new Source(settings);
const RINGS = [10, 20, 40, 80, 120];
const WORDS = { range: "Range", height: "Height", reflectance: "Reflectance", label: "Class", new: "New", confidence: "Confidence" };
const KEYS = { v: "behind", a: "above", d: "driver", e: "side" };
const TURN = 100; // milliseconds between scans while playing, a turn of most sensors
const SLOW = 300; // milliseconds until a scan that is not there yet is said to be read

const state = { number: 0, version: 0, word: "range", scan: null, rgba: null, pixels: null, playing: 0, mark: null, pin: null, hidden: {}, drawn: null };
const camera = new Camera(colourings.range.high);
let scene, motion;

function show(text) {
  $("message").textContent = text;
  $("message").hidden = !text;
}

async function go(number, version = state.version) {
  const wanted = (state.wanted = Symbol("the last asked for"));
  version = Math.min(version, source.captions(number).length - 1);
  const slow = setTimeout(() => { $("readout").textContent = "reading …"; }, SLOW);
  try {
    const scan = await source.load(number, version);
    if (state.wanted !== wanted) return;
    Object.assign(state, { number, version, scan });
    show("");
  } catch (error) {
    if (error instanceof End) return go(0, version);
    if (state.wanted !== wanted) return;
    Object.assign(state, { number, version, scan: null }); // the one before is not what its name says
    show(error.message);
  } finally {
    clearTimeout(slow);
  }
  pointAt(null); // which was one of the scan before
  refresh();
  if (state.number + 1 < source.reach(state.number)) source.load(state.number + 1, state.version).catch(paintBar);
}

function refresh() {
  paintBar();
  paintVersions();
  if (state.scan) {
    hide();
    if (!canColour(state.scan, colourings[state.word]) && !wordsHere().includes(state.word)) state.word = "range";
    paintPanel();
    recolour(true);
  } else clear();
}

function hide() {
  state.drawn = drawnOf(state.scan, state.hidden, Number($("least").value));
  state.pixels = pixelsOf(state.scan, state.drawn);
}

// Of the scan that is shown other points.
function rehide() {
  if (!state.scan) return;
  hide();
  pointAt(null);
  paintPanel();
  recolour(true);
}

// Nothing is left of a scan before one that cannot be read; the choice of colours stays for the next.
function clear() {
  scene.setPoints(Float32Array.of(), Uint8Array.of());
  scene.setLines([]);
  for (const id of ["facts", "words", "unit", "legend", "notes", "strips"]) $(id).replaceChildren();
  $("with-boxes").hidden = $("with-least").hidden = true;
  motion.redraw();
}

// Colours of which any scan of this pair has the fields: a switch to the one without keeps the choice.
function wordsHere() {
  state.seen = state.seen?.number === state.number ? state.seen : { number: state.number, fields: new Set() };
  Object.keys(state.scan.fields).forEach((field) => state.seen.fields.add(field));
  return Object.keys(colourings).filter((word) => colourings[word].fields.every((field) => state.seen.fields.has(field)));
}

function recolour(moved = false) {
  const { scan } = state, by = colourings[state.word];
  state.rgba = coloursOf(scan, state.word, by);
  if (moved || state.drawn) scene.setPoints(...onlyDrawn(scan.xyz, state.rgba, state.drawn));
  else scene.recolour(state.rgba);
  relines();
  paintLegend($("legend"), scan, state.word, by);
  $("unit").textContent = by.unit ? `${by.title}, ${by.unit}` : by.title;
  press("words", state.word);
  paintStrips();
  motion.redraw();
}

function relines() {
  const layers = [];
  if ($("rings").checked) layers.push(ringLines(RINGS, settings.ground));
  if ($("boxes").checked && state.scan?.boxes.length) layers.push(boxLines(state.scan.boxes));
  scene.setLines(layers);
}

function paintPanel() {
  const { scan } = state;
  $("facts").textContent = facts();
  choice("words", wordsHere().map((word, i) => [word, WORDS[word], `key ${i + 1}`]), state.word, (word) => { state.word = word; recolour(); });
  $("with-boxes").hidden = !scan.boxes.length;
  $("with-least").hidden = !wordsHere().includes("confidence");
  $("kinds").textContent = scan.boxes.length;
  $("notes").replaceChildren(...scan.notes.map((note) => made("p", "note", note)));
}

function facts() {
  const { scan, drawn } = state, farthest = scan.range.reduce((a, b) => Math.max(a, b), 0);
  if (!scan.n) return "no points";
  const count = `${scan.n.toLocaleString("en")} ${scan.n === 1 ? "point" : "points"} to ${farthest.toFixed(0)} m`;
  const shown = drawn ? `, ${counted(drawn).toLocaleString("en")} of them drawn` : "";
  return `${count}${shown}; ${scan.strip.height} ${scan.strip.origin}`;
}

function paintVersions() {
  const captions = source.captions(state.number);
  choice("versions", captions.length > 1 ? captions.map((caption, i) => [String(i), caption, "key B"]) : [], String(state.version),
    (word) => go(state.number, Number(word)));
}

function paintBar() {
  const reach = source.reach(state.number), name = source.name(state.number);
  $("title").textContent = reach > 1 && name !== settings.title ? `${settings.title} · ${name}` : settings.title;
  document.title = `${$("title").textContent} – lidarsynth`;
  $("slider").max = reach - 1;
  if (!state.sliding) $("slider").value = state.number;
  $("where").textContent = `${state.number + 1} / ${source.count ?? "…"}`;
  $("where").title = name;
  $("bar").hidden = reach <= 1;
}

function paintStrips() {
  const { scan, pixels, word } = state;
  const second = word !== "range" && canColour(scan, colourings[word]) ? word : scan.fields.reflectance ? "reflectance" : "height";
  const words = ["range", second];
  $("strips").replaceChildren(...words.map((word) => {
    const row = made("div", "strip"), canvas = made("canvas");
    paintStrip(canvas, scan, pixels, word === state.word ? state.rgba : coloursOf(scan, word, colourings[word]));
    canvas.dataset.word = word;
    row.append(made("span", "", WORDS[word]), canvas);
    return row;
  }), compass());
}

function compass() {
  const row = made("div", "compass");
  for (const [place, word] of [[0, "behind"], [25, "left"], [50, "ahead"], [75, "right"], [100, "behind"]]) {
    const label = made("span", "", word);
    label.style.left = `${place}%`;
    row.append(label);
  }
  return row;
}

function choice(id, items, chosen, onChoice) {
  $(id).replaceChildren(...items.map(([word, text, title]) => {
    const button = made("button", "", text);
    Object.assign(button, { title, onclick: () => { onChoice(word); press(id, word); } });
    button.dataset.word = word;
    return button;
  }));
  press(id, chosen);
}

function press(id, word) {
  for (const button of $(id).children) button.setAttribute("aria-pressed", String(button.dataset.word === word));
}

function step(by) {
  const reach = source.reach(state.number);
  if (state.number + by < 0 && source.count === null) return; // nobody knows yet which scan is the last
  go((state.number + by + reach) % reach);
}

// Of the scans that the slider passes those are asked for that there is time for, and the one where it stops.
async function slide() {
  state.sought = Number($("slider").value);
  if (state.sliding) return;
  state.sliding = true;
  for (let at = null; at !== state.sought;) await go(at = state.sought);
  state.sliding = false;
  paintBar();
}

function play(on) {
  clearInterval(state.playing);
  state.playing = on ? setInterval(() => { if (!state.busy) { state.busy = true; go((state.number + 1) % source.reach(state.number)).finally(() => { state.busy = false; }); } }, TURN) : 0;
  $("play").textContent = on ? "❚❚" : "▶";
}

function look(word) {
  camera.view(word);
  press("views", word);
  motion.redraw();
}

function toggleStrips() {
  $("strips").hidden = !$("strips").hidden;
  $("strips-on").setAttribute("aria-pressed", String(!$("strips").hidden));
  motion.redraw();
}

// What a point is, in words.
function told(i) {
  const { scan } = state, [x, y, z] = scan.xyz.subarray(3 * i, 3 * i + 3);
  const words = [`x ${x.toFixed(2)}`, `y ${y.toFixed(2)}`, `z ${z.toFixed(2)}`, `range ${scan.range[i].toFixed(2)} m`];
  if (scan.row[i] >= 0) words.push(`row ${scan.row[i]}`);
  for (const word of ["reflectance", "confidence"]) if (scan.fields[word]) words.push(`${word} ${valueOf(scan, word, i).toFixed(2)}`);
  for (const word of ["label", "new"]) if (scan.fields[word]) words.push(colourings[word].classes[scan.fields[word][i]]?.[0] ?? "");
  const away = state.pin && Math.hypot(x - state.pin[0], y - state.pin[1], z - state.pin[2]);
  if (state.pin) words.push(away ? `${away.toFixed(2)} m from the pin` : "pinned");
  return words.join("   ");
}

// A place to measure from, which stays where it is while scans change.
function pinAt(i) {
  state.pin = i === null ? null : [...state.scan.xyz.subarray(3 * i, 3 * i + 3)];
  pointAt(i);
}

function pointAt(i) {
  state.mark = i;
  $("readout").textContent = i === null ? "" : told(i);
  motion.redraw();
}

function onKey(event) {
  if (event.ctrlKey || event.metaKey || event.altKey) return;
  const key = event.key.toLowerCase(), words = state.scan ? wordsHere() : [];
  const acts = {
    arrowleft: () => step(-1), arrowright: () => step(1), " ": () => play(!state.playing),
    b: () => go(state.number, (state.version + 1) % source.captions(state.number).length),
    i: toggleStrips, p: () => screenshot(), "?": () => { $("help").hidden = !$("help").hidden; }, escape: () => { $("help").hidden = true; pinAt(null); },
  };
  const act = acts[key] || (KEYS[key] && (() => look(KEYS[key]))) ||
    (words[Number(key) - 1] && (() => { state.word = words[Number(key) - 1]; recolour(); }));
  const own = ["size", "least"].includes(event.target.id) ? key.startsWith("arrow") : key === " " && event.target.matches("button, summary, input");
  if (!act || own) return; // what has the focus knows what to do with it
  event.preventDefault();
  act();
}

function begin() {
  scene = sceneOn($("scene"));
  motion = new Motion(scene, camera);
  choice("views", Object.entries(KEYS).map(([key, word]) => [word, word[0].toUpperCase() + word.slice(1), `key ${key.toUpperCase()}`]), "behind", look);
  $("slider").oninput = slide;
  $("back").onclick = () => step(-1);
  $("forth").onclick = () => step(1);
  $("play").onclick = () => play(!state.playing);
  $("size").oninput = () => motion.redraw();
  $("least").oninput = () => { $("least-is").textContent = $("least").value; rehide(); };
  $("boxes").onchange = $("rings").onchange = () => { relines(); motion.redraw(); };
  $("strips-on").onclick = toggleStrips;
  $("shot").onclick = screenshot;
  $("help-on").onclick = () => { $("help").hidden = !$("help").hidden; };
  $("panel").open = innerWidth > 720;
  addEventListener("keydown", onKey);
  $("scene").addEventListener("webglcontextlost", () => show("the graphics card was lost: load the page again"));
  steer($("scene"), $("strips"));
  paintBar(); // its title, while the first scan is read
  return go(0, 0);
}

const ready = begin().catch((error) => show(error.message));
