// When to draw: on a change, once; while the camera moves, as many points as the machine draws 60 times a second.

const SMOOTH = 1000 / 60, STILL = 160; // milliseconds: of a frame, and until the camera counts as standing still
const FEWEST = 0.25; // share of the points

class Motion {
  constructor(scene, camera) {
    Object.assign(this, { scene, camera, share: 1, asked: false, moving: false, last: 0, still: 0 });
    new ResizeObserver(() => this.redraw()).observe(scene.canvas);
  }

  redraw() {
    if (this.asked) return;
    this.asked = true;
    requestAnimationFrame((now) => this.frame(now));
  }

  move() {
    this.moving = true;
    clearTimeout(this.still);
    this.still = setTimeout(() => { this.moving = false; this.last = 0; this.redraw(); }, STILL);
    this.redraw();
  }

  frame(now) {
    this.asked = false;
    if (this.moving && this.last) this.adapt(now - this.last);
    this.last = this.moving ? now : 0;
    this.paint(this.moving ? this.whole() : 1);
  }

  // Fewer points after a slow frame, more after frames in time.
  adapt(took) {
    if (took > 8 * SMOOTH) return; // the pointer had paused
    const factor = took > 1.35 * SMOOTH ? 0.82 : took < 1.1 * SMOOTH ? 1.06 : 1;
    this.share = Math.min(Math.max(this.share * factor, FEWEST), 1);
  }

  // The share in whole passes: part of one would be the upper beams only.
  whole() { return Math.ceil(this.share * PASSES.length) / PASSES.length; }

  paint(share) {
    this.scene.draw(this.camera, Number($("size").value), share);
    placeLabels(this.camera, this.scene.canvas);
  }

  // Frames a second over so many frames of a turning camera; each is waited for. `share` null: as while it moves.
  async measure(frames, share = 1) {
    const begun = performance.now();
    let before = begun;
    for (let k = 0; k < frames; k++) {
      await new Promise((done) => requestAnimationFrame(done));
      this.camera.turn += 0.01;
      this.paint(share ?? this.whole());
      this.scene.finish();
      const now = performance.now();
      if (share === null) this.adapt(now - before);
      before = now;
    }
    return (1000 * frames) / (performance.now() - begun);
  }
}

// Metres beside the rings of distance, a ring around the point that is pointed at, and one around the pin.
function placeLabels(camera, canvas) {
  const { clientWidth: width, clientHeight: height } = canvas; // asked once: after a change it would be laid out anew
  const m = camera.matrix(width / height), host = $("distances");
  const put = (element, at, wanted = true) => {
    const [x, y, w] = projected(m, ...at), here = wanted && w > 0 && Math.abs(x) < 1 && Math.abs(y) < 1;
    if (element.hidden === here) element.hidden = !here;
    if (here) element.style.transform = `translate(${((x + 1) / 2) * width}px, ${((1 - y) / 2) * height}px)`;
  };
  if (!host.childElementCount) host.append(...RINGS.map((d) => made("span", "", `${d} m`)));
  RINGS.forEach((d, k) => {
    const turn = camera.turn + Math.PI; // on the far side, ahead of who looks
    put(host.children[k], [d * Math.cos(turn), d * Math.sin(turn), settings.ground], $("rings").checked);
  });
  const mark = state.mark === null ? [0, 0, 0] : state.scan.xyz.subarray(3 * state.mark, 3 * state.mark + 3);
  put($("cross"), mark, state.mark !== null);
  put($("pin"), state.pin ?? [0, 0, 0], state.pin !== null);
}
