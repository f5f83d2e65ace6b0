// Strips over time of the chosen trajectory: height, slip, touch. Data: see motion.py.
const strips = contact && document.querySelector("#contact canvas");
const ink = contact && strips.getContext("2d");

if (contact) {
  contact.bytes = Math.ceil((contact.spheres + 1) / 8);
  scene.entries.forEach((entry, k) => {
    const packed = contact.entries[k];
    entry.gap = unpack(packed.gap, Float32Array);
    entry.slip = unpack(packed.slip, Float32Array);
    entry.flags = unpack(packed.flags, Uint8Array);
  });
}

// Whether a sphere touches in a step; number `contact.spheres` tells whether it has an impact.
function flag(entry, step, which) {
  const at = (state.trajectory * (contact.frames - 1) + step) * contact.bytes + (which >> 3);
  return (entry.flags[at] >> (7 - (which & 7))) & 1;
}

// Time since a sphere last touched [s], infinite where it is long ago, and whether that was a hit.
function lastTouch(entry, sphere, seconds) {
  const now = Math.min(Math.floor(seconds / contact.step + 1e-9), contact.frames - 2);
  for (let step = now; step >= Math.max(0, now - 10); step -= 1) {
    if (!flag(entry, step, sphere)) continue;
    return { since: Math.max(0, seconds - (step + 1) * contact.step), hit: flag(entry, step, contact.spheres) };
  }
  return { since: Infinity, hit: 0 };
}

// --- layout ----------------------------------------------------------------------------------

const STRIP = 118;
const LANE = contact && Math.max(4, Math.min(12, 28 / contact.spheres));

// Entries with anything to show of the trajectory beyond its start.
function shown() {
  return scene.entries.filter((entry) => Number.isFinite(entry.gap[state.trajectory * contact.frames + 1]));
}

function layout() {
  const width = strips.getBoundingClientRect().width;
  const left = width < 640 ? 112 : 128;
  const rows = shown().map((_, k) => 20 + k * (contact.spheres * LANE + 10));
  const bands = [{ kind: "gap", title: "Height of the lowest point", unit: "m" }];
  if (contact.slips) bands.push({ kind: "slip", title: "Slip where it touches", unit: "m/s" });
  bands.forEach((band, k) => Object.assign(band, { top: 24 + k * (STRIP + 34), height: STRIP }));
  const top = 24 + bands.length * (STRIP + 34);
  const height = top + rows[rows.length - 1] + contact.spheres * LANE + 38;
  const duration = (contact.frames - 1) * contact.step;
  const x = (time) => left + (time / duration) * (width - left - 10);
  return { width, height, left, bands, top, rows, x, duration };
}

function ticks(low, high, count) {
  const rough = (high - low) / count;
  const power = 10 ** Math.floor(Math.log10(rough));
  const step = [1, 2, 5, 10].map((digit) => digit * power).find((value) => value >= rough);
  const values = [];
  for (let k = Math.ceil(low / step - 1e-9); k * step <= high + 1e-9 * step; k += 1) values.push(k * step);
  return values;
}

// --- drawing ---------------------------------------------------------------------------------

function drawStrips() {
  const plan = layout();
  const ratio = window.devicePixelRatio || 1;
  const [width, height] = [plan.width, plan.height].map((value) => Math.round(value * ratio));
  if (strips.width !== width || strips.height !== height) {
    Object.assign(strips, { width, height });
    strips.style.height = `${plan.height}px`;
  }
  ink.setTransform(ratio, 0, 0, ratio, 0, 0);
  ink.clearRect(0, 0, plan.width, plan.height);
  ink.font = `${plan.width < 640 ? 11 : 12}px system-ui, sans-serif`;
  drawBeyond(plan);
  drawTimes(plan);
  for (const band of plan.bands) drawBand(plan, band);
  drawLanes(plan);
  drawNow(plan);
}

function write(text, x, y, colour, align = "start") {
  ink.fillStyle = colour;
  ink.textAlign = align;
  ink.fillText(text, x, y);
}

function stroke(points, colour, width = 1) {
  ink.beginPath();
  points.forEach(([x, y], k) => (k ? ink.lineTo(x, y) : ink.moveTo(x, y)));
  ink.strokeStyle = colour;
  ink.lineWidth = width;
  ink.stroke();
}

// Beyond the first impact of several spheres no solution is the one.
function drawBeyond(plan) {
  const end = contact.ends[state.trajectory];
  if (end === null) return;
  const x = plan.x(end);
  ink.globalAlpha = 0.5;
  ink.fillStyle = theme("--line");
  ink.fillRect(x, 4, plan.width - 10 - x, plan.height - 32);
  ink.globalAlpha = 1;
  stroke([[x, 4], [x, plan.height - 28]], theme("--muted"));
  const text = end ? `no unique solution beyond ${end.toFixed(3)} s` : "no unique solution: starts in contact";
  write(text, plan.width - 16, 18, theme("--muted"), "end");
}

function drawTimes(plan) {
  const y = plan.height - 28;
  for (const time of ticks(0, plan.duration, plan.width < 640 ? 4 : 8)) {
    stroke([[plan.x(time), 4], [plan.x(time), y]], theme("--line"));
    const text = `${Number(time.toPrecision(3))} s`;
    const last = plan.width - ink.measureText(text).width / 2; // whole at the right edge, too
    write(text, Math.min(plan.x(time), last), y + 17, theme("--muted"), "center");
  }
}

function range(kind) {
  const from = state.trajectory * contact.frames;
  let [low, high] = [0, 0];
  for (const entry of scene.entries) {
    for (const value of entry[kind].subarray(from, from + contact.frames)) {
      if (Number.isFinite(value)) [low, high] = [Math.min(low, value), Math.max(high, value)];
    }
  }
  return [low, Math.max(high, low + 1e-9)];
}

function drawBand(plan, { kind, title, unit, top, height }) {
  const [low, high] = range(kind);
  const y = (value) => top + height - ((value - low) / (high - low)) * (height - 6);
  write(title, plan.left + 6, top - 6, theme("--ink"));
  for (const value of ticks(low, high, 3)) {
    stroke([[plan.left, y(value)], [plan.width - 10, y(value)]], theme(value ? "--line" : "--muted"));
    write(value ? quantity(value, unit) : "0", plan.left - 8, y(value) + 4, theme("--muted"), "end");
  }
  for (const entry of scene.entries) if (entry.visible) drawCurve(plan, entry, kind, y);
}

function quantity(value, unit) {
  const text = metres(Math.abs(value));
  return (value < 0 ? "−" : "") + (unit === "m" ? text : `${text}/s`);
}

function drawCurve(plan, entry, kind, y) {
  const from = state.trajectory * contact.frames;
  const reference = entry.colour === null;
  let run = [];
  ink.globalAlpha = reference ? 0.35 : 1;
  ink.setLineDash(entry.dashed ? [7, 5] : []);
  const finish = () => {
    stroke(run, colourOf(entry), reference ? 5 : 1.6);
    run = [];
  };
  for (let frame = 0; frame < contact.frames; frame += 1) {
    const value = entry[kind][from + frame];
    if (Number.isFinite(value)) run.push([plan.x(frame * contact.step), y(value)]);
    else if (run.length) finish();
  }
  if (run.length) finish();
  ink.setLineDash([]);
  ink.globalAlpha = 1;
}

function drawLanes(plan) {
  write("Touch", plan.left + 6, plan.top + 8, theme("--ink"));
  const depth = contact.spheres * LANE;
  shown().forEach((entry, k) => {
    const top = plan.top + plan.rows[k];
    ink.globalAlpha = entry.visible ? 1 : 0.4;
    write(entry.name, plan.left - 8, top + depth / 2 + 4, colourOf(entry), "end");
    ink.globalAlpha = 1;
    if (!entry.visible) return;
    stroke([[plan.left, top + depth + 1], [plan.width - 10, top + depth + 1]], theme("--line"));
    drawSteps(plan, entry, top, depth);
  });
}

function drawSteps(plan, entry, top, depth) {
  const wide = Math.max(plan.x(contact.step) - plan.x(0), 2);
  ink.fillStyle = colourOf(entry);
  for (let step = 0; step < contact.frames - 1; step += 1) {
    const x = plan.x(step * contact.step);
    const hit = flag(entry, step, contact.spheres);
    ink.globalAlpha = hit ? 1 : 0.45;
    for (let sphere = 0; sphere < contact.spheres; sphere += 1) {
      if (flag(entry, step, sphere)) ink.fillRect(x, top + sphere * LANE, wide, Math.max(LANE - 1, 2));
    }
    if (hit) pointAt(x + wide / 2, top - 1);
  }
  ink.globalAlpha = 1;
}

function pointAt(x, y) {
  ink.beginPath();
  [[x - 3.5, y - 6], [x + 3.5, y - 6], [x, y]].forEach(([a, b], k) => (k ? ink.lineTo(a, b) : ink.moveTo(a, b)));
  ink.fill();
}

function drawNow(plan) {
  const x = plan.x(state.frame * scene.step);
  stroke([[x, 4], [x, plan.height - 28]], theme("--ink"), 1.5);
}

// A press or drag on the strips goes to that time.
if (contact) {
  const jump = (event) => {
    if (event.type === "pointermove" && !event.buttons) return;
    const plan = layout();
    const part = (event.offsetX - plan.left) / (plan.width - 10 - plan.left);
    go((Math.min(Math.max(part, 0), 1) * plan.duration) / scene.step);
  };
  strips.addEventListener("pointerdown", jump);
  strips.addEventListener("pointermove", jump);
  element("trajectory").addEventListener("change", (event) => {
    for (const table of document.querySelectorAll("#contact table")) {
      table.hidden = table.dataset.trajectory !== event.target.value;
    }
  });
}
