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
  scene.trajectories.forEach(({ label }, row) => {
    element("trajectory").append(new Option(label, row));
  });
  element("play").addEventListener("click", () => play(!state.playing));
  element("scrub").addEventListener("input", (event) => go(Number(event.target.value)));
  for (const name of ["trajectory", "speed", "magnify"]) {
    element(name).addEventListener("change", (event) => {
      state[name] = Number(event.target.value);
      refresh();
    });
  }
  for (const name of ["trails", "follow"]) {
    element(name).addEventListener("change", (event) => {
      state[name] = event.target.checked;
      refresh();
    });
  }
  // A motion that goes far is best seen from along the way.
  const far = contact !== null && size > 8 * own;
  element("follow").closest("label").hidden = !far;
  state.follow = element("follow").checked = far;
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
      for (const curve of document.querySelectorAll(`.curve-${box.dataset.result}`)) {
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
