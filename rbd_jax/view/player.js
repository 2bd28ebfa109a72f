"use strict";
(() => {

// ---------------------------------------------------------------- page and data

const $ = (id) => document.getElementById(id);
const head = JSON.parse($("head").textContent);
const [W, T, n] = head.shape;
const G = head.kind.length;
const SPEEDS = [0.1, 0.25, 0.5, 1, 2, 4];
const PLAY = "M4 2.2v11.6a.6.6 0 0 0 .9.5l9.2-5.8a.6.6 0 0 0 0-1L4.9 1.7a.6.6 0 0 0-.9.5z";
const PAUSE = "M3.5 2h3v12h-3zM9.5 2h3v12h-3z";

function fail(text) {
  $("message").textContent = text;
  $("message").hidden = false;
  throw new Error(text);
}

async function unpack() {
  if (!window.DecompressionStream) fail("This browser is too old to unpack the data: it lacks DecompressionStream.");
  const packed = Uint8Array.from(atob($("data").textContent.trim()), (c) => c.charCodeAt(0));
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate"));
  const buffer = await new Response(stream).arrayBuffer();
  const types = { float64: Float64Array, float32: Float32Array, int16: Int16Array };
  const data = {};
  for (const [name, { type, shape, offset }] of Object.entries(head.arrays))
    data[name] = new types[type](buffer, offset, shape.reduce((a, b) => a * b, 1));
  for (const a of [data.pos, data.quat, data.ghost_pos, data.ghost_quat].filter(Boolean))  // running sums; Int16Array wraps as the writer assumes
    for (let i = 0; i < a.length; i += T) for (let t = 1; t < T; t++) a[i + t] += a[i + t - 1];
  return data;
}

// ---------------------------------------------------------------- vectors, quaternions (w, x, y, z), column-major 4x4

const add = (a, b, s = 1) => [a[0] + s * b[0], a[1] + s * b[1], a[2] + s * b[2]];
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const scale = (a, s) => [a[0] * s, a[1] * s, a[2] * s];
const norm = (a) => Math.hypot(a[0], a[1], a[2]);
const unit = (a) => scale(a, 1 / (norm(a) || 1));

function rotate(q, v) {
  const u = [q[1], q[2], q[3]], t = scale(cross(u, v), 2);
  return add(add(v, t, q[0]), cross(u, t));
}
function multiply(p, q) {
  return [
    p[0] * q[0] - p[1] * q[1] - p[2] * q[2] - p[3] * q[3], p[0] * q[1] + p[1] * q[0] + p[2] * q[3] - p[3] * q[2],
    p[0] * q[2] - p[1] * q[3] + p[2] * q[0] + p[3] * q[1], p[0] * q[3] + p[1] * q[2] - p[2] * q[1] + p[3] * q[0]];
}
function slerp(a, b, s) {
  let c = a[0] * b[0] + a[1] * b[1] + a[2] * b[2] + a[3] * b[3];
  const sign = c < 0 ? -1 : 1;
  c = Math.min(1, Math.abs(c));
  const angle = Math.acos(c);
  const [x, y] = angle < 1e-3 ? [1 - s, s] : [Math.sin((1 - s) * angle) / Math.sin(angle), Math.sin(s * angle) / Math.sin(angle)];
  const q = [0, 1, 2, 3].map((i) => x * a[i] + sign * y * b[i]);
  const size = Math.hypot(...q) || 1;
  return q.map((v) => v / size);
}
function multiply4(a, b) {
  const out = new Float32Array(16);
  for (let c = 0; c < 4; c++) for (let r = 0; r < 4; r++)
    for (let k = 0; k < 4; k++) out[4 * c + r] += a[4 * k + r] * b[4 * c + k];
  return out;
}
function looking(eye, right, up, back) {
  return [right[0], up[0], back[0], 0, right[1], up[1], back[1], 0, right[2], up[2], back[2], 0,
    -dot(right, eye), -dot(up, eye), -dot(back, eye), 1];
}
function perspective(tanX, tanY, near, far) {
  return [1 / tanX, 0, 0, 0, 0, 1 / tanY, 0, 0, 0, 0, (far + near) / (near - far), -1, 0, 0, 2 * far * near / (near - far), 0];
}
const orthographic = (r) => [1 / r, 0, 0, 0, 0, 1 / r, 0, 0, 0, 0, -1 / r, 0, 0, 0, 0, 1];
const linear = (hex) => [1, 3, 5].map((k) => (parseInt(hex.slice(k, k + 2), 16) / 255) ** 2.2);

// ---------------------------------------------------------------- shaders

const VERTEX = `#version 300 es
layout(location = 0) in vec3 corner;
layout(location = 1) in vec3 facing;
layout(location = 2) in vec3 place;
layout(location = 3) in vec4 turn;
layout(location = 4) in vec3 size;
layout(location = 5) in vec3 tint;
uniform mat4 clip;
out vec3 unit, world, normal, colour, extent;
vec3 rotated(vec3 v) { return v + 2.0 * cross(turn.yzw, cross(turn.yzw, v) + turn.x * v); }
void main() {
  unit = corner;
  extent = size;
  colour = tint;
  normal = rotated(facing);
  world = place + rotated(corner * size);
  gl_Position = clip * vec4(world, 1.0);
}`;

const DEPTH = `#version 300 es
precision mediump float;
void main() {}`;

const LIGHTING = `#version 300 es
precision highp float;
precision highp sampler2DShadow;
uniform sampler2DShadow shadows;
uniform mat4 lightClip;
uniform vec3 light, eye;
uniform float texel;  // of the shadow map [m]
out vec4 outColour;
float sun(vec3 p, vec3 n) {
  vec3 c = (lightClip * vec4(p + n * texel * 2.0, 1.0)).xyz * 0.5 + 0.5;
  if (any(lessThan(c.xy, vec2(0.0))) || any(greaterThan(c.xy, vec2(1.0)))) return 1.0;
  c.z = min(c.z, 1.0);  // a shadow falls on ground that lies behind all that casts one
  vec2 step = 1.4 / vec2(textureSize(shadows, 0));
  float total = 0.0;
  for (int i = -1; i <= 1; i++) for (int j = -1; j <= 1; j++)
    total += texture(shadows, vec3(c.xy + vec2(i, j) * step, c.z - 0.0006));
  return total / 9.0;
}
vec3 lit(vec3 albedo, vec3 p, vec3 n, float gloss) {
  float facing = max(dot(n, light), 0.0);
  float shine = facing > 0.0 ? sun(p, n) : 0.0;
  float ambient = (0.5 + 0.5 * n.z) * 0.2 + 0.24;
  vec3 h = normalize(light + normalize(eye - p));
  return albedo * (0.62 * facing * shine + ambient) + gloss * shine * pow(max(dot(n, h), 0.0), 40.0);
}
vec3 display(vec3 c) { return pow(clamp(c, 0.0, 1.0), vec3(1.0 / 2.2)); }
`;

const SOLID = LIGHTING + `
uniform bool sphere;
in vec3 unit, world, normal, colour, extent;
void main() {
  vec3 albedo = colour;
  if (sphere) {
    vec3 u = normalize(unit);
    vec3 side = clamp(2.0 * u / max(fwidth(u), 1e-5), -1.0, 1.0);
    albedo = mix(albedo, vec3(1.0), 0.62 * (0.5 + 0.5 * side.x * side.y * side.z));
  } else {
    vec3 d = (1.0 - abs(unit)) * extent;
    float gap = max(min(d.x, d.y), min(max(d.x, d.y), d.z));
    float pixel = max(fwidth(gap), 1e-7);
    float least = min(extent.x, min(extent.y, extent.z));
    float line = max(0.03 * least, min(pixel, 0.1 * least));
    albedo *= mix(0.42, 1.0, clamp(0.5 + (gap - line) / pixel, 0.0, 1.0));
  }
  outColour = vec4(display(lit(albedo, world, normalize(normal), 0.10)), 1.0);
}`;

const PLANE = LIGHTING + `
uniform vec3 pale, dark, middle;
uniform float square, inner, outer;
uniform bool behind;
in vec3 unit, world, normal, colour, extent;
void main() {
  vec2 s = unit.xy * extent.xy / square;
  vec2 w = max(fwidth(s), 1e-4);
  vec2 stripe = 2.0 * (abs(fract((s - 0.5 * w) * 0.5) - 0.5) - abs(fract((s + 0.5 * w) * 0.5) - 0.5)) / w;
  float shade = 0.5 - 0.5 * stripe.x * stripe.y;
  vec3 n = normalize(normal);
  float alpha = 1.0 - smoothstep(inner, outer, length(world - middle));
  if (behind) alpha *= 0.12;
  if (alpha < 0.004) discard;
  outColour = vec4(display(lit(mix(pale, dark, shade), world, n, 0.0)), 1.0) * alpha;
}`;

// ---------------------------------------------------------------- WebGL

const canvas = $("scene");
const gl = canvas.getContext("webgl2", { antialias: true, alpha: true, premultipliedAlpha: true });

function program(vertex, fragment) {
  const p = gl.createProgram();
  for (const [type, text] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
    const s = gl.createShader(type);
    gl.shaderSource(s, text);
    gl.compileShader(s);
    if (!gl.getShaderParameter(s, gl.COMPILE_STATUS)) fail("The graphics driver refused a shader: " + gl.getShaderInfoLog(s));
    gl.attachShader(p, s);
  }
  gl.linkProgram(p);
  if (!gl.getProgramParameter(p, gl.LINK_STATUS)) fail("The graphics driver refused a shader: " + gl.getProgramInfoLog(p));
  const at = {};
  for (let i = 0; i < gl.getProgramParameter(p, gl.ACTIVE_UNIFORMS); i++) {
    const { name } = gl.getActiveUniform(p, i);
    at[name] = gl.getUniformLocation(p, name);
  }
  return { p, at };
}

const STRIDE = 13;  // floats an instance: place 3, turn 4, size 3, tint 3
function mesh(vertices, triangles, capacity) {
  const vao = gl.createVertexArray(), instances = gl.createBuffer();
  gl.bindVertexArray(vao);
  gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
  gl.bufferData(gl.ARRAY_BUFFER, new Float32Array(vertices), gl.STATIC_DRAW);
  for (const i of [0, 1]) {
    gl.enableVertexAttribArray(i);
    gl.vertexAttribPointer(i, 3, gl.FLOAT, false, 24, 12 * i);
  }
  gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
  gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, new Uint16Array(triangles), gl.STATIC_DRAW);
  gl.bindBuffer(gl.ARRAY_BUFFER, instances);
  gl.bufferData(gl.ARRAY_BUFFER, 4 * STRIDE * Math.max(capacity, 1), gl.DYNAMIC_DRAW);
  [[2, 3, 0], [3, 4, 3], [4, 3, 7], [5, 3, 10]].forEach(([i, width, offset]) => {
    gl.enableVertexAttribArray(i);
    gl.vertexAttribPointer(i, width, gl.FLOAT, false, 4 * STRIDE, 4 * offset);
    gl.vertexAttribDivisor(i, 1);
  });
  gl.bindVertexArray(null);
  return { vao, instances, length: triangles.length, values: new Float32Array(STRIDE * Math.max(capacity, 1)), count: 0 };
}
function sphereMesh(rings, capacity) {
  const v = [], f = [], around = 2 * rings;
  for (let i = 0; i <= rings; i++) for (let j = 0; j <= around; j++) {
    const a = Math.PI * i / rings, b = 2 * Math.PI * j / around;
    const p = [Math.sin(a) * Math.cos(b), Math.sin(a) * Math.sin(b), Math.cos(a)];
    v.push(...p, ...p);
  }
  for (let i = 0; i < rings; i++) for (let j = 0; j < around; j++) {
    const k = i * (around + 1) + j;
    f.push(k, k + around + 1, k + 1, k + 1, k + around + 1, k + around + 2);
  }
  return mesh(v, f, capacity);
}
function boxMesh(capacity) {
  const v = [], f = [];
  for (let axis = 0; axis < 3; axis++) for (const s of [1, -1]) {
    const first = v.length / 6;
    for (const [a, b] of [[-1, -1], [1, -1], [1, 1], [-1, 1]]) {
      const p = [0, 0, 0], facing = [0, 0, 0];
      p[axis] = facing[axis] = s;
      p[(axis + 1) % 3] = a * s;
      p[(axis + 2) % 3] = b;
      v.push(...p, ...facing);
    }
    f.push(first, first + 1, first + 2, first, first + 2, first + 3);
  }
  return mesh(v, f, capacity);
}
const planeMesh = () => mesh([-1, -1, 0, 0, 0, 1, 1, -1, 0, 0, 0, 1, 1, 1, 0, 0, 0, 1, -1, 1, 0, 0, 0, 1], [0, 1, 2, 0, 2, 3], 1);
function put(m, place, turn, size, tint) {
  m.values.set([...place, ...turn, ...size, ...tint], STRIDE * m.count++);
}
function drawMesh(m) {
  if (!m.count) return;
  gl.bindVertexArray(m.vao);
  gl.drawElementsInstanced(gl.TRIANGLES, m.length, gl.UNSIGNED_SHORT, 0, m.count);
}
function upload(m) {
  gl.bindBuffer(gl.ARRAY_BUFFER, m.instances);
  gl.bufferSubData(gl.ARRAY_BUFFER, 0, m.values, 0, STRIDE * m.count);
}

// ---------------------------------------------------------------- state

const options = new URLSearchParams(location.hash.slice(1));  // #t=1&play=0&speed=0.5&layout=grid&world=2&count=4&follow=0
const still = window.matchMedia("(prefers-reduced-motion: reduce)").matches;
const counts = [...new Set([4, 9, 16, 25, 36, 64].filter((k) => k < W).concat(Math.min(W, 64)))].filter((k) => k > 1);
const number = (key, fallback, lo, hi) => {
  const v = options.has(key) ? Number(options.get(key)) : NaN;
  return Number.isFinite(v) ? Math.min(Math.max(v, lo), hi) : fallback;
};
const state = {
  t: 0, playing: false, speed: number("speed", 1, 0.01, 100), loop: true, layout: "one",
  trails: options.get("trails") === "1", contacts: options.get("contacts") !== "0", ghost: options.get("ghost") !== "0",
  world: Math.round(number("world", 0, 0, W - 1)), count: counts.find((k) => k >= 9) || counts[counts.length - 1] || 1,
  follow: Math.round(number("follow", head.follow, -1, n - 1)),
  azimuth: head.view[1] * Math.PI / 180, elevation: head.view[2] * Math.PI / 180, distance: 1, target: [0, 0, 0],
};
const one = { lo: head.lo, hi: head.hi };
const radiusOf = (b) => norm(add(b.hi, b.lo, -1)) / 2;
const centreOf = (b) => scale(add(b.lo, b.hi), 0.5);
const colours = head.colour.map(linear), palette = head.palette.map(linear);
const [pale, dark] = head.ground.map(linear);
const light = unit(head.light);
let data, start, end, solids, plane, shaders, shadow, dirty = true, last = 0, lag = 0.016, sharpness = 1;

/** Worlds on screen, each with its offset. */
function shown() {
  if (state.layout === "one") return [{ w: state.world, at: [0, 0, 0] }];
  const k = state.count;
  let first = Math.min(Math.max(state.world - k + 1, 0), W - k);
  if (state.world < k) first = 0;
  const list = [...Array(k).keys()].map((i) => first + i);
  if (state.layout === "overlay") return list.map((w) => ({ w, at: [0, 0, 0] }));
  const size = add(one.hi, one.lo, -1), gap = 0.3 * Math.max(...size);
  const cols = Math.ceil(Math.sqrt(k)), rows = Math.ceil(k / cols);
  return list.map((w, i) => ({ w, at: [
    (i % cols - (cols - 1) / 2) * (size[0] + gap), ((rows - 1) / 2 - Math.floor(i / cols)) * (size[1] + gap), 0] }));
}
function bounds(list) {
  const lo = [...one.lo], hi = [...one.hi];
  for (const { at } of list) for (let k = 0; k < 3; k++) {
    lo[k] = Math.min(lo[k], one.lo[k] + at[k]);
    hi[k] = Math.max(hi[k], one.hi[k] + at[k]);
  }
  return { lo, hi };
}

// ---------------------------------------------------------------- poses

/** Sample below time t and the share of the way to the next. */
function sampleAt(t) {
  if (T === 1 || t <= data.time[0]) return [0, 0];
  if (t >= data.time[T - 1]) return [T - 2, 1];
  let lo = 0, hi = T - 1;
  while (hi - lo > 1) {
    const mid = (lo + hi) >> 1;
    if (data.time[mid] <= t) lo = mid; else hi = mid;
  }
  return [lo, (t - data.time[lo]) / (data.time[hi] - data.time[lo])];
}
function bodyPlace(w, b, i, s, run = "") {
  const j = Math.min(i + 1, T - 1), row = w * n + b, p = [0, 0, 0], pos = data[run + "pos"];
  for (let k = 0; k < 3; k++) {
    const o = (3 * row + k) * T;
    const q = pos[o + i] + s * (pos[o + j] - pos[o + i]);
    p[k] = data[run + "pos_mid"][3 * row + k] + data[run + "pos_step"][3 * row + k] * q;
  }
  return p;
}
function bodyPose(w, b, i, s, run = "") {
  const j = Math.min(i + 1, T - 1), row = w * n + b, p = bodyPlace(w, b, i, s, run);
  const sample = (t) => [0, 1, 2, 3].map((k) => data[run + "quat"][(4 * row + k) * T + t]);
  const a = sample(i), b4 = sample(j), la = Math.hypot(...a) || 1, lb = Math.hypot(...b4) || 1;
  return [p, slerp(a.map((v) => v / la), b4.map((v) => v / lb), s)];
}
function ofGeom(name, width, w, g) {
  const a = data[name], base = (head.arrays[name].shape[0] > 1 ? w * G + g : g) * width;
  return Array.from(a.subarray(base, base + width));
}
function geomPose(bodies, w, g) {
  const p = ofGeom("geom_pos", 3, w, g), q = ofGeom("geom_quat", 4, w, g), b = head.body[g];
  if (b < 0) return [p, q];
  return [add(bodies[b][0], rotate(bodies[b][1], p)), multiply(bodies[b][1], q)];
}

// ---------------------------------------------------------------- drawing

function camera() {
  const a = state.azimuth, e = state.elevation;
  const back = [Math.cos(e) * Math.cos(a), Math.cos(e) * Math.sin(a), Math.sin(e)];
  const right = [-Math.sin(a), Math.cos(a), 0], up = cross(back, right);
  const aspect = canvas.width / canvas.height, half = Math.tan(head.view[0] * Math.PI / 360);
  const tanX = aspect > 1 ? half * aspect : half, tanY = tanX / aspect;
  const eye = add(state.target, back, state.distance);
  return { back, right, up, tanX, tanY, eye };
}
/** Nearest distance from which the box of what is shown fills the view above the panel. */
function fit() {
  const b = bounds(shown()), c = camera();
  const corners = [0, 1, 2, 3, 4, 5, 6, 7].map((i) => [0, 1, 2].map((k) => (i >> k & 1 ? b.hi : b.lo)[k]));
  const free = freeShare();
  const roomX = 0.86 * c.tanX, roomY = 0.86 * free * c.tanY;
  let target = centreOf(b), distance = 0;
  for (let pass = 0; pass < 4; pass++) {
    const seen = corners.map((p) => { const d = add(p, target, -1); return [dot(d, c.right), dot(d, c.up), dot(d, c.back)]; });
    distance = Math.max(...seen.map(([x, y, z]) => Math.max(Math.abs(x) / roomX, Math.abs(y) / roomY) + z));
    for (const [k, axis] of [[0, c.right], [1, c.up]]) {
      const angle = seen.map((p) => p[k] / (distance - p[2]));
      target = add(target, axis, 0.5 * (Math.max(...angle) + Math.min(...angle)) * distance);
    }
  }
  state.distance = distance;
  if (state.follow >= 0) state.distance = Math.min(distance, 25 * followRadius());
  state.target = raised(target);
  dirty = true;
}
/** Share of the window's height that the panel leaves free. */
const freeShare = () => 1 - Math.min(0.6, $("panel").offsetHeight / window.innerHeight);
/** What to look at for a point to appear in the middle of the free part. */
function raised(point) {
  const c = camera();
  return add(point, c.up, -(1 - freeShare()) * c.tanY * state.distance);
}
function followPoint() {
  const here = shown().find((s) => s.w === state.world) || { at: [0, 0, 0] };
  return add(bodyPose(state.world, state.follow, ...sampleAt(state.t))[0], here.at);
}
function followRadius() {
  const sizes = head.body.map((b, g) => b === state.follow ? norm(ofGeom("geom_size", 3, state.world, g)) : 0);
  return Math.max(...sizes) || radiusOf(one) / 20;
}

function resize() {
  const ratio = Math.min(window.devicePixelRatio || 1, 2);
  for (const c of [canvas, $("overlay"), $("energy")]) {
    const share = c === canvas && state.playing ? ratio * sharpness : ratio;
    const w = Math.max(1, Math.round(c.clientWidth * share)), h = Math.max(1, Math.round(c.clientHeight * share));
    if (c.width !== w || c.height !== h) { c.width = w; c.height = h; }
  }
  return ratio;
}

/** Fills the instances of all solids; returns the planes to draw and where the solids of each world are. */
function collect(list, reach, all) {
  const planes = [], places = list.map(() => []), [i, s] = sampleAt(state.t);
  for (const m of Object.values(solids)) m.count = 0;
  list.forEach(({ w, at }, index) => {
    const bodies = [...Array(n).keys()].map((b) => bodyPose(w, b, i, s));
    for (let g = 0; g < G; g++) {
      if (state.layout === "overlay" && head.body[g] < 0 && index) continue;
      const [p, turn] = geomPose(bodies, w, g);
      const place = add(p, at), moving = head.body[g] >= 0 && head.body[g] < head.dynamic;
      const tint = state.layout === "overlay" && moving ? palette[w % palette.length] : colours[g];
      if (head.kind[g] !== "plane") {
        put(solids[head.kind[g]], place, turn, ofGeom("geom_size", 3, w, g), tint);
        places[index].push(place);
        continue;
      }
      const normal = rotate(turn, [0, 0, 1]), level = normal[2] > 0.9999;
      if (level && planes.some((q) => q.level && Math.abs(q.place[2] - place[2]) < 1e-6 * reach)) continue;
      const about = level ? centreOf(all) : add(centreOf(one), at);
      const middle = add(about, normal, -dot(add(about, place, -1), normal));
      const size = level ? reach : radiusOf(one);
      planes.push({ place: level ? p : place, turn, normal, middle, level, inner: (level ? 2.2 : 0.75) * size, outer: (level ? 7 : 1.1) * size });
    }
  });
  return { planes, places };
}

function draw() {
  const ratio = resize(), list = shown(), all = bounds(list), reach = radiusOf(all);
  if (state.follow >= 0) state.target = raised(followPoint());
  const c = camera(), { planes, places } = collect(list, reach, all);
  for (const m of Object.values(solids)) upload(m);

  // the light sees what is shown, or what is near the followed body
  const focus = state.follow >= 0 && norm(add(state.target, centreOf(all), -1)) > reach ? state.target : centreOf(all);
  const span = 1.05 * reach;
  const side = unit(cross([0, 0, 1], light)), over = cross(light, side);
  const lightClip = multiply4(orthographic(span), looking(focus, side, over, light));
  gl.bindFramebuffer(gl.FRAMEBUFFER, shadow.frame);
  gl.viewport(0, 0, shadow.size, shadow.size);
  gl.clear(gl.DEPTH_BUFFER_BIT);
  gl.enable(gl.POLYGON_OFFSET_FILL);
  gl.polygonOffset(1.5, 3);
  gl.useProgram(shaders.depth.p);
  gl.uniformMatrix4fv(shaders.depth.at.clip, false, lightClip);
  for (const m of Object.values(solids)) drawMesh(m);
  gl.disable(gl.POLYGON_OFFSET_FILL);

  gl.bindFramebuffer(gl.FRAMEBUFFER, null);
  gl.viewport(0, 0, canvas.width, canvas.height);
  gl.clearColor(0, 0, 0, 0);
  gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
  const far = state.distance + 9 * reach + norm(add(state.target, centreOf(all), -1)), near = Math.max(state.distance / 200, far / 20000);
  const view = multiply4(perspective(c.tanX, c.tanY, near, far), looking(c.eye, c.right, c.up, c.back));
  const prepare = ({ p, at }) => {
    gl.useProgram(p);
    gl.uniformMatrix4fv(at.clip, false, view);
    gl.uniformMatrix4fv(at.lightClip, false, lightClip);
    gl.uniform3fv(at.light, light);
    gl.uniform3fv(at.eye, c.eye);
    gl.uniform1f(at.texel, 2 * span / shadow.size);
    gl.uniform1i(at.shadows, 0);
  };
  prepare(shaders.solid);
  for (const [kind, m] of Object.entries(solids)) {
    gl.uniform1i(shaders.solid.at.sphere, kind === "sphere");
    drawMesh(m);
  }
  gl.enable(gl.BLEND);
  gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
  prepare(shaders.plane);
  const at = shaders.plane.at;
  gl.uniform3fv(at.pale, pale);
  gl.uniform3fv(at.dark, dark);
  gl.uniform1f(at.square, head.square);
  for (const p of planes) p.behind = dot(add(c.eye, p.place, -1), p.normal) < 0;
  planes.sort((a, b) => a.behind - b.behind || b.level - a.level);
  for (const p of planes) {
    plane.count = 0;
    const half = p.outer + norm(add(p.middle, p.place, -1));
    put(plane, p.place, p.turn, [half, half, 1], pale);
    upload(plane);
    gl.depthMask(!p.behind);
    gl.uniform1i(at.behind, p.behind);
    gl.uniform3fv(at.middle, p.middle);
    gl.uniform1f(at.inner, p.inner);
    gl.uniform1f(at.outer, p.outer);
    drawMesh(plane);
  }
  gl.depthMask(true);
  gl.disable(gl.BLEND);
  drawOverlay(ratio, list, places, c, view);
  drawEnergy(ratio, list);
  showTime();
}

const TRAIL = 240;  // points of a trail
const EDGES = [0, 1, 2].flatMap((axis) => [0, 1, 2, 3].map((k) => [-1, 1].map((end) => {
  const p = [0, 0, 0];
  p[axis] = end;
  p[(axis + 1) % 3] = k & 1 ? 1 : -1;
  p[(axis + 2) % 3] = k & 2 ? 1 : -1;
  return p;
})));

/** Trails, forces of contact and the other run, over the picture: nothing hides them. */
function drawMarks(x, o, list, c, seen) {
  const line = (points) => {
    let pen = false;
    x.beginPath();
    for (const p of points) {
      if (p) x[pen ? "lineTo" : "moveTo"](p[0], p[1]);
      pen = !!p;
    }
    x.stroke();
  };
  const [i, s] = sampleAt(state.t), now = s > 0.5 ? Math.min(i + 1, T - 1) : i;
  x.lineCap = x.lineJoin = "round";
  if (state.trails) for (const { w, at } of list) for (let b = 0; b < head.dynamic; b++) {
    const stride = Math.max(1, Math.ceil(i / TRAIL)), g = head.body.indexOf(b);
    const path = [];
    for (let t = 0; t <= i; t += stride) path.push(seen(add(bodyPlace(w, b, t, 0), at)));
    path.push(seen(add(bodyPlace(w, b, i, s), at)));
    x.strokeStyle = state.layout === "overlay" ? head.palette[w % head.palette.length] : g < 0 ? "#5b6775" : head.colour[g];
    x.lineWidth = 1.5;
    x.globalAlpha = 0.75;
    line(path);
  }
  x.globalAlpha = 1;
  if (state.ghost && data.ghost_pos) {
    x.strokeStyle = "#1d2733";
    x.lineWidth = 1.2;
    x.setLineDash([4, 3]);
    for (const { w, at } of list) {
      const bodies = [...Array(n).keys()].map((b) => bodyPose(w, b, i, s, "ghost_"));
      for (let g = 0; g < G; g++) {
        if (head.body[g] < 0 || head.kind[g] === "plane") continue;
        const [p, turn] = geomPose(bodies, w, g), size = ofGeom("geom_size", 3, w, g), place = add(p, at);
        if (head.kind[g] === "box") {
          for (const edge of EDGES) line(edge.map((e) => seen(add(place, rotate(turn, e.map((v, k) => v * size[k]))))));
          continue;
        }
        const m = seen(place);
        if (!m) continue;
        x.beginPath();
        x.arc(m[0], m[1], size[0] / m[2] / c.tanY * o.clientHeight / 2, 0, 2 * Math.PI);
        x.stroke();
      }
    }
    x.setLineDash([]);
  }
  if (state.contacts && data.contact_first) {
    const q = data.contact_scale, reach = 0.22 * radiusOf(one);
    for (const { w, at } of list)
      for (let k = data.contact_first[w * T + now]; k < data.contact_first[w * T + now + 1]; k++) {
        const place = add([0, 1, 2].map((d) => q[d] + q[3 + d] * data.contact_point[3 * k + d]), at);
        const force = [0, 1, 2].map((d) => q[6] * data.contact_force[3 * k + d]), size = norm(force);
        const from = seen(place), to = seen(add(place, force, reach * Math.min(size / q[7], 3) / (size || 1)));
        if (!from || !to) continue;
        x.strokeStyle = x.fillStyle = "#b3261e";
        x.lineWidth = 2;
        line([from, to]);
        x.beginPath();
        x.arc(from[0], from[1], 2.5, 0, 2 * Math.PI);
        x.fill();
      }
  }
}

function drawOverlay(ratio, list, places, c, view) {
  const o = $("overlay"), x = o.getContext("2d");
  x.setTransform(ratio, 0, 0, ratio, 0, 0);
  x.clearRect(0, 0, o.width, o.height);
  x.font = "12px system-ui, sans-serif";
  x.textAlign = "center";
  x.textBaseline = "middle";
  const seen = (p) => {  // [x, y, distance from the eye] of a point; null behind it
    const k = [0, 1, 3].map((r) => view[r] * p[0] + view[4 + r] * p[1] + view[8 + r] * p[2] + view[12 + r]);
    return k[2] > 0 ? [(k[0] / k[2] + 1) / 2 * o.clientWidth, (1 - k[1] / k[2]) / 2 * o.clientHeight, k[2]] : null;
  };
  drawMarks(x, o, list, c, seen);
  if (state.layout === "grid") list.forEach(({ w, at }, index) => {
    // below what the world shows now
    const lo = add(add(one.lo, at), add(one.hi, one.lo, -1), -0.2), hi = add(add(one.hi, at), add(one.hi, one.lo, -1), 0.2);
    let left = Infinity, right = -Infinity, sy = -Infinity;
    for (const p of places[index].filter((q) => q.every((v, k) => v >= lo[k] && v <= hi[k]))) {
      const m = seen(p);
      if (!m) continue;
      left = Math.min(left, m[0]);
      right = Math.max(right, m[0]);
      sy = Math.max(sy, m[1]);
    }
    if (left > right) return;
    const sx = (left + right) / 2;
    sy += 14 + 0.1 * radiusOf(one) / state.distance / c.tanY * o.clientHeight;
    const text = head.worlds[w], wide = x.measureText(text).width + 14;
    x.fillStyle = w === state.world ? "#0072b2" : "rgba(255,255,255,.8)";
    x.beginPath();
    x.roundRect(sx - wide / 2, sy - 10, wide, 20, 6);
    x.fill();
    x.fillStyle = w === state.world ? "#fff" : "#5b6775";
    x.fillText(text, sx, sy + 0.5);
  });
  const cx = o.clientWidth - 44, cy = 100, arm = 24;
  const axes = [["x", "#d55e00"], ["y", "#009e73"], ["z", "#0072b2"]].map(([name, colour], k) =>
    ({ name, colour, x: c.right[k], y: -c.up[k], z: c.back[k] })).sort((a, b) => a.z - b.z);
  for (const a of axes) {
    x.strokeStyle = x.fillStyle = a.colour;
    x.lineWidth = 2;
    x.beginPath();
    x.moveTo(cx, cy);
    x.lineTo(cx + arm * a.x, cy + arm * a.y);
    x.stroke();
    x.fillText(a.name, cx + (arm + 9) * a.x, cy + (arm + 9) * a.y);
  }
}

const MARGIN = 66;  // of the energy strip, for its labels [px]
const nice = (v) => Math.abs(v) >= 1e5 || (v && Math.abs(v) < 1e-3) ? v.toExponential(2) : String(Number(v.toPrecision(4)));
function drawEnergy(ratio, list) {
  const e = $("energy");
  if (e.hidden) return;
  const x = e.getContext("2d"), width = e.clientWidth, height = e.clientHeight;
  const at = (w, t) => data.energy[w * T + t];
  let lo = Infinity, hi = -Infinity;
  for (const { w } of list) for (let t = 0; t < T; t++) { lo = Math.min(lo, at(w, t)); hi = Math.max(hi, at(w, t)); }
  if (hi - lo < 1e-9 * Math.max(Math.abs(hi), Math.abs(lo), 1e-30)) { const m = Math.abs(hi) * 0.01 || 1; lo -= m; hi += m; }
  const px = (t) => MARGIN + (t - start) / (end - start || 1) * (width - MARGIN - 6), py = (v) => height - 5 - (v - lo) / (hi - lo) * (height - 10);
  x.setTransform(ratio, 0, 0, ratio, 0, 0);
  x.clearRect(0, 0, width, height);
  const every = Math.max(1, Math.floor(T / (2 * width)));
  const order = [...list].sort((a, b) => (a.w === state.world) - (b.w === state.world));
  for (const { w } of order) {
    const mine = w === state.world;
    x.strokeStyle = state.layout === "overlay" ? head.palette[w % head.palette.length] : mine ? "#0072b2" : "#9fb0c2";
    x.globalAlpha = mine ? 1 : 0.5;
    x.lineWidth = mine ? 1.8 : 1;
    x.beginPath();
    for (let t = 0; t < T; t += every) x.lineTo(px(data.time[t]), py(at(w, t)));
    x.stroke();
  }
  x.globalAlpha = 1;
  const [i, s] = sampleAt(state.t), now = at(state.world, i) + s * (at(state.world, Math.min(i + 1, T - 1)) - at(state.world, i));
  x.strokeStyle = "#1d2733";
  x.lineWidth = 1;
  x.beginPath();
  x.moveTo(px(state.t), 0);
  x.lineTo(px(state.t), height);
  x.stroke();
  x.fillStyle = "#0072b2";
  x.beginPath();
  x.arc(px(state.t), py(now), 3.5, 0, 7);
  x.fill();
  x.font = "11.5px system-ui, sans-serif";
  x.textBaseline = "top";
  const label = (text, align, at, y) => {
    x.textAlign = align;
    x.lineWidth = 4;
    x.strokeStyle = "rgba(255,255,255,.9)";
    x.strokeText(text, at, y);
    x.fillStyle = "#5b6775";
    x.fillText(text, at, y);
  };
  label(`energy ${nice(now)} J`, "right", width - 4, 1);
  label(`${nice(hi)} J`, "right", MARGIN - 8, 1);
  label(`${nice(lo)} J`, "right", MARGIN - 8, height - 12);
}

const digits = () => end - start < 1 ? 3 : 2;
let clock = "";
function showTime() {
  const text = `<b>${state.t.toFixed(digits())}</b> <span>/ ${end.toFixed(digits())} s</span>`;
  if (text !== clock) $("clock").innerHTML = clock = text;
  if (document.activeElement !== $("scrub") || state.playing) $("scrub").value = state.t;
}

// ---------------------------------------------------------------- controls

function play(on) {
  if (T < 2) on = false;
  if (on && state.t >= end) state.t = start;
  state.playing = on;
  $("icon").setAttribute("d", on ? PAUSE : PLAY);
  $("play").setAttribute("aria-label", on ? "Pause" : "Play");
  dirty = true;
}
function seek(t) {
  state.t = Math.min(Math.max(t, start), end);
  $("scrub").value = state.t;
  dirty = true;
}
function stepFrames(count) {
  play(false);
  const [i, s] = sampleAt(state.t);
  const here = s > 1 - 1e-9 ? i + 1 : count < 0 && s > 1e-9 ? i + 1 : i;
  seek(data.time[Math.min(Math.max(here + count, 0), T - 1)]);
}
function setSpeed(v) {
  state.speed = v;
  if (![...$("speed").options].some((o) => Number(o.value) === v)) $("speed").add(new Option(`${v}×`, v));
  $("speed").value = v;
}
function setLayout(name) {
  if (W < 2) name = "one";
  const change = state.layout !== name;
  state.layout = name;
  for (const b of document.querySelectorAll("[data-layout]")) {
    b.classList.toggle("on", b.dataset.layout === name);
    b.setAttribute("aria-pressed", b.dataset.layout === name);
  }
  $("count-label").hidden = name === "one" || counts.length < 2;
  legend();
  if (change) fit();
  dirty = true;
}
function setWorld(w) {
  state.world = (w + W) % W;
  $("pick").value = state.world;
  legend();
  dirty = true;
}
function legend() {
  $("legend").replaceChildren();
  if (state.layout !== "overlay") return;
  const list = shown();
  for (const { w } of list.slice(0, head.palette.length)) {
    const item = document.createElement("li"), mark = document.createElement("i");
    mark.style.background = head.palette[w % head.palette.length];
    item.append(mark, head.worlds[w]);
    $("legend").append(item);
  }
  if (list.length > head.palette.length) {
    const item = document.createElement("li");
    item.textContent = `and ${list.length - head.palette.length} more`;
    $("legend").append(item);
  }
}

function wire() {
  const plural = (k, word) => `${k} ${word}${k === 1 ? "" : word.endsWith("y") ? "" : "s"}`;
  $("title").textContent = head.title;
  $("facts").textContent = [n === 1 ? "1 body" : `${n} bodies`, ...(W > 1 ? [plural(W, "world")] : []),
    T > 1 ? `${nice(end - start)} s` : "one instant", ...(head.kind.includes("plane") ? [`squares ${nice(head.square)} m`] : [])].join(" · ");
  for (const v of SPEEDS) $("speed").add(new Option(`${v}×`, v));
  setSpeed(state.speed);
  head.worlds.forEach((name, w) => $("pick").add(new Option(name, w)));
  counts.forEach((k) => $("count").add(new Option(k === W ? `all ${k}` : k, k)));
  $("count").value = state.count;
  $("follow").add(new Option("nothing", -1));
  head.names.forEach((name, b) => $("follow").add(new Option(name, b)));
  $("follow").value = state.follow;
  $("layout").hidden = $("world").hidden = W < 2;
  $("follow-label").hidden = n < 1;
  $("energy").hidden = !data.energy || T < 2;
  $("time").hidden = T < 2;
  $("scrub").min = start;
  $("scrub").max = end;
  $("panel").hidden = T < 2 && W < 2 && n < 1;

  $("play").onclick = () => play(!state.playing);
  $("scrub").oninput = () => seek(Number($("scrub").value));
  $("speed").onchange = () => setSpeed(Number($("speed").value));
  $("contacts-label").hidden = !data.contact_first;
  $("ghost-label").hidden = !data.ghost_pos;
  $("ghost-name").textContent = head.ghost;
  $("trails-label").hidden = T < 2 || head.dynamic < 1;
  for (const name of ["trails", "contacts", "ghost"]) {
    $(name).checked = state[name];
    $(name).onchange = () => { state[name] = $(name).checked; dirty = true; };
  }
  $("loop").onchange = () => { state.loop = $("loop").checked; };
  $("count").onchange = () => { state.count = Number($("count").value); legend(); fit(); };
  $("pick").onchange = () => setWorld(Number($("pick").value));
  $("previous").onclick = () => setWorld(state.world - 1);
  $("next").onclick = () => setWorld(state.world + 1);
  $("follow").onchange = () => { state.follow = Number($("follow").value); fit(); };
  $("fit").onclick = fit;
  $("help").onclick = () => { $("keys").hidden = !$("keys").hidden; $("help").setAttribute("aria-expanded", !$("keys").hidden); };
  for (const b of document.querySelectorAll("[data-layout]")) b.onclick = () => setLayout(b.dataset.layout);

  const pull = (event) => {
    const box = $("energy").getBoundingClientRect();
    seek(start + (event.clientX - box.left - MARGIN) / (box.width - MARGIN - 6) * (end - start));
  };
  $("energy").onpointerdown = (event) => { $("energy").setPointerCapture(event.pointerId); pull(event); };
  $("energy").onpointermove = (event) => { if (event.buttons) pull(event); };

  const speedStep = (d) => {
    const near = SPEEDS.findIndex((v) => v >= state.speed - 1e-9);
    setSpeed(SPEEDS[Math.min(Math.max((near < 0 ? SPEEDS.length : near) + d, 0), SPEEDS.length - 1)]);
  };
  const keys = {
    " ": () => play(!state.playing), Home: () => seek(start), End: () => seek(end),
    ArrowLeft: (e) => stepFrames(e.shiftKey ? -10 : -1), ArrowRight: (e) => stepFrames(e.shiftKey ? 10 : 1),
    ArrowUp: () => speedStep(1), ArrowDown: () => speedStep(-1),
    "[": () => setWorld(state.world - 1), "]": () => setWorld(state.world + 1),
    t: () => $("trails").click(), c: () => $("contacts").click(), o: () => $("ghost").click(),
    g: () => setLayout({ one: "grid", grid: "overlay", overlay: "one" }[state.layout]), f: fit, "?": () => $("help").click(),
  };
  window.addEventListener("keydown", (event) => {
    const on = document.activeElement, key = event.key.length > 1 ? event.key : event.key.toLowerCase();
    if (event.ctrlKey || event.metaKey || event.altKey || on.tagName === "SELECT") return;
    if (key === " " && (on.tagName === "BUTTON" || on.type === "checkbox")) return;  // the key presses that control
    if (!keys[key]) return;
    event.preventDefault();
    keys[key](event);
  });
  window.addEventListener("resize", () => { dirty = true; });
  wirePointer();
}

function wirePointer() {
  const fingers = new Map();
  const pan = (dx, dy) => {
    const c = camera(), metres = 2 * c.tanY * state.distance / canvas.clientHeight;
    if (state.follow >= 0) return;
    state.target = add(add(state.target, c.right, -dx * metres), c.up, dy * metres);
  };
  const zoom = (factor) => {
    const r = radiusOf(bounds(shown()));
    state.distance = Math.min(Math.max(state.distance * factor, 0.02 * radiusOf(one)), 40 * r);
    dirty = true;
  };
  canvas.addEventListener("contextmenu", (e) => e.preventDefault());
  canvas.addEventListener("pointerdown", (e) => {
    if (document.activeElement !== document.body) document.activeElement.blur();
    canvas.setPointerCapture(e.pointerId);
    canvas.classList.add("dragging");
    fingers.set(e.pointerId, [e.clientX, e.clientY]);
  });
  const up = (e) => { fingers.delete(e.pointerId); if (!fingers.size) canvas.classList.remove("dragging"); };
  canvas.addEventListener("pointerup", up);
  canvas.addEventListener("pointercancel", up);
  canvas.addEventListener("pointermove", (e) => {
    const from = fingers.get(e.pointerId);
    if (!from) return;
    const [dx, dy] = [e.clientX - from[0], e.clientY - from[1]];
    if (fingers.size > 1) {
      const other = [...fingers].find(([id]) => id !== e.pointerId)[1];
      zoom(Math.hypot(from[0] - other[0], from[1] - other[1]) / Math.max(1, Math.hypot(e.clientX - other[0], e.clientY - other[1])));
      pan(dx / 2, dy / 2);
    } else if (e.buttons & 6 || e.shiftKey) pan(dx, dy);
    else {
      state.azimuth -= dx * 0.007;
      state.elevation = Math.min(Math.max(state.elevation + dy * 0.007, -1.5), 1.5);
    }
    fingers.set(e.pointerId, [e.clientX, e.clientY]);
    dirty = true;
  });
  canvas.addEventListener("wheel", (e) => {
    e.preventDefault();
    zoom(Math.exp(Math.min(Math.max(e.deltaY * (e.deltaMode ? 20 : 1), -200), 200) * 0.0015));
  }, { passive: false });
}

// ---------------------------------------------------------------- start

function setUp() {
  const most = Math.max(state.count, 1), of = (kind) => head.kind.filter((k) => k === kind).length;
  const capacity = (kind) => of(kind) * Math.max(most, ...counts, 1);
  shaders = { solid: program(VERTEX, SOLID), plane: program(VERTEX, PLANE), depth: program(VERTEX, DEPTH) };
  solids = { sphere: sphereMesh(capacity("sphere") > 400 ? 16 : 32, capacity("sphere")), box: boxMesh(capacity("box")) };
  plane = planeMesh();
  const size = Math.min(2048, gl.getParameter(gl.MAX_TEXTURE_SIZE)), texture = gl.createTexture(), frame = gl.createFramebuffer();
  gl.activeTexture(gl.TEXTURE0);
  gl.bindTexture(gl.TEXTURE_2D, texture);
  gl.texStorage2D(gl.TEXTURE_2D, 1, gl.DEPTH_COMPONENT24, size, size);
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.LINEAR);
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.LINEAR);
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_WRAP_S, gl.CLAMP_TO_EDGE);
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_WRAP_T, gl.CLAMP_TO_EDGE);
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_COMPARE_MODE, gl.COMPARE_REF_TO_TEXTURE);
  gl.bindFramebuffer(gl.FRAMEBUFFER, frame);
  gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.DEPTH_ATTACHMENT, gl.TEXTURE_2D, texture, 0);
  gl.drawBuffers([gl.NONE]);
  gl.readBuffer(gl.NONE);
  gl.bindFramebuffer(gl.FRAMEBUFFER, null);
  shadow = { frame, size };
  gl.enable(gl.DEPTH_TEST);
}

function tick(now) {
  const passed = Math.min(Math.max((now - last) / 1000, 0), 0.1);
  last = now;
  // a machine that cannot keep up (no graphics processor) gets fewer pixels
  lag = state.playing ? 0.9 * lag + 0.1 * passed : 0.016;
  if (lag > 0.055 && sharpness > 0.5) { sharpness = Math.max(0.5, 0.75 * sharpness); lag = 0.016; }
  if (state.playing) {
    state.t += passed * state.speed;
    if (state.t >= end) {
      if (state.loop) state.t = start + (state.t - end) % (end - start);
      else { state.t = end; play(false); }
    }
    dirty = true;
  }
  if (dirty) {
    dirty = false;
    draw();
    document.documentElement.dataset.drawn ??= Math.round(now); // since it was opened [ms], for who measures it
  }
  requestAnimationFrame(tick);
}

async function main() {
  if (!gl) fail("This page needs WebGL2, which this browser does not provide or has switched off. "
    + "Any current Firefox, Chrome, Edge or Safari has it; look for hardware acceleration in the settings.");
  data = await unpack();
  [start, end] = [data.time[0], data.time[T - 1]];
  setUp();
  wire();
  resize();
  const count = number("count", state.count, 1, 64);
  state.count = counts.reduce((a, b) => Math.abs(b - count) < Math.abs(a - count) ? b : a, state.count);
  if (counts.length) $("count").value = state.count;
  const asked = options.get("layout");
  setLayout(["one", "grid", "overlay"].includes(asked) ? asked : "one");
  setWorld(state.world);
  seek(number("t", start, start, end));
  fit();
  canvas.addEventListener("webglcontextlost", (e) => {
    e.preventDefault();
    $("message").textContent = "The browser dropped the graphics context. Reload the page.";
    $("message").hidden = false;
  });
  play(options.has("play") ? options.get("play") !== "0" : !still);
  window.player = { state, head, data, draw, seek, play, bodyPose, sampleAt };
  last = performance.now();
  requestAnimationFrame(tick);
}

main().catch((error) => {
  if ($("message").hidden) { $("message").textContent = "The page could not start: " + error.message; $("message").hidden = false; }
  console.error(error);
});
})();
