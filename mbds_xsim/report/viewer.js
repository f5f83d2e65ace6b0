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

// What contact adds: the spheres that touch in a step, and the camera that goes along.
const contact = scene.contact || null;
const HOME = scene.dimension === 3 ? { yaw: -0.9, pitch: 0.28 } : { yaw: 0, pitch: 0.06 };
const view = { ...HOME, zoom: 1, shiftX: 0, shiftY: 0 };
const state = { trajectory: 0, frame: 0, playing: false, magnify: 1, speed: 1, trails: true, follow: false };

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

// What is looked at: the whole motion, or the place of the base at the time, down to the ground.
let focus = { middle, size };

function basePoints(frame) {
  const points = [];
  for (let k = 0; k < scene.points; k += 1) {
    points.push([0, 1, 2].map((axis) => basePoint(state.trajectory, frame, k, axis)));
  }
  return points;
}

const mean = (points) => [0, 1, 2].map((axis) => points.reduce((sum, point) => sum + point[axis], 0) / points.length);
const own = (() => {
  if (!scene.points) return size;
  const points = basePoints(0);
  const centre = mean(points);
  const reach = points.map((point, k) => Math.hypot(...point.map((x, axis) => x - centre[axis])) + Math.max(scene.radius[k], 0));
  return 2 * Math.max(...reach);
})();

function lookAt() {
  if (!state.follow) return { middle, size };
  const [from, to] = [Math.floor(state.frame), Math.ceil(state.frame)].map((frame) => mean(basePoints(frame)));
  const part = state.frame % 1;
  const place = from.map((x, axis) => x + part * (to[axis] - x));
  const high = scene.high[2] - Math.min(0, scene.low[2]);
  return { middle: [place[0], place[1], high / 2], size: Math.max(2.2 * own, 1.15 * high) };
}

// Right, up and away of a point as the eye sees it, from the middle of what is looked at. The eye
// is above it where the pitch is positive.
function seen([x, y, z], { yaw, pitch }) {
  const [a, b, c] = [x - focus.middle[0], y - focus.middle[1], z - focus.middle[2]];
  const away = -Math.sin(yaw) * a + Math.cos(yaw) * b;
  return [
    Math.cos(yaw) * a + Math.sin(yaw) * b,
    Math.cos(pitch) * c + Math.sin(pitch) * away,
    Math.cos(pitch) * away - Math.sin(pitch) * c,
  ];
}

// Pixels a metre at which the box fills most of the canvas in the first view.
function fitting(box) {
  if (state.follow) return (0.8 * Math.min(box.width, box.height)) / focus.size;
  const corners = box3[0].flatMap((x) => box3[1].flatMap((y) => box3[2].map((z) => seen([x, y, z], HOME))));
  const reach = (axis) => Math.max(...corners.map((corner) => Math.abs(corner[axis])), size / 50);
  return 0.4 * Math.min(box.width / reach(0), box.height / reach(1));
}

function camera() {
  const box = canvas.getBoundingClientRect();
  focus = lookAt();
  const scale = view.zoom * fitting(box);
  const distance = 2.6 * focus.size;
  const project = (point) => {
    const [right, up, away] = seen(point, view);
    const near = (scale * distance) / Math.max(distance + away, 0.1 * distance);
    return [box.width / 2 + view.shiftX + near * right, box.height / 2 + view.shiftY - near * up, near];
  };
  // What of a closed line is in front of the eye.
  const inFront = (points) => points.flatMap((point, k) => {
    const from = points[(k || points.length) - 1];
    const [a, b] = [from, point].map((p) => seen(p, view)[2] + 0.9 * distance);
    const crossing = a < 0 === b < 0 ? [] : [from.map((x, axis) => x + (a / (a - b)) * (point[axis] - x))];
    return b < 0 ? crossing : [...crossing, point];
  });
  return { project, inFront, box, scale };
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

// The plane z = 0 with a grid, as far as the motion goes and a little further.
function drawGround(eye) {
  const step = 10 ** Math.floor(Math.log10(focus.size / 2));
  const around = state.follow ? focus.middle.map((x) => [x - 3 * focus.size, x + 3 * focus.size]) : box3;
  const range = [0, 1].map((axis) => [
    Math.floor((around[axis][0] - focus.size / 4) / step) * step,
    Math.ceil((around[axis][1] + focus.size / 4) / step) * step,
  ]);
  const seenLine = (points) => eye.inFront(points).map(eye.project);
  const corners = seenLine([[0, 0], [1, 0], [1, 1], [0, 1]].map(([i, j]) => [range[0][i], range[1][j], 0]));
  pen.beginPath();
  corners.forEach(([x, y], k) => (k ? pen.lineTo(x, y) : pen.moveTo(x, y)));
  pen.fillStyle = theme("--line");
  pen.globalAlpha = 0.3;
  pen.fill();
  pen.globalAlpha = 1;
  pen.strokeStyle = theme("--line");
  pen.lineWidth = 1;
  for (let x = range[0][0]; x <= range[0][1] + step / 2; x += step) {
    line(seenLine([[x, range[1][0], 0], [x, range[1][1], 0]]));
  }
  for (let y = range[1][0]; y <= range[1][1] + step / 2; y += step) {
    line(seenLine([[range[0][0], y, 0], [range[0][1], y, 0]]));
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
  const places = shape(entry, state.frame);
  const points = places.map(eye.project);
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
  if (contact) drawTouch(entry, places, eye);
  pen.globalAlpha = 1;
}

// Where a sphere touches its lowest point is marked; a hit has a halo that fades.
function drawTouch(entry, places, eye) {
  const seconds = state.frame * scene.step;
  const spheres = scene.radius.flatMap((radius, k) => (radius > 0 ? [k] : []));
  spheres.forEach((k, sphere) => {
    const { since, hit } = lastTouch(entry, sphere, seconds);
    const fresh = 1 - since / 0.2;
    if (fresh <= 0) return;
    const [x, y, z] = places[k];
    const low = eye.project([x, y, z - scene.radius[k]]);
    pen.globalAlpha = fresh;
    disc(low, 5);
    pen.fill();
    pen.strokeStyle = theme("--paper");
    pen.stroke();
    if (!hit) return;
    pen.globalAlpha = 0.35 * fresh;
    disc(low, 15);
    pen.fill();
  });
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
  const zero = eye.project(focus.middle);
  pen.lineWidth = 1.5;
  pen.font = "12px system-ui, sans-serif";
  pen.strokeStyle = pen.fillStyle = theme("--muted");
  ["x", "y", "z"].forEach((name, axis) => {
    const tip = focus.middle.map((value, k) => value + (k === axis ? focus.size / 20 : 0));
    const [x, y] = eye.project(tip).map((value, k) => ((value - zero[k]) * 500) / (eye.scale * focus.size));
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
  if (value > 0 && value < 1e-10) return "<0.1 nm";
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
  if (contact) drawStrips();
}
