"use strict";

// Positions come as a common base in 16 bits over its box, and each engine's deviation from it in
// 16 bits on a cubic scale (see animation.py).
const scene = JSON.parse(document.getElementById("data").textContent);

function unpack(text, Kind) {
  const bytes = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
  return new Kind(bytes.buffer);
}

scene.base = unpack(scene.base, Uint16Array);
for (const entry of scene.entries) {
  entry.deviation = entry.deviation && unpack(entry.deviation, Int16Array);
  entry.error = entry.error && unpack(entry.error, Float32Array);
  entry.visible = true;
}

const element = (name) => document.querySelector(`[data-do="${name}"]`);
const canvas = document.querySelector(".viewer canvas");
const pen = canvas.getContext("2d");
const clock = document.querySelector(".clock");
const readout = document.querySelector(".readout");

const HOME = scene.dimension === 3 ? { yaw: -0.9, pitch: 0.28 } : { yaw: 0, pitch: 0.06 };
const view = { ...HOME, zoom: 1, shiftX: 0, shiftY: 0 };
const state = { trajectory: 0, frame: 0, playing: false, magnify: 1, speed: 1, trails: true };

// --- positions -------------------------------------------------------------------------------

function basePoint(row, frame, point, axis) {
  const at = ((row * scene.frames + frame) * scene.points + point) * 3 + axis;
  return scene.low[axis] + (scene.base[at] / 65535) * (scene.high[axis] - scene.low[axis]);
}

function entryPoint(entry, row, frame, point, axis) {
  const at = ((row * scene.frames + frame) * scene.points + point) * 3 + axis;
  const part = entry.deviation ? entry.deviation[at] / 32767 : 0;
  return basePoint(row, frame, point, axis) + state.magnify * scene.reach * part ** 3;
}

// Between two frames a point is on the line between them.
function place(entry, frame, point) {
  const before = Math.floor(frame);
  const after = Math.min(before + 1, entry.shown[state.trajectory] - 1);
  const part = frame - before;
  return [0, 1, 2].map((axis) => {
    const from = entryPoint(entry, state.trajectory, before, point, axis);
    return part ? from + part * (entryPoint(entry, state.trajectory, after, point, axis) - from) : from;
  });
}

function shape(entry, frame) {
  const points = [];
  for (let point = 0; point < scene.points; point += 1) points.push(place(entry, frame, point));
  return points.concat(scene.fixed);
}

// --- camera ----------------------------------------------------------------------------------

// The box of the motion, with the fixed points.
const box3 = scene.low.map((low, axis) => {
  const fixed = scene.fixed.map((point) => point[axis]);
  return [Math.min(low, ...fixed), Math.max(scene.high[axis], ...fixed)];
});
const middle = box3.map(([low, high]) => (low + high) / 2);
const size = Math.max(Math.hypot(...box3.map(([low, high]) => high - low)), 1e-6);

// Right, up and away of a point as the eye sees it, from the middle of the box.
function seen([x, y, z], { yaw, pitch }) {
  const [a, b, c] = [x - middle[0], y - middle[1], z - middle[2]];
  const away = -Math.sin(yaw) * a + Math.cos(yaw) * b;
  return [
    Math.cos(yaw) * a + Math.sin(yaw) * b,
    Math.cos(pitch) * c - Math.sin(pitch) * away,
    Math.cos(pitch) * away + Math.sin(pitch) * c,
  ];
}

// Pixels a metre at which the box fills most of the canvas in the first view.
function fitting(box) {
  const corners = box3[0].flatMap((x) => box3[1].flatMap((y) => box3[2].map((z) => seen([x, y, z], HOME))));
  const reach = (axis) => Math.max(...corners.map((corner) => Math.abs(corner[axis])), size / 50);
  return 0.4 * Math.min(box.width / reach(0), box.height / reach(1));
}

function camera() {
  const box = canvas.getBoundingClientRect();
  const scale = view.zoom * fitting(box);
  const distance = 2.6 * size;
  const project = (point) => {
    const [right, up, away] = seen(point, view);
    const near = (scale * distance) / Math.max(distance + away, 0.1 * distance);
    return [box.width / 2 + view.shiftX + near * right, box.height / 2 + view.shiftY - near * up, near];
  };
  return { project, box, scale };
}

// --- drawing ---------------------------------------------------------------------------------

const theme = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
const colourOf = (entry) => theme(entry.colour === null ? "--ink" : `--c${entry.colour}`);

function line(points) {
  pen.beginPath();
  points.forEach(([x, y], k) => (k ? pen.lineTo(x, y) : pen.moveTo(x, y)));
  pen.stroke();
}

function disc([x, y], radius) {
  pen.beginPath();
  pen.arc(x, y, radius, 0, 2 * Math.PI);
}

function drawGround(eye) {
  const step = 10 ** Math.floor(Math.log10(size / 2));
  const range = [0, 1].map((axis) => [
    Math.floor((box3[axis][0] - size / 4) / step) * step,
    Math.ceil((box3[axis][1] + size / 4) / step) * step,
  ]);
  pen.strokeStyle = theme("--line");
  pen.lineWidth = 1;
  for (let x = range[0][0]; x <= range[0][1] + step / 2; x += step) {
    line([[x, range[1][0], 0], [x, range[1][1], 0]].map(eye.project));
  }
  for (let y = range[1][0]; y <= range[1][1] + step / 2; y += step) {
    line([[range[0][0], y, 0], [range[0][1], y, 0]].map(eye.project));
  }
}

function drawAnchors(eye) {
  pen.fillStyle = theme("--muted");
  for (const point of scene.fixed) {
    const [x, y] = eye.project(point);
    pen.fillRect(x - 5, y - 5, 10, 10);
  }
}

function drawEntry(entry, eye) {
  const reference = entry.colour === null;
  const points = shape(entry, state.frame).map(eye.project);
  pen.strokeStyle = pen.fillStyle = colourOf(entry);
  pen.lineCap = pen.lineJoin = "round";
  pen.lineWidth = reference ? 5 : 2;
  pen.setLineDash(entry.dashed ? [7, 5] : []);
  pen.globalAlpha = reference ? 0.85 : 1;
  for (const [from, to] of scene.edges) line([points[from], points[to]]);
  pen.setLineDash([]);
  for (let k = 0; k < scene.points; k += 1) {
    const radius = scene.radius[k];
    if (radius < 0) continue;
    disc(points[k], radius ? radius * points[k][2] : reference ? 6 : 3.5);
    if (radius) pen.stroke();
    else pen.fill();
  }
  pen.globalAlpha = 1;
}

// The way of the last point, which in a chain is its free end.
function drawTrail(entry, eye) {
  const length = Math.round(0.8 / scene.step);
  const first = Math.max(0, Math.ceil(state.frame) - length);
  const way = [];
  for (let frame = first; frame < state.frame; frame += 1) way.push(frame);
  const points = [...way, state.frame].map((frame) => eye.project(place(entry, frame, trailPoint())));
  pen.strokeStyle = colourOf(entry);
  pen.lineWidth = 1.5;
  for (let k = 1; k < points.length; k += 1) {
    pen.globalAlpha = (0.55 * k) / points.length;
    line([points[k - 1], points[k]]);
  }
  pen.globalAlpha = 1;
}

function trailPoint() {
  const dots = scene.radius.map((radius, k) => (radius < 0 ? -1 : k));
  return Math.max(0, ...dots);
}

function drawTriad(eye) {
  const origin = [46, eye.box.height - 46];
  const zero = eye.project(middle);
  pen.lineWidth = 1.5;
  pen.font = "12px system-ui, sans-serif";
  pen.strokeStyle = pen.fillStyle = theme("--muted");
  ["x", "y", "z"].forEach((name, axis) => {
    const tip = middle.map((value, k) => value + (k === axis ? size / 20 : 0));
    const [x, y] = eye.project(tip).map((value, k) => ((value - zero[k]) * 500) / (eye.scale * size));
    line([origin, [origin[0] + x, origin[1] + y]]);
    pen.fillText(name, origin[0] + 1.35 * x - 3, origin[1] + 1.35 * y + 4);
  });
}

function drawScale(eye) {
  const metre = 10 ** Math.floor(Math.log10(140 / eye.scale));
  const length = [5, 2, 1].map((digit) => digit * metre).find((value) => value * eye.scale <= 140);
  const [x, y] = [eye.box.width - 24, eye.box.height - 24];
  pen.strokeStyle = pen.fillStyle = theme("--muted");
  pen.lineWidth = 1.5;
  line([[x - length * eye.scale, y - 4], [x - length * eye.scale, y], [x, y], [x, y - 4]]);
  pen.textAlign = "center";
  pen.fillText(metres(length), x - (length * eye.scale) / 2, y - 8);
  pen.textAlign = "start";
}

function metres(value) {
  if (!Number.isFinite(value)) return "–";
  const [scale, unit] = [[1, "m"], [1e-3, "mm"], [1e-6, "µm"], [1e-9, "nm"]].find(([s]) => value >= s) || [1e-9, "nm"];
  return `${Number((value / scale).toPrecision(2))} ${unit}`;
}

function drawnEntries() {
  return scene.entries.filter((entry) => entry.visible && state.frame <= entry.shown[state.trajectory] - 1);
}

function tell() {
  clock.textContent = `${(state.frame * scene.step).toFixed(2)} s`;
  readout.replaceChildren(row("", "error now", "head"));
  for (const entry of scene.entries) {
    if (entry.colour === null || !entry.visible) continue;
    const gone = state.frame > entry.shown[state.trajectory] - 1;
    const error = entry.error && entry.error[state.trajectory * scene.frames + Math.round(state.frame)];
    readout.append(row(entry.name, gone ? "ended" : metres(error), "", colourOf(entry)));
  }
}

function row(name, value, kind, colour) {
  const line_ = document.createElement("div");
  line_.className = kind;
  for (const text of [name, value]) {
    const part = document.createElement("span");
    part.textContent = text;
    if (colour) part.style.color = colour;
    line_.append(part);
  }
  return line_;
}

function draw() {
  const ratio = window.devicePixelRatio || 1;
  const eye = camera();
  const [width, height] = [Math.round(eye.box.width * ratio), Math.round(eye.box.height * ratio)];
  if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
  pen.setTransform(ratio, 0, 0, ratio, 0, 0);
  pen.clearRect(0, 0, eye.box.width, eye.box.height);
  if (scene.ground) drawGround(eye);
  drawAnchors(eye);
  const drawn = drawnEntries();
  if (state.trails && scene.points) drawn.forEach((entry) => drawTrail(entry, eye));
  drawn.forEach((entry) => drawEntry(entry, eye));
  drawTriad(eye);
  drawScale(eye);
  tell();
  element("scrub").value = state.frame;
  element("play").textContent = state.playing ? "❚❚" : "▶";
}

// --- time ------------------------------------------------------------------------------------

let last = null;
let asked = false;

function refresh() {
  if (!asked) requestAnimationFrame(tick);
  asked = true;
}

function tick(now) {
  asked = false;
  if (state.playing) {
    const passed = last === null ? 0 : Math.min((now - last) / 1000, 0.1);
    state.frame += (state.speed * passed) / scene.step;
    if (state.frame > scene.frames - 1) state.frame = 0;
    last = now;
  }
  draw();
  if (state.playing) refresh();
}

function play(on) {
  state.playing = on;
  last = null;
  refresh();
}

function go(frame) {
  state.playing = false;
  state.frame = Math.min(Math.max(frame, 0), scene.frames - 1);
  refresh();
}

// --- controls --------------------------------------------------------------------------------

function connectControls() {
  element("scrub").max = scene.frames - 1;
  scene.trajectories.forEach(({ index, interval }, row) => {
    element("trajectory").append(new Option(`${index} (${interval})`, row));
  });
  element("play").addEventListener("click", () => play(!state.playing));
  element("scrub").addEventListener("input", (event) => go(Number(event.target.value)));
  for (const name of ["trajectory", "speed", "magnify"]) {
    element(name).addEventListener("change", (event) => {
      state[name] = Number(event.target.value);
      refresh();
    });
  }
  element("trails").addEventListener("change", (event) => {
    state.trails = event.target.checked;
    refresh();
  });
  element("reset").addEventListener("click", () => {
    Object.assign(view, HOME, { zoom: 1, shiftX: 0, shiftY: 0 });
    refresh();
  });
}

// A tick in the legend shows an engine in the viewer and in every plot.
function connectLegend() {
  for (const box of document.querySelectorAll("#legend input")) {
    box.addEventListener("change", () => {
      const entry = scene.entries.find(({ name }) => name === box.dataset.show);
      if (entry) entry.visible = box.checked;
      for (const curve of document.querySelectorAll(`.result-${box.dataset.result}`)) {
        curve.style.display = box.checked ? "" : "none";
      }
      refresh();
    });
  }
}

function connectPointer() {
  const pointers = new Map();
  const spread = () => {
    const [one, two] = [...pointers.values()];
    return Math.hypot(one.x - two.x, one.y - two.y);
  };
  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    pointers.set(event.pointerId, { x: event.clientX, y: event.clientY });
  });
  canvas.addEventListener("pointermove", (event) => {
    const before = pointers.get(event.pointerId);
    if (!before) return;
    const [dx, dy] = [event.clientX - before.x, event.clientY - before.y];
    const width = pointers.size === 2 ? spread() : 0;
    pointers.set(event.pointerId, { x: event.clientX, y: event.clientY });
    if (pointers.size === 2) zoom(spread() / Math.max(width, 1));
    else if (event.shiftKey) Object.assign(view, { shiftX: view.shiftX + dx, shiftY: view.shiftY + dy });
    else turn(dx, dy);
    refresh();
  });
  for (const end of ["pointerup", "pointercancel"]) {
    canvas.addEventListener(end, (event) => pointers.delete(event.pointerId));
  }
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    zoom(Math.exp(-event.deltaY / 500));
  }, { passive: false });
}

function turn(dx, dy) {
  view.yaw -= dx / 150;
  view.pitch = Math.min(Math.max(view.pitch + dy / 150, -1.57), 1.57);
}

function zoom(factor) {
  const limited = Math.min(Math.max(view.zoom * factor, 0.2), 2000) / view.zoom;
  Object.assign(view, { zoom: view.zoom * limited, shiftX: view.shiftX * limited, shiftY: view.shiftY * limited });
  refresh();
}

function connectKeys() {
  const keys = {
    " ": () => play(!state.playing),
    ArrowLeft: () => go(Math.ceil(state.frame) - 1),
    ArrowRight: () => go(Math.floor(state.frame) + 1),
    "+": () => zoom(1.2),
    "-": () => zoom(1 / 1.2),
  };
  canvas.addEventListener("keydown", (event) => {
    if (!keys[event.key]) return;
    event.preventDefault();
    keys[event.key]();
  });
}

connectControls();
connectLegend();
connectPointer();
connectKeys();
window.addEventListener("resize", refresh);
window.matchMedia("(prefers-color-scheme: dark)").addEventListener("change", refresh);
if (window.matchMedia("(prefers-reduced-motion: reduce)").matches) refresh();
else play(true);
