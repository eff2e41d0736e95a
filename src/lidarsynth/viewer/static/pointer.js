// Mouse and fingers: turn, move, nearer; and what lies under the pointer.

const REST = 60; // milliseconds until the point under a resting pointer is looked up
const CATCH = 12; // pixels around the pointer
const STEADY = 4; // pixels that the pointer moves at most between down and up of a click

function steer(canvas, strips) {
  const down = new Map();
  let spread = 0, rest = 0, start = [0, 0];
  canvas.addEventListener("pointerdown", (event) => {
    canvas.focus();
    canvas.setPointerCapture(event.pointerId);
    start = [event.clientX, event.clientY];
    down.set(event.pointerId, [event.clientX, event.clientY]);
    spread = 0;
  });
  for (const kind of ["pointerup", "pointercancel"]) canvas.addEventListener(kind, (event) => { down.delete(event.pointerId); spread = 0; });
  canvas.addEventListener("pointerleave", () => { clearTimeout(rest); if (!down.size) pointAt(null); });
  canvas.addEventListener("pointermove", (event) => {
    const before = down.get(event.pointerId), here = [event.clientX, event.clientY];
    clearTimeout(rest);
    if (!before) return void (rest = setTimeout(() => pointAt(pick(canvas, ...here)), REST));
    const dx = here[0] - before[0], dy = here[1] - before[1];
    down.set(event.pointerId, here);
    if (down.size > 1) {
      const [[ax, ay], [bx, by]] = [...down.values()], now = Math.hypot(ax - bx, ay - by);
      if (spread) camera.zoom(spread / now);
      spread = now;
      camera.pan(dx / 2, dy / 2, canvas.clientHeight);
    } else if (event.shiftKey || event.buttons & 6) camera.pan(dx, dy, canvas.clientHeight);
    else camera.orbit(dx, dy);
    press("views", "");
    motion.move();
  });
  canvas.addEventListener("contextmenu", (event) => event.preventDefault());
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    camera.zoom(Math.exp(Math.max(-120, Math.min(120, event.deltaY)) * 0.0016));
    press("views", "");
    motion.move();
  }, { passive: false });
  canvas.addEventListener("click", (event) => {
    if (Math.hypot(event.clientX - start[0], event.clientY - start[1]) <= STEADY) clicked(event, pick(canvas, event.clientX, event.clientY));
  });
  canvas.addEventListener("dblclick", (event) => about(pick(canvas, event.clientX, event.clientY)));
  strips.addEventListener("pointermove", (event) => pointAt(pixelUnder(event)));
  strips.addEventListener("pointerleave", () => pointAt(null));
  strips.addEventListener("click", (event) => clicked(event, pixelUnder(event)));
  strips.addEventListener("dblclick", (event) => about(pixelUnder(event)));
}

// The second click of two takes back what the first did: a double click pins nothing.
function clicked(event, i) {
  if (event.shiftKey || !state.scan) return;
  if (event.detail > 1) state.pin = state.pinBefore;
  else {
    state.pinBefore = state.pin;
    pinAt(i);
  }
}

function about(i) {
  if (i === null) return;
  camera.target = [...state.scan.xyz.subarray(3 * i, 3 * i + 3)];
  camera.distance = Math.min(camera.distance, 18);
  press("views", "");
  motion.redraw();
}

// The point nearest to the eye among those next to the pointer.
function pick(canvas, clientX, clientY) {
  if (!state.scan) return null;
  const box = canvas.getBoundingClientRect(), m = camera.matrix(box.width / box.height), { xyz, n } = state.scan, { drawn } = state;
  const px = ((clientX - box.left) / box.width) * 2 - 1, py = 1 - ((clientY - box.top) / box.height) * 2;
  let best = null, least = Infinity;
  for (let i = 0; i < n; i++) {
    const [x, y, w] = projected(m, xyz[3 * i], xyz[3 * i + 1], xyz[3 * i + 2]);
    if (w <= 0 || (drawn && !drawn[i])) continue;
    const away = Math.hypot(((x - px) * box.width) / 2, ((y - py) * box.height) / 2);
    if (away < CATCH && w * (1 + away) < least) [best, least] = [i, w * (1 + away)];
  }
  return best;
}

function pixelUnder(event) {
  const canvas = event.target.closest("canvas");
  if (!canvas || !state.scan) return null;
  const box = canvas.getBoundingClientRect(), { height, width } = state.scan.strip;
  const column = Math.min(Math.floor(((event.clientX - box.left) / box.width) * width), width - 1);
  const row = Math.min(Math.floor(((event.clientY - box.top) / box.height) * height), height - 1);
  const point = state.pixels[Math.max(row, 0) * width + Math.max(column, 0)];
  return point < 0 ? null : point;
}
