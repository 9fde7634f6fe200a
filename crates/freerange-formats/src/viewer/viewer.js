"use strict";
// Shows 3D Gaussians with WebGL 2. Each is projected as the rasteriser of this program does it: the linearised projection of its covariance plus a
// blur of 0.3 square pixels, opacity at most 0.99 and nothing below 1/255, blended by camera z. Colours are as in image files (sRGB-encoded).

const CHANNELS = 14; // mean 3, log-scale 3, rotation wxyz 4, logit of opacity, colour 3
const TEXTURE_ROW = 1024; // Gaussians per row of the texture, four texels each

const VERTEX = `#version 300 es
precision highp float;
precision highp int;
uniform highp sampler2D gaussians;
uniform mat4 camera; // world to camera: x right, y down, z forward
uniform vec2 size, focal, middle;
uniform float near;
in uint index;
flat out vec4 color; // and opacity
flat out vec3 conic; // inverse covariance: xx, xy, yy
flat out vec2 center; // pixels, y down
vec4 texel(int k) {
  return texelFetch(gaussians, ivec2(int(index % ${TEXTURE_ROW}u) * 4 + k, int(index / ${TEXTURE_ROW}u)), 0);
}
void main() {
  gl_Position = vec4(2.0, 2.0, 2.0, 1.0); // outside, unless it is drawn
  vec4 a = texel(0), b = texel(1), c = texel(2), d = texel(3);
  vec3 p = (camera * vec4(a.xyz, 1.0)).xyz;
  if (!(p.z >= near) || a.w < 1.0 / 255.0) return;
  mat3 shape = mat3(b.xyz, vec3(b.w, c.xy), vec3(c.zw, d.x)); // rotation times standard deviations
  vec2 low = -(middle + 0.15 * size) / focal, high = (1.15 * size - middle) / focal;
  vec2 slope = clamp(p.xy / p.z, low, high);
  mat3 w = transpose(mat3(camera)); // its columns are the camera's axes
  vec3 u = (focal.x / p.z) * (w[0] - slope.x * w[2]) * shape;
  vec3 v = (focal.y / p.z) * (w[1] - slope.y * w[2]) * shape;
  const float BLUR = 0.3;
  float xx = dot(u, u), xy = dot(u, v), yy = dot(v, v);
  vec3 minors = cross(u, v); // the determinant as a sum of squares: differences would cancel for needles
  float det = dot(minors, minors) + BLUR * (xx + yy + BLUR);
  xx += BLUR;
  yy += BLUR;
  conic = vec3(yy, -xy, xx) / det;
  center = focal * p.xy / p.z + middle;
  color = vec4(d.yzw, a.w);
  vec2 reach = sqrt(2.0 * log(255.0 * a.w) * vec2(xx, yy)) + 0.5; // where the opacity falls to 1/255
  vec2 corner = vec2(gl_VertexID & 1, gl_VertexID >> 1) * 2.0 - 1.0;
  vec2 at = (center + corner * reach) / size * 2.0 - 1.0;
  gl_Position = vec4(at.x, -at.y, 0.0, 1.0);
}`;

const FRAGMENT = `#version 300 es
precision highp float;
uniform vec2 size;
flat in vec4 color;
flat in vec3 conic;
flat in vec2 center;
out vec4 result;
void main() {
  vec2 d = vec2(gl_FragCoord.x, size.y - gl_FragCoord.y) - center;
  float alpha = min(0.99, color.a * exp(-0.5 * (conic.x * d.x * d.x + 2.0 * conic.y * d.x * d.y + conic.z * d.y * d.y)));
  if (alpha < 1.0 / 255.0) discard;
  result = vec4(color.rgb * alpha, alpha);
}`;

const COPY_VERTEX = `#version 300 es
void main() { gl_Position = vec4(vec2(gl_VertexID & 1, gl_VertexID >> 1) * 4.0 - 1.0, 0.0, 1.0); }`;

const COPY_FRAGMENT = `#version 300 es
precision highp float;
uniform highp sampler2D sum;
uniform vec3 back;
out vec4 result;
void main() {
  vec4 s = texelFetch(sum, ivec2(gl_FragCoord.xy), 0);
  result = vec4(s.rgb + (1.0 - s.a) * back, 1.0);
}`;

const add = (a, b, s = 1) => a.map((x, i) => x + s * b[i]);
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const unit = (a) => a.map((x) => x / Math.hypot(...a));

class Viewer {
  // `up` is the direction that stays up; colours are an array of three in 0..1.
  constructor(canvas, { up = [0, 0, 1], background = [1, 1, 1] } = {}) {
    this.canvas = canvas;
    this.background = background;
    this.frames = this.count = 0;
    this.rows = this.depth = new Float32Array(0);
    this.sorted = [new Uint32Array(0), new Uint32Array(0)];
    this.up = unit(up);
    // Azimuth 0 looks along the first axis that is not up.
    const side = Math.abs(this.up[0]) < 0.9 ? [1, 0, 0] : [0, 1, 0];
    this.front = unit(add(side, this.up, -dot(side, this.up)));
    this.home = { target: [0, 0, 0], azimuth: 0, elevation: 20 * Math.PI / 180, distance: 1.6, fov: 45 };
    this.orbit = { ...this.home };
    this.near = 0.01;
    this.camera = null;
    this.onmove = this.ondraw = null;
    this.setUp();
    canvas.addEventListener("webglcontextlost", (e) => e.preventDefault());
    canvas.addEventListener("webglcontextrestored", () => { this.setUp(); this.setGaussians(this.rows); });
    new ResizeObserver(() => this.redraw()).observe(canvas);
    this.listen();
  }

  setUp() {
    const gl = this.canvas.getContext("webgl2", { antialias: false, alpha: false });
    if (!gl) throw new Error("This page needs WebGL 2, which this browser does not offer here.");
    this.gl = gl;
    // Sums of many faint Gaussians lose too much in 8 bits; where there are no more, they have to do.
    this.half = gl.getExtension("EXT_color_buffer_float") || gl.getExtension("EXT_color_buffer_half_float");
    this.draws = this.program(VERTEX, FRAGMENT);
    this.copies = this.program(COPY_VERTEX, COPY_FRAGMENT);
    this.texture = gl.createTexture();
    this.sum = gl.createTexture();
    this.target = gl.createFramebuffer();
    this.sumSize = [0, 0];
    this.order = gl.createBuffer();
    this.instances = gl.createVertexArray();
    this.nothing = gl.createVertexArray();
    gl.bindVertexArray(this.instances);
    gl.bindBuffer(gl.ARRAY_BUFFER, this.order);
    const index = gl.getAttribLocation(this.draws, "index");
    gl.enableVertexAttribArray(index);
    gl.vertexAttribIPointer(index, 1, gl.UNSIGNED_INT, 0, 0);
    gl.vertexAttribDivisor(index, 1);
  }

  program(vertex, fragment) {
    const gl = this.gl, program = gl.createProgram();
    for (const [kind, source] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, source);
      gl.compileShader(shader);
      gl.attachShader(program, shader);
    }
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS) && !gl.isContextLost()) throw new Error(gl.getProgramInfoLog(program));
    return program;
  }

  // Rows of 14 channels. Shows them from where the last ones were shown.
  setGaussians(rows) {
    const gl = this.gl, n = Math.floor(rows.length / CHANNELS), height = Math.max(1, Math.ceil(n / TEXTURE_ROW));
    const texels = new Float32Array(height * TEXTURE_ROW * 16);
    for (let i = 0; i < n; i++) {
      const r = rows.subarray(i * CHANNELS, (i + 1) * CHANNELS), norm = Math.hypot(r[6], r[7], r[8], r[9]) || 1;
      const [w, x, y, z] = [r[6] / norm, r[7] / norm, r[8] / norm, r[9] / norm];
      const [s, t, u] = [Math.exp(r[3]), Math.exp(r[4]), Math.exp(r[5])];
      texels.set([
        r[0], r[1], r[2], 1 / (1 + Math.exp(-r[10])),
        s * (1 - 2 * (y * y + z * z)), s * 2 * (x * y + w * z), s * 2 * (x * z - w * y),
        t * 2 * (x * y - w * z), t * (1 - 2 * (x * x + z * z)), t * 2 * (y * z + w * x),
        u * 2 * (x * z + w * y), u * 2 * (y * z - w * x), u * (1 - 2 * (x * x + y * y)),
        r[11], r[12], r[13],
      ], i * 16);
    }
    this.rows = rows;
    this.count = n;
    this.depth = new Float32Array(n);
    this.sorted = [new Uint32Array(n), new Uint32Array(n)];
    gl.bindTexture(gl.TEXTURE_2D, this.texture);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA32F, TEXTURE_ROW * 4, height, 0, gl.RGBA, gl.FLOAT, texels);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.NEAREST);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.NEAREST);
    this.redraw();
  }

  // Looks at everything but stragglers.
  frameAll() {
    const n = this.count, at = (i, k) => this.rows[i * CHANNELS + k];
    if (n === 0) return;
    const sides = [0, 1, 2].map((k) => {
      const sorted = Float32Array.from({ length: n }, (_, i) => at(i, k)).sort();
      return [sorted[Math.floor(0.01 * (n - 1))], sorted[Math.ceil(0.99 * (n - 1))]];
    });
    const target = sides.map(([a, b]) => (a + b) / 2);
    this.frameSphere(target, Math.hypot(...sides.map(([a, b]) => (b - a) / 2)) || 1);
  }

  // Looks at a sphere.
  frameSphere(target, radius) {
    this.near = Math.min(0.01, radius / 100);
    this.home = { ...this.home, target, distance: 3.2 * radius };
    this.orbit = { ...this.home };
    this.camera = null;
    this.redraw();
  }

  // From `eye` to `target`; `fov` is the vertical angle in degrees.
  lookAt(eye, target, fov = this.orbit.fov) {
    const away = add(eye, target, -1), distance = Math.hypot(...away), side = cross(this.up, this.front);
    const elevation = Math.asin(Math.max(-1, Math.min(1, dot(away, this.up) / distance)));
    this.orbit = { target, fov, distance, elevation, azimuth: Math.atan2(dot(away, side), dot(away, this.front)) };
    this.camera = null;
    this.redraw();
  }

  // Looks through a pinhole camera until the next turn: `width`, `height`, `fx`, `fy`, `cx`, `cy` in pixels, and the 16 numbers, by columns, of
  // `world_to_camera` (x right, y down, z forward). What it saw fills the canvas.
  setCamera(camera) {
    this.camera = camera;
    this.redraw();
  }

  // Orbits on from where a given camera stood.
  leaveCamera() {
    if (!this.camera) return;
    const { eye } = this.pose(), { height, fy } = this.camera;
    this.lookAt(eye, this.home.target, 2 * Math.atan(height / 2 / fy) * 180 / Math.PI);
  }

  // The camera's axes in the world, and where it is.
  pose() {
    if (this.camera) {
      const m = this.camera.world_to_camera, row = (k) => [m[k], m[k + 4], m[k + 8]], shift = [m[12], m[13], m[14]];
      const [right, down, forward] = [0, 1, 2].map(row);
      return { right, down, forward, eye: [0, 1, 2].map((k) => -(right[k] * shift[0] + down[k] * shift[1] + forward[k] * shift[2])) };
    }
    const { target, azimuth, elevation, distance } = this.orbit, side = cross(this.up, this.front);
    const flat = add(this.front.map((x) => x * Math.cos(azimuth)), side, Math.sin(azimuth));
    const away = add(flat.map((x) => x * Math.cos(elevation)), this.up, Math.sin(elevation));
    const right = add(this.front.map((x) => -x * Math.sin(azimuth)), side, Math.cos(azimuth));
    const forward = away.map((x) => -x);
    return { right, down: cross(forward, right), forward, eye: add(target, away, distance) };
  }

  // Focal lengths and principal point for a picture of `size`, in its pixels.
  lens(size) {
    if (this.camera) {
      const { width, height, fx, fy, cx, cy } = this.camera, [x, y] = [size[0] / width, size[1] / height];
      return { focal: [fx * x, fy * y], middle: [cx * x, cy * y] };
    }
    const focal = size[1] / 2 / Math.tan(this.orbit.fov * Math.PI / 360);
    return { focal: [focal, focal], middle: size.map((v) => v / 2) };
  }

  redraw() {
    this.pending ??= requestAnimationFrame(() => this.draw());
  }

  draw() {
    cancelAnimationFrame(this.pending);
    this.pending = undefined;
    const gl = this.gl, ratio = window.devicePixelRatio || 1;
    const size = [this.canvas.clientWidth, this.canvas.clientHeight].map((v) => Math.max(1, Math.round(v * ratio)));
    if (gl.isContextLost()) return;
    if (this.canvas.width !== size[0]) this.canvas.width = size[0];
    if (this.canvas.height !== size[1]) this.canvas.height = size[1];
    const { right, down, forward, eye } = this.pose(), axes = [right, down, forward];
    const { focal, middle } = this.lens(size);
    this.sort(forward, eye);

    gl.viewport(0, 0, ...size);
    if (this.half) this.bindSum(size);
    const back = this.background;
    if (this.half) gl.clearColor(0, 0, 0, 0);
    else gl.clearColor(...back, 1);
    gl.clear(gl.COLOR_BUFFER_BIT);
    gl.useProgram(this.draws);
    const at = (name) => gl.getUniformLocation(this.draws, name);
    gl.uniformMatrix4fv(at("camera"), false, [0, 1, 2].flatMap((k) => [...axes.map((a) => a[k]), 0])
      .concat(axes.map((a) => -dot(a, eye)), 1));
    gl.uniform2f(at("size"), ...size);
    gl.uniform2f(at("focal"), ...focal);
    gl.uniform2f(at("middle"), ...middle);
    gl.uniform1f(at("near"), this.near);
    gl.bindTexture(gl.TEXTURE_2D, this.texture);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    gl.bindVertexArray(this.instances);
    gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, this.count);
    gl.disable(gl.BLEND);
    if (this.half) {
      gl.bindFramebuffer(gl.FRAMEBUFFER, null);
      gl.useProgram(this.copies);
      gl.uniform3f(gl.getUniformLocation(this.copies, "back"), ...back);
      gl.bindTexture(gl.TEXTURE_2D, this.sum);
      gl.bindVertexArray(this.nothing);
      gl.drawArrays(gl.TRIANGLES, 0, 3);
    }
    this.frames += 1;
    this.canvas.dataset.frames = this.frames;
    this.ondraw?.(this);
  }

  bindSum(size) {
    const gl = this.gl;
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.target);
    if (this.sumSize[0] === size[0] && this.sumSize[1] === size[1]) return;
    this.sumSize = size;
    gl.bindTexture(gl.TEXTURE_2D, this.sum);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA16F, ...size, 0, gl.RGBA, gl.HALF_FLOAT, null);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.NEAREST);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.NEAREST);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, this.sum, 0);
  }

  // From far to near; of equals the last first. Bits of positive floats are ordered as they are: three passes of 11 bits.
  sort(forward, eye) {
    const n = this.count;
    if (n === 0) return;
    const bits = new Uint32Array(this.depth.buffer), offset = dot(forward, eye);
    for (let i = 0; i < n; i++) {
      const z = forward[0] * this.rows[i * CHANNELS] + forward[1] * this.rows[i * CHANNELS + 1] + forward[2] * this.rows[i * CHANNELS + 2];
      this.depth[i] = Math.max(0, z - offset);
      this.sorted[0][i] = n - 1 - i;
    }
    for (let pass = 0; pass < 3; pass++) {
      const [from, to] = pass % 2 ? [this.sorted[1], this.sorted[0]] : this.sorted, shift = 11 * pass;
      const start = new Uint32Array(2049);
      for (let i = 0; i < n; i++) start[2048 - (bits[i] >>> shift & 2047)] += 1;
      for (let k = 1; k < 2049; k++) start[k] += start[k - 1];
      for (let i = n - 1; i >= 0; i--) to[--start[2048 - (bits[from[i]] >>> shift & 2047)]] = from[i];
    }
    this.gl.bindBuffer(this.gl.ARRAY_BUFFER, this.order);
    this.gl.bufferData(this.gl.ARRAY_BUFFER, this.sorted[1], this.gl.DYNAMIC_DRAW);
  }

  turn(azimuth, elevation) {
    this.leaveCamera();
    const o = this.orbit, limit = 89.5 * Math.PI / 180;
    o.azimuth += azimuth;
    o.elevation = Math.max(-limit, Math.min(limit, o.elevation + elevation));
    this.moved();
  }

  zoom(factor) {
    this.leaveCamera();
    this.orbit.distance = Math.max(2 * this.near, Math.min(1e3 * this.home.distance, this.orbit.distance * factor));
    this.moved();
  }

  // In fractions of the picture's height.
  move(x, y) {
    this.leaveCamera();
    const { right, down } = this.pose(), o = this.orbit, height = 2 * o.distance * Math.tan(o.fov * Math.PI / 360);
    o.target = add(add(o.target, right, -x * height), down, -y * height);
    this.moved();
  }

  reset() {
    this.orbit = { ...this.home };
    this.camera = null;
    this.moved();
  }

  // Whoever looked elsewhere was a person: `onmove` hears of it.
  moved() {
    this.redraw();
    this.onmove?.(this);
  }

  // What buttons and keys do.
  do(name) {
    const step = 10 * Math.PI / 180;
    const actions = {
      left: () => this.turn(-step, 0), right: () => this.turn(step, 0), up: () => this.turn(0, step), down: () => this.turn(0, -step),
      closer: () => this.zoom(0.85), farther: () => this.zoom(1 / 0.85), reset: () => this.reset(),
      moveLeft: () => this.move(0.05, 0), moveRight: () => this.move(-0.05, 0), moveUp: () => this.move(0, 0.05), moveDown: () => this.move(0, -0.05),
    };
    actions[name]?.();
  }

  listen() {
    const canvas = this.canvas, fingers = new Map();
    const keys = { ArrowLeft: "left", ArrowRight: "right", ArrowUp: "up", ArrowDown: "down", "+": "closer", "=": "closer", "-": "farther", _: "farther", Home: "reset" };
    const moves = { ArrowLeft: "moveLeft", ArrowRight: "moveRight", ArrowUp: "moveUp", ArrowDown: "moveDown" };
    canvas.addEventListener("keydown", (e) => {
      const name = (e.shiftKey && moves[e.key]) || keys[e.key];
      if (!name || e.ctrlKey || e.altKey || e.metaKey) return;
      e.preventDefault();
      this.do(name);
    });
    canvas.addEventListener("wheel", (e) => {
      e.preventDefault();
      this.zoom(Math.exp(e.deltaY * (e.deltaMode === 1 ? 0.04 : 0.0015)));
    }, { passive: false });
    canvas.addEventListener("contextmenu", (e) => e.preventDefault());
    canvas.addEventListener("pointerdown", (e) => {
      canvas.setPointerCapture(e.pointerId);
      fingers.set(e.pointerId, [e.clientX, e.clientY]);
    });
    for (const name of ["pointerup", "pointercancel"]) canvas.addEventListener(name, (e) => fingers.delete(e.pointerId));
    canvas.addEventListener("pointermove", (e) => {
      const before = fingers.get(e.pointerId);
      if (!before) return;
      const now = [e.clientX, e.clientY], height = Math.max(1, canvas.clientHeight);
      const [x, y] = [(now[0] - before[0]) / height, (now[1] - before[1]) / height];
      if (fingers.size === 2) {
        const [, other] = [...fingers].find(([id]) => id !== e.pointerId);
        const apart = (p) => Math.max(1, Math.hypot(p[0] - other[0], p[1] - other[1]));
        this.zoom(apart(before) / apart(now));
        this.move(x / 2, y / 2);
      } else if (fingers.size === 1) {
        if (e.shiftKey || e.buttons & 6) this.move(x, y);
        else this.turn(-x * Math.PI, y * Math.PI);
      }
      fingers.set(e.pointerId, now);
    });
  }
}

// The page: the Gaussians that are in it. `#eye=x,y,z&target=x,y,z&fov=degrees` in the address says where to look from.
function start(data) {
  const root = document.documentElement, status = document.getElementById("status");
  try {
    const bytes = Uint8Array.from(atob(data.textContent.trim()), (c) => c.charCodeAt(0));
    const back = () => getComputedStyle(root).getPropertyValue("--back").trim().match(/[0-9a-f]{2}/gi).map((h) => parseInt(h, 16) / 255);
    const viewer = new Viewer(document.getElementById("view"), { up: data.dataset.up.split(" ").map(Number), background: back() });
    Object.assign(window, { viewer });
    const repaint = () => { viewer.background = back(); viewer.redraw(); };
    const dark = window.matchMedia("(prefers-color-scheme: dark)");
    dark.addEventListener("change", repaint);
    document.getElementById("tools").addEventListener("click", (e) => {
      const name = e.target instanceof HTMLElement ? e.target.dataset.do : undefined;
      if (name === "background") {
        root.dataset.theme = (root.dataset.theme ?? (dark.matches ? "dark" : "light")) === "dark" ? "light" : "dark";
        repaint();
      } else if (name) viewer.do(name);
    });
    viewer.setGaussians(new Float32Array(bytes.buffer));
    viewer.frameAll();
    const look = () => {
      const given = new URLSearchParams(location.hash.slice(1)), numbers = (name) => given.get(name)?.split(",").map(Number);
      const [eye, target = viewer.home.target, [fov] = [viewer.home.fov]] = ["eye", "target", "fov"].map(numbers);
      if (eye?.length === 3 && target.length === 3 && [...eye, ...target, fov].every(Number.isFinite)) viewer.lookAt(eye, target, fov);
    };
    window.addEventListener("hashchange", look);
    look();
    status.textContent = `${viewer.count} Gaussians`;
  } catch (error) {
    status.textContent = error.message;
  }
}

const data = document.getElementById("gaussians");
if (data) start(data);
