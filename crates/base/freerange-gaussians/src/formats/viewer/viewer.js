"use strict";
// Shows 3D Gaussians, with WebGL 2 where there is a graphics card, else with loops of our own. Each is projected as the rasteriser of this program does
// it: the linearised projection of its covariance plus a blur of 0.3 square pixels, opacity at most 0.99 and nothing below 1/255, blended by camera z.
// Colours are as in image files (sRGB-encoded).

const CHANNELS = 14; // mean 3, log-scale 3, rotation wxyz 4, logit of opacity, colour 3
const TEXTURE_ROW = 1024; // Gaussians per row of the texture, four texels each
const BLUR = 0.3; // square pixels
const BUDGET = 1000 / 30; // milliseconds for a picture of many in motion
const REST = 150; // milliseconds without motion after which a picture may take its time

// Four vertices per Gaussian, which may not be instances: processors that play graphics cards draw each instance for itself.
const VERTEX = `#version 300 es
precision highp float;
precision highp int;
uniform highp sampler2D gaussians;
uniform highp usampler2D order;
uniform mat4 camera; // world to camera: x right, y down, z forward
uniform vec2 size, focal, middle;
uniform float near;
flat out vec4 color; // and opacity
out vec2 local; // in standard deviations, along the ellipse's axes
void main() {
  gl_Position = vec4(2.0, 2.0, 2.0, 1.0); // outside, unless it is drawn
  int place = gl_VertexID >> 2;
  int index = int(texelFetch(order, ivec2(place % ${TEXTURE_ROW}, place / ${TEXTURE_ROW}), 0).x);
  ivec2 first = ivec2(index % ${TEXTURE_ROW} * 4, index / ${TEXTURE_ROW});
  vec4 a = texelFetch(gaussians, first, 0);
  vec3 p = (camera * vec4(a.xyz, 1.0)).xyz;
  if (!(p.z >= near) || a.w < 1.0 / 255.0) return;
  vec4 b = texelFetch(gaussians, first + ivec2(1, 0), 0), c = texelFetch(gaussians, first + ivec2(2, 0), 0), d = texelFetch(gaussians, first + ivec2(3, 0), 0);
  mat3 shape = mat3(b.xyz, vec3(b.w, c.xy), vec3(c.zw, d.x)); // rotation times standard deviations
  vec2 low = -(middle + 0.15 * size) / focal, high = (1.15 * size - middle) / focal;
  vec2 slope = clamp(p.xy / p.z, low, high);
  mat3 w = transpose(mat3(camera)); // its columns are the camera's axes
  vec3 u = (focal.x / p.z) * (w[0] - slope.x * w[2]) * shape;
  vec3 v = (focal.y / p.z) * (w[1] - slope.y * w[2]) * shape;
  float xx = dot(u, u), xy = dot(u, v), yy = dot(v, v);
  vec3 minors = cross(u, v); // the determinant as a sum of squares: differences would cancel for needles
  float det = dot(minors, minors) + ${BLUR} * (xx + yy + ${BLUR});
  // The ellipse's axes: a box along them is the smallest.
  float lean = 0.5 * (xx - yy), apart = length(vec2(lean, xy)), most = 0.5 * (xx + yy) + ${BLUR} + apart;
  vec2 along = apart == 0.0 ? vec2(1.0, 0.0) : normalize(lean > 0.0 ? vec2(lean + apart, xy) : vec2(xy, apart - lean));
  vec2 deviations = sqrt(vec2(most, det / most));
  local = (vec2(gl_VertexID & 1, gl_VertexID >> 1 & 1) * 2.0 - 1.0) * (sqrt(2.0 * log(255.0 * a.w)) + 0.5 / deviations); // where the opacity falls to 1/255
  color = vec4(d.yzw, a.w);
  vec2 at = (focal * p.xy / p.z + middle + mat2(along, -along.y, along.x) * (local * deviations)) / size * 2.0 - 1.0;
  gl_Position = vec4(at.x, -at.y, 0.0, 1.0);
}`;

const FRAGMENT = `#version 300 es
precision highp float;
flat in vec4 color;
in vec2 local;
out vec4 result;
void main() {
  float alpha = min(0.99, color.a * exp(-0.5 * dot(local, local)));
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
const resize = (canvas, [width, height]) => { if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height }); };

// What draws: `setGaussians` takes four texels of four numbers each per Gaussian (mean and opacity, rotation times deviations by columns, colour); `begin`
// starts a picture, `step` draws some of it and is true when it is done; `cost` is how many milliseconds the last one took, once it is not `busy`.

// With WebGL 2.
class Card {
  constructor(gl) {
    this.gl = gl;
    this.cost = 0;
    this.fence = null;
    // Sums of many faint Gaussians lose too much in 8 bits; where there are no more, they have to do.
    this.half = gl.getExtension("EXT_color_buffer_float") || gl.getExtension("EXT_color_buffer_half_float");
    this.draws = this.program(VERTEX, FRAGMENT);
    this.copies = this.program(COPY_VERTEX, COPY_FRAGMENT);
    this.texture = this.plain();
    this.order = this.plain();
    this.sum = this.plain();
    this.target = gl.createFramebuffer();
    this.sumSize = [0, 0];
    this.quads = gl.createVertexArray();
    this.nothing = gl.createVertexArray();
    gl.bindVertexArray(this.quads);
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
    this.room = this.count = 0;
  }

  // A texture of numbers, not to be smoothed.
  plain() {
    const gl = this.gl, texture = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_2D, texture);
    for (const name of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, name, gl.NEAREST);
    return texture;
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

  setGaussians(texels, count) {
    const gl = this.gl, height = texels.length / TEXTURE_ROW / 16;
    this.count = count;
    gl.bindTexture(gl.TEXTURE_2D, this.texture);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA32F, TEXTURE_ROW * 4, height, 0, gl.RGBA, gl.FLOAT, texels);
    if (this.room >= count) return;
    this.room = height * TEXTURE_ROW;
    const corners = new Uint32Array(6 * this.room);
    for (let i = 0; i < this.room; i++) corners.set([4 * i, 4 * i + 1, 4 * i + 2, 4 * i + 2, 4 * i + 1, 4 * i + 3], 6 * i);
    gl.bindVertexArray(this.quads);
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, corners, gl.STATIC_DRAW);
  }

  begin({ size, axes, eye, focal, middle, near, background }, sorted, changed) {
    const gl = this.gl;
    this.started = performance.now();
    resize(gl.canvas, size);
    gl.viewport(0, 0, ...size);
    if (this.half) this.bindSum(size);
    if (this.half) gl.clearColor(0, 0, 0, 0);
    else gl.clearColor(...background, 1);
    gl.clear(gl.COLOR_BUFFER_BIT);
    gl.useProgram(this.draws);
    const at = (name) => gl.getUniformLocation(this.draws, name);
    gl.uniformMatrix4fv(at("camera"), false, [0, 1, 2].flatMap((k) => [...axes.map((a) => a[k]), 0])
      .concat(axes.map((a) => -dot(a, eye)), 1));
    gl.uniform2f(at("size"), ...size);
    gl.uniform2f(at("focal"), ...focal);
    gl.uniform2f(at("middle"), ...middle);
    gl.uniform1f(at("near"), near);
    gl.uniform1i(at("order"), 1);
    gl.activeTexture(gl.TEXTURE1);
    gl.bindTexture(gl.TEXTURE_2D, this.order);
    if (changed) gl.texImage2D(gl.TEXTURE_2D, 0, gl.R32UI, TEXTURE_ROW, sorted.length / TEXTURE_ROW, 0, gl.RED_INTEGER, gl.UNSIGNED_INT, sorted);
    gl.activeTexture(gl.TEXTURE0);
    gl.bindTexture(gl.TEXTURE_2D, this.texture);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    gl.bindVertexArray(this.quads);
    gl.drawElements(gl.TRIANGLES, 6 * this.count, gl.UNSIGNED_INT, 0);
    gl.disable(gl.BLEND);
    if (this.half) {
      gl.bindFramebuffer(gl.FRAMEBUFFER, null);
      gl.useProgram(this.copies);
      gl.uniform3f(gl.getUniformLocation(this.copies, "back"), ...background);
      gl.bindTexture(gl.TEXTURE_2D, this.sum);
      gl.bindVertexArray(this.nothing);
      gl.drawArrays(gl.TRIANGLES, 0, 3);
    }
    if (this.fence) gl.deleteSync(this.fence);
    this.fence = gl.fenceSync(gl.SYNC_GPU_COMMANDS_COMPLETE, 0);
    gl.flush();
  }

  step() {
    return true;
  }

  busy() {
    const gl = this.gl;
    if (!this.fence || gl.isContextLost()) return false;
    if (gl.getSyncParameter(this.fence, gl.SYNC_STATUS) !== gl.SIGNALED) return true;
    this.cost = performance.now() - this.started;
    gl.deleteSync(this.fence);
    this.fence = null;
    return false;
  }

  // Waits for the picture, for measurements.
  finish() {
    this.gl.readPixels(0, 0, 1, 1, this.gl.RGBA, this.gl.UNSIGNED_BYTE, new Uint8Array(4));
  }

  bindSum(size) {
    const gl = this.gl;
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.target);
    if (this.sumSize[0] === size[0] && this.sumSize[1] === size[1]) return;
    this.sumSize = size;
    gl.bindTexture(gl.TEXTURE_2D, this.sum);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA16F, ...size, 0, gl.RGBA, gl.HALF_FLOAT, null);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, this.sum, 0);
  }
}

// exp() between -12 and 12, several times as quick as Math.exp(), to ten digits.
const EXP = Float64Array.from({ length: 24 * 64 + 1 }, (_, i) => Math.exp(i / 64 - 12));
const exp = (x) => {
  const i = Math.round(64 * x), r = x - i / 64;
  return EXP[i + 768] * (1 + r * (1 + r * (0.5 + r * (1 / 6))));
};

const SHAPE = 14; // first and last row, centre 2, inverse covariance 3 (xx, xy, yy), inverse determinant, opacity, limit of the exponent, colour 3, free

// Blends shapes, from far to near, into the rows from `top` to before `bottom`; `sum` holds these rows alone. Along a row a Gaussian is a product: from
// pixel to pixel it changes by a factor, which changes by a constant factor.
const blend = (shapes, count, sum, width, top, bottom) => {
  for (let o = 0; o < count * SHAPE; o += SHAPE) {
    const first = Math.max(top, shapes[o]), last = Math.min(bottom - 1, shapes[o + 1]);
    if (first > last) continue;
    const cx = shapes[o + 2], cy = shapes[o + 3], xx = shapes[o + 4], xy = shapes[o + 5], yy = shapes[o + 6], det = shapes[o + 7];
    const opacity = shapes[o + 8], limit = shapes[o + 9], red = shapes[o + 10], green = shapes[o + 11], blue = shapes[o + 12], bend = exp(-xx), part = 1 / xx;
    for (let y = first; y <= last; y++) {
      const dy = y + 0.5 - cy, inside = xx * limit - det * dy * dy;
      if (!(inside > 0)) continue;
      const half = Math.sqrt(inside) * part, middle = cx - 0.5 - xy * dy * part;
      const from = Math.max(0, Math.ceil(middle - half)), to = Math.min(width - 1, Math.floor(middle + half));
      if (from > to) continue;
      const dx = from + 0.5 - cx;
      let value = opacity * exp(-0.5 * (xx * dx * dx + 2 * xy * dx * dy + yy * dy * dy)), factor = exp(-xx * (dx + 0.5) - xy * dy);
      for (let j = 3 * ((y - top) * width + from), end = j + 3 * (to - from); j <= end; j += 3) {
        const alpha = value < 0.99 ? value : 0.99, r = sum[j], g = sum[j + 1], b = sum[j + 2];
        sum[j] = r + alpha * (red - r);
        sum[j + 1] = g + alpha * (green - g);
        sum[j + 2] = b + alpha * (blue - b);
        value *= factor;
        factor *= bend;
      }
    }
  }
};

// With the processor alone: where a browser has no graphics card it plays one, on which this many blended layers take many times as long.
class Processor {
  constructor(context) {
    this.context = context;
    this.cost = this.visible = 0;
    this.picture = null;
    this.sum = this.shapes = new Float64Array(0);
  }

  setGaussians(texels, count) {
    this.texels = texels;
    this.count = count;
    this.shapes = new Float64Array(SHAPE * count);
  }

  begin(view, sorted) {
    this.started = performance.now();
    this.view = view;
    this.project(view, sorted);
    const [width, height] = view.size;
    if (this.picture?.width !== width || this.picture.height !== height) this.picture = this.context.createImageData(width, height);
    // Rows whose sums stay in a processor's cache; and a picture of many rows does not need much memory.
    this.band = Math.max(1, Math.min(height, Math.floor(40_000 / width)));
    if (this.sum.length < 3 * width * this.band) this.sum = new Float64Array(3 * width * this.band);
    this.top = 0;
    this.cost = performance.now() - this.started;
  }

  // As in the vertex shader.
  project({ size: [width, height], axes: [right, down, forward], eye, focal, middle, near }, sorted) {
    const t = this.texels, shapes = this.shapes;
    const lowX = -(middle[0] + 0.15 * width) / focal[0], highX = (1.15 * width - middle[0]) / focal[0];
    const lowY = -(middle[1] + 0.15 * height) / focal[1], highY = (1.15 * height - middle[1]) / focal[1];
    const [rx, ry, rz] = right, [vx, vy, vz] = down, [fx, fy, fz] = forward;
    let o = 0;
    for (let k = 0; k < this.count; k++) {
      const i = 16 * sorted[k], opacity = t[i + 3], x = t[i] - eye[0], y = t[i + 1] - eye[1], z = t[i + 2] - eye[2];
      const depth = fx * x + fy * y + fz * z;
      if (!(depth >= near) || opacity < 1 / 255) continue;
      const sx = (rx * x + ry * y + rz * z) / depth, sy = (vx * x + vy * y + vz * z) / depth, a = focal[0] / depth, b = focal[1] / depth;
      const mx = Math.max(lowX, Math.min(highX, sx)), my = Math.max(lowY, Math.min(highY, sy));
      const ax = a * (rx - mx * fx), ay = a * (ry - mx * fy), az = a * (rz - mx * fz), bx = b * (vx - my * fx), by = b * (vy - my * fy), bz = b * (vz - my * fz);
      const u0 = ax * t[i + 4] + ay * t[i + 5] + az * t[i + 6], u1 = ax * t[i + 7] + ay * t[i + 8] + az * t[i + 9], u2 = ax * t[i + 10] + ay * t[i + 11] + az * t[i + 12];
      const v0 = bx * t[i + 4] + by * t[i + 5] + bz * t[i + 6], v1 = bx * t[i + 7] + by * t[i + 8] + bz * t[i + 9], v2 = bx * t[i + 10] + by * t[i + 11] + bz * t[i + 12];
      const xx = u0 * u0 + u1 * u1 + u2 * u2, xy = u0 * v0 + u1 * v1 + u2 * v2, yy = v0 * v0 + v1 * v1 + v2 * v2;
      const m0 = u1 * v2 - u2 * v1, m1 = u2 * v0 - u0 * v2, m2 = u0 * v1 - u1 * v0;
      const det = m0 * m0 + m1 * m1 + m2 * m2 + BLUR * (xx + yy + BLUR), limit = 2 * Math.log(255 * opacity);
      const cx = focal[0] * sx + middle[0], cy = focal[1] * sy + middle[1], wide = Math.sqrt(limit * (xx + BLUR)), high = Math.sqrt(limit * (yy + BLUR));
      if (!(cx + wide > 0 && cx - wide < width && cy + high > 0 && cy - high < height && det < Infinity)) continue;
      shapes[o] = Math.max(0, Math.ceil(cy - high - 0.5));
      shapes[o + 1] = Math.min(height - 1, Math.floor(cy + high - 0.5));
      shapes[o + 2] = cx;
      shapes[o + 3] = cy;
      shapes[o + 4] = (yy + BLUR) / det;
      shapes[o + 5] = -xy / det;
      shapes[o + 6] = (xx + BLUR) / det;
      shapes[o + 7] = 1 / det;
      shapes[o + 8] = opacity;
      shapes[o + 9] = limit;
      shapes[o + 10] = t[i + 13];
      shapes[o + 11] = t[i + 14];
      shapes[o + 12] = t[i + 15];
      o += SHAPE;
    }
    this.visible = o / SHAPE;
  }

  step() {
    const began = performance.now(), { size: [width, height], background: [red, green, blue] } = this.view, { sum, top } = this;
    const bottom = Math.min(height, top + this.band), bytes = this.picture.data, length = 3 * width * (bottom - top);
    for (let j = 0; j < length; j += 3) {
      sum[j] = red;
      sum[j + 1] = green;
      sum[j + 2] = blue;
    }
    blend(this.shapes, this.visible, sum, width, top, bottom);
    for (let j = 0, k = 4 * width * top; j < length; j += 3, k += 4) {
      bytes[k] = 255 * sum[j];
      bytes[k + 1] = 255 * sum[j + 1];
      bytes[k + 2] = 255 * sum[j + 2];
      bytes[k + 3] = 255;
    }
    this.top = bottom;
    const done = bottom === height;
    if (done) {
      resize(this.context.canvas, this.view.size);
      this.context.putImageData(this.picture, 0, 0);
    }
    this.cost += performance.now() - began;
    return done;
  }

  busy() {
    return false;
  }

  finish() {}
}

// Whether there is a graphics card, and not a processor that plays one. Asked of a canvas of its own: one that has drawn by a card cannot do without again.
const hasCard = () => {
  const gl = document.createElement("canvas").getContext("webgl2", { failIfMajorPerformanceCaveat: true });
  if (!gl) return false;
  const name = gl.getParameter(gl.getExtension("WEBGL_debug_renderer_info")?.UNMASKED_RENDERER_WEBGL ?? gl.RENDERER);
  gl.getExtension("WEBGL_lose_context")?.loseContext();
  return !/swiftshader|llvmpipe|softpipe|software|basic render/i.test(name);
};

class Viewer {
  // `up` is the direction that stays up; colours are an array of three in 0..1. `by`, "card" or "processor", is what draws if that is not to be chosen here.
  constructor(canvas, { up = [0, 0, 1], background = [1, 1, 1], by = "" } = {}) {
    this.canvas = canvas;
    this.background = background;
    this.frames = this.count = 0;
    this.rows = this.depth = new Float32Array(0);
    this.sorted = [new Uint32Array(0), new Uint32Array(0)];
    this.seen = ""; // from where they were sorted
    // Pictures in motion have less resolution where full ones take too long: by the fourth root of 1/2 per step.
    this.coarser = this.quick = 0;
    this.budget = BUDGET;
    this.changed = -Infinity; // when something moved last
    this.watching = false;
    this.up = unit(up);
    // Azimuth 0 looks along the first axis that is not up.
    const side = Math.abs(this.up[0]) < 0.9 ? [1, 0, 0] : [0, 1, 0];
    this.front = unit(add(side, this.up, -dot(side, this.up)));
    this.home = { target: [0, 0, 0], azimuth: 0, elevation: 20 * Math.PI / 180, distance: 1.6, fov: 45 };
    this.orbit = { ...this.home };
    this.near = 0.01;
    this.camera = null;
    this.onmove = this.ondraw = null;
    const card = by ? by === "card" : hasCard();
    const gl = card ? canvas.getContext("webgl2", { antialias: false, alpha: false }) : null, context = gl ? null : canvas.getContext("2d", { alpha: false });
    if (!gl && !context) throw new Error("This browser does not offer a canvas to draw on.");
    this.painter = gl ? new Card(gl) : new Processor(context);
    this.setGaussians(this.rows);
    canvas.addEventListener("webglcontextlost", (e) => e.preventDefault());
    canvas.addEventListener("webglcontextrestored", () => {
      this.painter = new Card(gl);
      this.setGaussians(this.rows);
    });
    new ResizeObserver(() => this.redraw()).observe(canvas);
    this.listen();
  }

  // Rows of 14 channels. Shows them from where the last ones were shown.
  setGaussians(rows) {
    const n = Math.floor(rows.length / CHANNELS), height = Math.max(1, Math.ceil(n / TEXTURE_ROW));
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
    this.sorted = [0, 1].map(() => new Uint32Array(height * TEXTURE_ROW));
    this.seen = "";
    this.painter.setGaussians(texels, n);
    this.stir();
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

  // What was shown is not right any more.
  redraw() {
    this.pending ??= requestAnimationFrame(() => this.frame());
  }

  // And more of it is to be expected soon.
  stir() {
    this.changed = performance.now();
    this.redraw();
  }

  frame() {
    this.pending = undefined;
    if (this.watching) {
      this.redraw();
    } else if (performance.now() - this.changed < REST) {
      this.paint(2 ** (-this.coarser / 4));
      this.watching = true;
      this.govern();
      clearTimeout(this.resting);
      if (this.coarser) this.resting = setTimeout(() => this.redraw(), REST);
    } else {
      this.coarser = Math.max(0, this.coarser - 1); // perhaps it was slow by chance
      this.start(1);
      this.goOn();
    }
  }

  // The whole picture in full resolution, at once.
  draw() {
    cancelAnimationFrame(this.pending);
    this.pending = undefined;
    this.paint(1);
  }

  paint(scale) {
    this.start(scale);
    while (!this.painter.step());
    this.shown();
  }

  // A picture at rest lets other work come between its parts.
  goOn() {
    if (this.painter.step()) this.shown();
    else this.resting = setTimeout(() => this.goOn());
  }

  // Of pictures in motion: as much resolution as there is time for.
  govern() {
    if (this.painter.busy()) {
      setTimeout(() => this.govern(), 1);
      return;
    }
    this.watching = false;
    const { cost } = this.painter;
    this.quick = cost < 0.6 * this.budget ? this.quick + 1 : 0;
    if (cost > this.budget) {
      this.coarser = Math.min(6, this.coarser + Math.min(4, Math.ceil(2 * Math.log2(cost / this.budget))));
    } else if (this.quick > 3) {
      this.coarser = Math.max(0, this.coarser - 1);
      this.quick = 0;
    }
  }

  // The picture's size in pixels.
  size(scale = 1) {
    const ratio = scale * (window.devicePixelRatio || 1);
    return [this.canvas.clientWidth, this.canvas.clientHeight].map((v) => Math.max(1, Math.round(v * ratio)));
  }

  start(scale) {
    clearTimeout(this.resting);
    const size = this.size(scale), { right, down, forward, eye } = this.pose();
    const changed = this.sort(forward, eye), view = { size, axes: [right, down, forward], eye, near: this.near, background: this.background, ...this.lens(size) };
    this.painter.begin(view, this.sorted[1], changed);
  }

  shown() {
    this.frames += 1;
    this.canvas.dataset.frames = this.frames;
    this.ondraw?.(this);
  }

  // From far to near; of equals the last first. Bits of positive floats are ordered as they are: three passes of 11 bits.
  // False if they are sorted already.
  sort(forward, eye) {
    const n = this.count, { rows, depth } = this, from = String([forward, eye]);
    if (this.seen === from) return false;
    this.seen = from;
    const bits = new Uint32Array(depth.buffer), offset = dot(forward, eye);
    for (let i = 0; i < n; i++) {
      const z = forward[0] * rows[i * CHANNELS] + forward[1] * rows[i * CHANNELS + 1] + forward[2] * rows[i * CHANNELS + 2];
      depth[i] = Math.max(0, z - offset);
      this.sorted[0][i] = n - 1 - i;
    }
    for (let pass = 0; pass < 3; pass++) {
      const [from, to] = pass % 2 ? [this.sorted[1], this.sorted[0]] : this.sorted, shift = 11 * pass;
      const start = new Uint32Array(2049);
      for (let i = 0; i < n; i++) start[2048 - (bits[i] >>> shift & 2047)] += 1;
      for (let k = 1; k < 2049; k++) start[k] += start[k - 1];
      for (let i = n - 1; i >= 0; i--) to[--start[2048 - (bits[from[i]] >>> shift & 2047)]] = from[i];
    }
    return true;
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
    this.stir();
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
