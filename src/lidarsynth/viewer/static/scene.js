// The graphics card draws: WebGL 2. `Splat` (splat.js) has the same methods, for machines without a card.

const BACKGROUND = [11, 13, 17];
const LARGEST = 6; // pixels of a point, on a view of up to 720 pixels
const DISTANCE = 16; // metres at which a point has the chosen size, on a view 720 pixels tall

// What makes a point's size in pixels when divided by the root of its distance: near points grow, but not over all.
function pointScale(pixels, height, share) {
  return (pixels * Math.sqrt(DISTANCE / share) * height) / 720;
}

// Pixels of the largest point: as many more as the view has, so that screens of fine pixels do not cut sizes off.
function largestOf(height) {
  return LARGEST * Math.max(height / 720, 1);
}

const POINT_SHADER = `#version 300 es
layout(location = 0) in vec3 place;
layout(location = 1) in vec3 colour;
uniform mat4 matrix;
uniform float size, largest;
flat out vec3 shade;
void main() {
  gl_Position = matrix * vec4(place, 1);
  gl_PointSize = clamp(size * inversesqrt(gl_Position.w), 1.0, largest);
  shade = colour;
}`;
const PAINT_SHADER = `#version 300 es
precision mediump float;
flat in vec3 shade;
out vec4 painted;
void main() { painted = vec4(shade, 1); }`;


class Card {
  constructor(canvas, gl) {
    this.canvas = canvas;
    this.gl = gl;
    this.program = linked(gl, POINT_SHADER, PAINT_SHADER);
    this.matrix = gl.getUniformLocation(this.program, "matrix");
    this.size = gl.getUniformLocation(this.program, "size");
    this.largest = gl.getUniformLocation(this.program, "largest");
    this.points = this.layer(Float32Array.of(), Uint8Array.of());
    this.lines = [];
    gl.useProgram(this.program);
    gl.enable(gl.DEPTH_TEST);
    gl.clearColor(...BACKGROUND.map((v) => v / 255), 1);
  }

  layer(xyz, rgba) {
    const gl = this.gl, layer = { array: gl.createVertexArray(), xyz: gl.createBuffer(), rgba: gl.createBuffer(), n: xyz.length / 3 };
    gl.bindVertexArray(layer.array);
    gl.bindBuffer(gl.ARRAY_BUFFER, layer.xyz);
    gl.bufferData(gl.ARRAY_BUFFER, xyz, gl.STATIC_DRAW);
    gl.enableVertexAttribArray(0);
    gl.vertexAttribPointer(0, 3, gl.FLOAT, false, 0, 0);
    this.paint(layer, rgba);
    gl.enableVertexAttribArray(1);
    gl.vertexAttribPointer(1, 4, gl.UNSIGNED_BYTE, true, 4, 0);
    return layer;
  }

  paint(layer, rgba) {
    const gl = this.gl;
    gl.bindBuffer(gl.ARRAY_BUFFER, layer.rgba);
    gl.bufferData(gl.ARRAY_BUFFER, rgba, gl.STATIC_DRAW);
  }

  free(layer) {
    this.gl.deleteVertexArray(layer.array);
    this.gl.deleteBuffer(layer.xyz);
    this.gl.deleteBuffer(layer.rgba);
  }

  setPoints(xyz, rgba) {
    this.free(this.points);
    this.points = this.layer(xyz, rgba);
  }

  setLines(layers) {
    this.lines.forEach((layer) => this.free(layer));
    this.lines = layers.map(({ xyz, rgba }) => this.layer(xyz, rgba));
  }

  recolour(rgba) { this.paint(this.points, rgba); }

  // Waits until all is drawn.
  finish() { this.gl.readPixels(0, 0, 1, 1, this.gl.RGBA, this.gl.UNSIGNED_BYTE, new Uint8Array(4)); }

  // share: of the points, evenly spread, for while the camera moves; pixels: of a point at DISTANCE
  draw(camera, pixels, share = 1) {
    fit(this.canvas, 2);
    const gl = this.gl, { width, height } = this.canvas;
    gl.viewport(0, 0, width, height);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.uniformMatrix4fv(this.matrix, false, camera.matrix(width / height));
    gl.uniform1f(this.size, pointScale(pixels, height, share));
    gl.uniform1f(this.largest, largestOf(height));
    gl.bindVertexArray(this.points.array);
    gl.drawArrays(gl.POINTS, 0, Math.ceil(this.points.n * share));
    for (const layer of this.lines) {
      gl.bindVertexArray(layer.array);
      gl.drawArrays(gl.LINES, 0, layer.n);
    }
  }
}

function linked(gl, vertex, fragment) {
  const program = gl.createProgram();
  for (const [kind, text] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, text);
    gl.compileShader(shader);
    if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
    gl.attachShader(program, shader);
  }
  gl.linkProgram(program);
  return program;
}

// Whoever draws faster here. An address that ends in #card or #splat decides it.
function sceneOn(canvas) {
  const forced = location.hash.slice(1), options = { alpha: false, antialias: false, powerPreference: "high-performance" };
  const card = forced === "card" || (forced !== "splat" && hasCard());
  const gl = card ? canvas.getContext("webgl2", options) : null;
  return gl ? new Card(canvas, gl) : new Splat(canvas);
}

// Whether WebGL 2 is there and done by a graphics card: asked of another canvas, as each has one kind of context.
function hasCard() {
  const gl = made("canvas").getContext("webgl2", { failIfMajorPerformanceCaveat: true });
  const names = gl && gl.getExtension("WEBGL_debug_renderer_info");
  const name = gl ? gl.getParameter(names ? names.UNMASKED_RENDERER_WEBGL : gl.RENDERER) : "software";
  gl?.getExtension("WEBGL_lose_context")?.loseContext();
  return !/swiftshader|llvmpipe|softpipe|software|basic render/i.test(name);
}

// The canvas as many pixels as it has on the screen, `sharpest` of them at most for one of the page's.
function fit(canvas, sharpest) {
  const scale = Math.min(window.devicePixelRatio || 1, sharpest);
  const width = Math.max(Math.round(canvas.clientWidth * scale), 1), height = Math.max(Math.round(canvas.clientHeight * scale), 1);
  if (canvas.width === width && canvas.height === height) return false;
  Object.assign(canvas, { width, height });
  return true;
}
