// The page: a canvas, brushes, controls and plots. Its engine runs the world; npa_envs/web/messages.py describes
// engines, and has all messages to them and events from them.

import { Camera, Tracers, makePainter, marksOf } from "./drawing.js";
import { Plot, make, short } from "./plots.js";

// What missing fields of the event "world" count as.
const BLANK = {
  title: "npa-envs", note: "", dimension: 2, box: null, half_width: 1.1, spot: 0.015, outline: [], rules: [], rule: null,
  centre: [0, 0, 0], others: [], species: [], shows: ["colours"], show: "colours", class_count: 0, tools: [],
  damages: [], settings: {}, capabilities: [], playing: true, seed: 0,
};

// The page's own brush, before those of the world: it sends no messages.
const LOOK = { name: "look", label: "Look: drag to move or turn, wheel or pinch to zoom" };

// Words for the names of `shows_of` of live_world.py that need plainer ones.
const WORDS = { components: "states as colours", mask: "updated now" };

// What colours mean, by the names of `shows_of` of live_world.py, those of state channels without their number.
const MEANINGS = {
  colours: "The particles' own colours, which make the picture.",
  density: "How crowded it is around a particle, from dark to bright.",
  components: "The three directions in which states differ most, as red, green and blue: like colour, like state.",
  species: "Which rule a particle follows.",
  speed: "How far a particle moved in the last step, from dark to bright: bright are the fastest ones.",
  mask: "Which particles the last step updated (yellow): each with probability p.",
  state: "One channel of the states: blue below zero, grey at zero, orange above.",
};

// Colours of classes, those of PALETTE of npa_envs/tasks/point_classification.py, repeated for more.
const CLASSES = ["red", "green", "yellow", "blue", "orange", "purple", "cyan", "pink", "brown", "lavender"];

// SVG paths on a square of side 24, by the names of brushes and controls.
const ICONS = {
  look: "M12 5v14M5 12h14M12 5l-2 2M12 5l2 2M12 19l-2-2M12 19l2-2M5 12l2-2M5 12l2 2M19 12l-2-2M19 12l-2 2",
  wipe: "M4 15l8-9 7 6-7 8H8zM9 20h11M8 10.5l7 6",
  noise: ["6 6", "13 4.5", "19 8", "9.5 11", "15.5 13", "4.5 15.5", "11 18", "18.5 18.5"].map((at) => `M${at}h.01`).join(""),
  remove: "M4 7h16M9 7V4.5h6V7M6.5 7l1 13h9l1-13M10 11v5.5M14 11v5.5",
  push: "M12 20c-4 0-6-3-7-7 2-1 3 0 4 2V6a1.4 1.4 0 0 1 3 0v5a1.4 1.4 0 0 1 3 0v1a1.4 1.4 0 0 1 3 0v3c0 3-2 5-6 5z",
  clump: "M4 4l5 5M20 4l-5 5M4 20l5-5M20 20l-5-5M9 6v3H6M15 6v3h3M9 18v-3H6M15 18v-3h3",
  cut: "M5 19L19 5M6 8a2 2 0 1 0 0-.1M16 18a2 2 0 1 0 0-.1M8 9l8 8",
  inject: "M4 20l3-1 8-8-2-2-8 8zM12 8l4 4M14 10l3-4a1.8 1.8 0 0 1 3 0 1.8 1.8 0 0 1-1 3l-4 2",
  graft: "M12 21v-9M12 12c0-5 3-7 8-7 0 5-3 7-8 7zM12 15c0-4-3-6-8-6 0 4 3 6 8 6z",
  add: "M12 4a8 8 0 1 0 .1 0M12 8v8M8 12h8",
  play: "M8 5l11 7-11 7z", pause: "M8 5v14M16 5v14", one: "M6 5l9 7-9 7zM19 5v14",
  reset: "M5 12a7 7 0 1 0 2-5L5 9M5 4v5h5", fold: "M4 7h10M18 7h2M4 17h2M10 17h10M16 5v4M8 15v4",
};

const PHYSICS = ["eps", "update_prob", "noise", "count"];

const FILM_SIZE = 640; // pixels on each side of a film's pictures, and of the middle of the canvas
const FILM_PAUSE = 40; // milliseconds between two pictures of a film, at least
const QUALITY = 0.92;

const $ = (name) => document.getElementById(name);

// An icon with a word below it.
function icon(name, word) {
  return `<svg viewBox="0 0 24 24" aria-hidden="true" class="${name}"><path d="${ICONS[name]}"/></svg><span>${word}</span>`;
}

// Starts the page, which is also `document.page`, for the console. `connect(settings, listener)` returns a promise of
// an engine: engine.send(message) takes the page's messages, and listener(event) gets the engine's events.
export async function start(connect, settings) {
  const page = (document.page = new Page());
  try {
    page.engine = await connect(settings, (event) => page.listen(event));
  } catch (error) {
    page.showError(error.message);
  }
  return page;
}

// The engine's messages and events, and the picture of the world.
class Page {
  constructor() {
    this.engine = null;
    this.world = { ...BLANK };
    this.described = false; // whether the event "world" has come
    this.frame = null;
    this.acted = null; // the last event "acted"
    this.undrawn = 0; // frames received since the last drawing
    this.dirty = true; // whether the picture has changed without a new frame
    this.camera = new Camera(2, BLANK.half_width);
    this.canvas = $("world");
    this.painter = makePainter(this.canvas, new URLSearchParams(location.search).get("painter") ?? "auto");
    this.tracers = new Tracers();
    this.frameTimes = [];
    this.reported = -Infinity; // when the step was last written
    this.plots = {
      loss: new Plot($("plots"), "Loss", "", { log: true }),
      milliseconds: new Plot($("plots"), "Time of a step", "ms"),
    };
    this.curves = {}; // plots of the events "curve", by name
    this.brushes = new Brushes(this);
    this.film = new Film(this);
    this.controls = new Controls(this);
    requestAnimationFrame(() => this.drawIfNeeded());
  }

  send(message) {
    this.engine?.send(message);
  }

  listen(event) {
    if (event.type === "frame") {
      this.frame = event;
      this.undrawn++;
    } else if (event.type === "world") this.readWorld(event);
    else if (event.type === "curve") this.curve(event);
    else if (event.type === "acted") this.acted = event;
    else if (event.type === "reordered") this.tracers.clear();
    else if (event.type === "film") this.film.end();
    else if (event.type === "file") this.film.offer(event.name, event.url);
    else if (event.type === "error") this.showError(event.message);
  }

  readWorld(event) {
    const before = this.world, world = { ...BLANK, ...event };
    const another = !this.described || before.title !== world.title || before.dimension !== world.dimension;
    this.world = world;
    if (!this.described || before.dimension !== world.dimension || before.half_width !== world.half_width) {
      this.camera = new Camera(world.dimension, world.half_width, world.centre);
      this.frame = null;
      $("loading").hidden = false;
      // Also for undrawn frames of the former world: the engine waits for each.
      this.reportDrawn();
    }
    // Another world, or one whose training has ended: its capabilities grow.
    if (another || before.capabilities.length !== world.capabilities.length) {
      const first = world.dimension === 2 ? world.tools[0]?.name : "look", { name: chosen } = this.brushes.chosen;
      const keeps = before.dimension === world.dimension && this.brushes.offered.slice(1).some(({ name }) => name === chosen);
      this.brushes.choose(keeps ? chosen : first);
      if ($("plots").open) this.send({ type: "set", name: "loss", value: true });
    }
    if (another) {
      Object.values(this.curves).forEach(({ figure }) => figure.remove());
      this.curves = {};
    }
    if (another || before.seed !== world.seed) {
      this.tracers.clear();
      this.acted = null;
      this.brushes.note = "";
      Object.values(this.plots).forEach((plot) => plot.clear());
    }
    this.described = true;
    this.plots.loss.figure.hidden = !world.capabilities.includes("loss") || world.species.length > 1;
    this.controls.show(world, before);
    this.dirty = true;
  }

  curve({ name, points, append }) {
    const plot = (this.curves[name] ??= new Plot($("plots"), name, "", { log: true }));
    if (!append) plot.clear();
    for (const [x, y] of points) plot.add(x, y);
    plot.draw();
  }

  showError(message) {
    $("loading").hidden = $("writing").hidden = true;
    $("message").textContent = message.charAt(0).toUpperCase() + message.slice(1);
    $("message").hidden = false;
    clearTimeout(this.messageTimer);
    this.messageTimer = setTimeout(() => ($("message").hidden = true), 9000);
  }

  play(on) {
    this.world.playing = on;
    this.controls.showPlaying();
    this.brushes.note = "";
    this.brushes.showHint();
    this.send({ type: "play", on });
  }

  // Shows all of the world.
  fit() {
    if (this.frame) this.camera.fit(this.frame.positions);
    this.dirty = true;
  }

  // In each frame of the screen: the brush acts, and new frames of the world are drawn.
  drawIfNeeded() {
    requestAnimationFrame(() => this.drawIfNeeded());
    this.brushes.act();
    if (!this.undrawn && !this.dirty) return;
    if (this.undrawn) this.readFrame();
    this.draw();
    this.reportDrawn();
    this.dirty = false;
  }

  // Reports frames as drawn, also those that later ones have replaced: the engine waits for each.
  reportDrawn() {
    for (; this.undrawn > 0; this.undrawn--) this.send({ type: "drawn" });
  }

  readFrame() {
    const { frame, world } = this, now = performance.now();
    $("loading").hidden = true;
    if ($("tracers").checked) this.tracers.add(frame.positions, world.dimension);
    this.frameTimes.push(now);
    while (this.frameTimes[0] < now - 2000) this.frameTimes.shift();
    this.plots.milliseconds.add(frame.step, frame.milliseconds);
    if (frame.loss !== undefined) this.plots.loss.add(frame.step, frame.loss);
    if (now - this.reported > 250) {
      this.reported = now;
      const { length } = this.frameTimes;
      const rate = length > 1 ? (1000 * (length - 1)) / (now - this.frameTimes[0]) : 0;
      const count = frame.positions.length / world.dimension;
      $("step").textContent = `step ${frame.step} · ${count} particles`;
      if (this.acted) $("step").textContent += ` · reward ${short(this.acted.reward)}, so far ${short(this.acted.total)}`;
      $("rate").textContent = world.playing && rate ? `${Math.round(rate)} frames a second` : "";
      if ($("plots").open) Object.values(this.plots).forEach((plot) => plot.draw());
    }
  }

  // Fractions of the canvas that controls cover, at its right and lower edges; a box may also extend below them.
  get covered() {
    const { canvas: { clientWidth: width, clientHeight: height }, world: { box } } = this;
    if (box) return [0, 0];
    let right = width, low = $("bar").offsetTop;
    // On a phone these lie above the bar.
    for (const one of document.querySelectorAll("#panel, #training:not(.closed)")) {
      const { left, top } = one.getBoundingClientRect();
      if (left > 0.45 * width) right = Math.min(right, left);
      else if (top > height / 4) low = Math.min(low, top);
    }
    return [1 - right / width, 1 - low / height];
  }

  draw({ still = false } = {}) {
    const { canvas, frame, world, camera } = this;
    // More pixels are invisible, and slow without a GPU.
    const ratio = Math.min(devicePixelRatio || 1, 1600 / Math.max(canvas.clientWidth, canvas.clientHeight, 1), 2);
    const width = Math.round(canvas.clientWidth * ratio), height = Math.round(canvas.clientHeight * ratio);
    if (!width || !height) return;
    if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
    camera.covered = this.covered;
    this.painter.draw({
      positions: frame?.positions ?? new Float32Array(), colours: frame?.colours ?? new Uint8Array(),
      dimension: world.dimension, box: world.box, spot: world.spot * $("size").value, camera,
      background: this.background, look: $("style").value, ink: this.ink,
      still: still || (!world.playing && !this.brushes.stroke),
      trails: this.tracers.lines(world.box, this.acted ? marksOf(world.outline, this.acted) : []),
    });
    this.film.add();
  }
}

// The chosen brush and the pointers on the canvas: one pointer uses the brush, two move the camera.
class Brushes {
  constructor(page) {
    this.page = page;
    this.chosen = LOOK;
    this.pointers = new Map();
    this.looking = false; // whether pressed pointers move the camera
    this.note = ""; // what the last stroke has not done, for the user
    // A use from press to release: nearness of what it touches, and pixels where it began, is now, and last acted.
    this.stroke = null;
    const canvas = (this.canvas = page.canvas);
    canvas.onpointerdown = (event) => this.press(event);
    canvas.onpointermove = (event) => this.move(event);
    canvas.onpointerup = canvas.onpointercancel = (event) => this.release(event);
    canvas.onpointerleave = () => { if (!this.pointers.size) $("cursor").hidden = true; };
    canvas.ondblclick = () => { if (this.chosen === LOOK) page.fit(); };
    canvas.oncontextmenu = (event) => event.preventDefault();
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      page.camera.magnify(Math.exp(-event.deltaY * 0.0015));
      page.dirty = true;
    }, { passive: false });
    const sizes = new ResizeObserver(() => {
      document.documentElement.style.setProperty("--bar", `${$("bar").offsetHeight}px`);
      page.dirty = true;
    });
    [canvas, $("bar")].forEach((one) => sizes.observe(one));
  }

  // The world's brushes that can do something in it: a graft takes a second rule.
  get offered() {
    const { tools, others, species } = this.page.world, alone = new Set([...others, ...species]).size < 2;
    return [LOOK, ...tools.filter(({ name }) => name !== "graft" || !alone)];
  }

  // Takes the brush of a name, or "look" if the world does not offer it.
  choose(name) {
    this.chosen = this.offered.find((brush) => brush.name === name) ?? LOOK;
    this.note = "";
    for (const button of $("brushes").children) {
      button.setAttribute("aria-checked", String(button.dataset.brush === this.chosen.name));
      if (button.dataset.brush === this.chosen.name) button.scrollIntoView({ block: "nearest", inline: "nearest" });
    }
    if (this.chosen.takes === "rule") $("brush").open = true;
    this.showHint();
    if (this.chosen === LOOK) $("cursor").hidden = true;
    this.canvas.style.cursor = this.chosen === LOOK ? "grab" : "crosshair";
  }

  // Says what the brush does, and which rule it takes; or what the last stroke has not done.
  showHint() {
    const { note, chosen: { label, takes } } = this, other = takes === "rule" && $("other").value;
    $("hint").textContent = note || (other ? `${label} (${other})` : label);
  }

  // Says that a stroke meets no particles, or that those that it meets act only in a world that runs.
  noteStroke({ tool, at, move, radius, rule }) {
    const { stroke, page: { frame, world: { dimension, box, playing } } } = this;
    if (tool === "add" || stroke.met || !frame) return;
    const { positions } = frame, square = move.reduce((sum, part) => sum + part * part, 0) || 1;
    for (let i = 0; i < positions.length && !stroke.met; i += dimension) {
      const offset = at.map((v, d) => positions[i + d] - v);
      if (box) offset.forEach((v, d) => (offset[d] -= box[d] * Math.round(v / box[d])));
      const along = offset.reduce((sum, v, d) => sum + v * move[d], 0) / square, part = Math.min(1, Math.max(0, along));
      stroke.met = Math.hypot(...offset.map((v, d) => v - part * move[d])) <= radius;
    }
    const waits = tool === "graft" && !playing ? `They follow ${rule} once the world plays` : "";
    this.note = stroke.met ? waits : "No particles under the brush";
    this.showHint();
  }

  // The position of the pointer on the canvas [pixels].
  position(event) {
    const { left, top } = this.canvas.getBoundingClientRect();
    return [event.clientX - left, event.clientY - top];
  }

  press(event) {
    this.canvas.setPointerCapture(event.pointerId);
    const position = this.position(event);
    this.pointers.set(event.pointerId, position);
    this.looking = this.chosen === LOOK || event.button === 2 || event.shiftKey || this.pointers.size > 1;
    if (this.looking) {
      this.stroke = null;
      return;
    }
    const near = this.nearness(position);
    this.stroke = { near, from: position, at: position, sent: position };
    if (this.chosen.sends !== "line") this.use(position, [0, 0]);
    this.showCursor(position);
  }

  move(event) {
    const position = this.position(event), before = this.pointers.get(event.pointerId);
    if (!before) {
      if (event.pointerType === "mouse") this.showCursor(position);
      return;
    }
    const columns = position[0] - before[0], rows = position[1] - before[1];
    const others = [...this.pointers].filter(([id]) => id !== event.pointerId).map(([, at]) => at);
    this.pointers.set(event.pointerId, position);
    const { clientWidth: width, clientHeight: height } = this.canvas;
    if (this.looking) {
      this.page.camera.drag(columns / this.pointers.size, rows / this.pointers.size, width, height);
      if (others.length) this.page.camera.magnify(
        Math.hypot(position[0] - others[0][0], position[1] - others[0][1]) /
        Math.max(Math.hypot(before[0] - others[0][0], before[1] - others[0][1]), 1));
      this.page.dirty = true;
    } else if (this.stroke) {
      this.stroke.at = position;
      this.showCursor(position);
    }
  }

  release(event) {
    const { stroke } = this;
    this.pointers.delete(event.pointerId);
    // The end of a movement that no frame of the screen has seen.
    if (stroke && stroke.at !== stroke.sent && event.type === "pointerup") this.act();
    if (stroke && this.chosen.sends === "line" && event.type === "pointerup") {
      const move = [stroke.at[0] - stroke.from[0], stroke.at[1] - stroke.from[1]];
      if (Math.hypot(...move) > 4) this.use(stroke.from, move);
    }
    this.stroke = null;
    $("knife").hidden = true;
    $("cursor").classList.remove("pressed");
    if (event.pointerType !== "mouse") $("cursor").hidden = true;
  }

  // Nearness of the surface under the pointer, where brushes of 3D worlds act.
  nearness([column, row]) {
    const { canvas, page: { frame, camera, world } } = this;
    if (!frame || world.dimension !== 3) return 0;
    const width = canvas.clientWidth, height = canvas.clientHeight;
    const within = Math.max(8, (0.3 * $("radius").value) / camera.unit(width, height));
    let nearest = -Infinity;
    for (let k = 0; k < frame.positions.length; k += 3) {
      const [x, y, near] = camera.project(frame.positions.subarray(k, k + 3), width, height);
      if (near > nearest && Math.hypot(x - column, y - row) < within) nearest = near;
    }
    return Number.isFinite(nearest) ? nearest : 0;
  }

  // Sends a use of the brush at a position on the canvas, with its movement, both in pixels.
  use(position, pixels) {
    const { canvas, stroke, chosen: brush, page: { camera, world: { dimension, box } } } = this;
    const width = canvas.clientWidth, height = canvas.clientHeight;
    const at = camera.position(...position, width, height, stroke.near).slice(0, dimension);
    const move = camera.movement(...pixels, width, height, stroke.near).slice(0, dimension);
    const wrapped = box ? at.map((v, k) => v - box[k] * Math.round(v / box[k])) : at;
    stroke.source ??= wrapped;
    const message = {
      type: "brush", tool: brush.name, at: wrapped, move,
      radius: this.radius(), strength: +$("strength").value,
    };
    if (brush.takes === "source") message.source = stroke.source;
    if (brush.takes === "rule") message.rule = $("other").value;
    if (dimension === 3) message.view = camera.axes[2];
    this.page.send(message);
    this.noteStroke(message);
  }

  // The brush's radius [length units]; for a line the width of its gap.
  radius() {
    return +$("radius").value * (this.chosen.sends === "line" ? 0.8 : 1);
  }

  showCursor([column, row]) {
    const { canvas, stroke } = this, knife = $("knife"), cursor = $("cursor");
    const unit = this.page.camera.unit(canvas.clientWidth, canvas.clientHeight);
    cursor.hidden = this.chosen === LOOK;
    const size = (2 * this.radius()) / unit;
    cursor.style.width = cursor.style.height = `${size}px`;
    cursor.style.transform = `translate(${column - size / 2}px, ${row - size / 2}px)`;
    cursor.classList.toggle("pressed", Boolean(stroke));
    knife.hidden = !(stroke && this.chosen.sends === "line");
    if (!knife.hidden) {
      const across = column - stroke.from[0], down = row - stroke.from[1];
      knife.style.width = `${Math.hypot(across, down)}px`;
      knife.style.transform =
        `translate(${stroke.from[0]}px, ${stroke.from[1]}px) rotate(${Math.atan2(down, across)}rad)`;
    }
  }

  // Sends what the brush does in a frame of the screen.
  act() {
    const { stroke, canvas, chosen: { sends } } = this;
    if (!stroke) return;
    const { at, sent } = stroke, move = [at[0] - sent[0], at[1] - sent[1]], moved = Math.hypot(...move);
    if (sends === "motion" && moved) this.use(sent, move);
    if (sends === "frame" || (sends === "position" && moved)) {
      // A quick movement in parts, at most a radius long: it leaves no gaps.
      const length = moved * this.page.camera.unit(canvas.clientWidth, canvas.clientHeight);
      const parts = Math.max(1, Math.ceil(length / this.radius())), part = move.map((pixels) => pixels / parts);
      for (let k = 1; k <= parts; k++) this.use([sent[0] + k * part[0], sent[1] + k * part[1]], part);
    }
    stroke.sent = at;
  }
}

// The bar below the canvas, the panel beside it, and the keyboard.
class Controls {
  constructor(page) {
    this.page = page;
    this.pressing = false; // whether a slider is pressed
    for (const [name, word] of [["one", "Step"], ["reset", "New"], ["fold", "Settings"]])
      $(name).innerHTML = icon(name, word);
    $("play").onclick = () => page.play(!page.world.playing);
    $("one").onclick = () => { page.play(false); page.send({ type: "step" }); };
    $("reset").onclick = () => page.send({ type: "reset" });
    $("trained").onclick = () => {
      for (const [name, { trained: value }] of changed(page.world)) page.send({ type: "set", name, value });
      page.brushes.showHint((page.brushes.note = "Physics as trained. New grows a fresh world"));
    };
    $("fold").onclick = () => this.fold(!$("panel").hidden);
    for (const one of [$("rule"), $("choice")])
      one.onchange = () => page.send({ type: "set", name: "rule", value: one.value });
    $("other").onchange = () => page.brushes.showHint();
    $("show").onchange = () => page.send({ type: "set", name: "show", value: $("show").value });
    $("message").onclick = () => ($("message").hidden = true);
    $("snapshot").onclick = () => page.film.snapshot();
    $("record").onclick = () => page.film.record(!page.film.recording);
    $("plots").ontoggle = () => page.send({ type: "set", name: "loss", value: $("plots").open });
    $("tracers").onchange = () => { page.tracers.clear(); page.dirty = true; };
    $("style").onchange = () => (page.dirty = true);
    $("theme").onchange = () => this.showTheme();
    matchMedia("(prefers-color-scheme: dark)").onchange = () => this.showTheme();
    this.showTheme();
    for (const name of ["radius", "strength", "size"]) {
      const input = $(name), output = input.parentElement.querySelector("output");
      input.oninput = () => { output.textContent = short(+input.value); page.dirty = true; };
      input.oninput();
    }
    this.fold(innerWidth <= 760 || innerHeight <= 500);
    this.showPlaying();
    addEventListener("keydown", (event) => this.key(event));
  }

  show(world, before) {
    document.title = `${world.title} · npa-envs`;
    $("title").textContent = world.title;
    $("note").textContent = world.note;
    this.showPlaying();
    for (const one of [$("rule"), $("choice")]) options(one, world.rules, world.rule);
    const other = world.others.includes($("other").value) && before.rule === world.rule
      ? $("other").value : world.others.find((name) => name !== world.rule);
    options($("other"), world.others, other);
    const shows = world.shows.filter((name) => name !== "species" || world.species.length > 1 || name === world.show);
    options($("show"), shows, world.show, WORDS);
    const classes = Array.from({ length: world.class_count }, (_, k) => `${k} ${CLASSES[k % CLASSES.length]}`);
    $("meaning").textContent = world.show === "colours" && classes.length
      ? `Which class each particle takes this for: ${classes.join(", ")}; grey where it is not sure.`
      : MEANINGS[world.show.split(" ")[0]];
    $("rule-field").hidden = $("choice").hidden = world.rules.length < 2;
    $("other-field").hidden = world.others.length < 2 || !world.tools.some(({ takes }) => takes === "rule");
    $("brush").hidden = !world.tools.length;
    this.showBrushes();
    this.page.brushes.showHint();
    $("damage").hidden = !world.damages.length;
    $("damages").replaceChildren(...world.damages.map((name) => make("button", {
      textContent: name, title: `Damage: ${name}`, onclick: () => this.page.send({ type: "damage", name }),
    })));
    $("physics").hidden = !PHYSICS.some((name) => name in world.settings);
    for (const name of ["speed", ...PHYSICS]) {
      $(name).parentElement.hidden = !world.settings[name];
      if (world.settings[name]) this.slider($(name), name, world.settings[name]);
    }
    $("trained").disabled = !changed(world).length;
  }

  fold(away) {
    $("panel").hidden = away;
    this.page.dirty = true;
    $("fold").setAttribute("aria-expanded", String(!away));
  }

  showPlaying() {
    $("play").innerHTML = this.page.world.playing ? icon("pause", "Pause") : icon("play", "Play");
    $("play").setAttribute("aria-pressed", String(this.page.world.playing));
  }

  showTheme() {
    document.documentElement.dataset.theme = $("theme").value;
    const { backgroundColor, color } = getComputedStyle(document.body);
    this.page.background = components(backgroundColor);
    this.page.ink = components(color);
    this.page.dirty = true;
  }

  showBrushes() {
    const { brushes } = this.page, names = brushes.offered.map(({ label }) => label).join();
    if ($("brushes").dataset.names === names) return;
    $("brushes").dataset.names = names;
    $("brushes").replaceChildren(...brushes.offered.map(({ name, label }, k) => {
      const button = make("button", {
        innerHTML: icon(name, label.split(":")[0]), title: `${label} (${(k + 1) % 10})`, onclick: () => brushes.choose(name),
      });
      button.dataset.brush = name;
      button.setAttribute("role", "radio");
      return button;
    }));
    brushes.choose(brushes.chosen.name);
  }

  slider(input, name, { value, low, high, scale, whole }) {
    const bend = scale === "log" ? Math.log : (v) => v, unbend = scale === "log" ? Math.exp : (v) => v;
    const output = input.parentElement.querySelector("output");
    // Rounded to three digits, a value may exceed the range.
    const read = () => Math.min(high, Math.max(low,
      (whole ? Math.round : (v) => +v.toPrecision(3))(unbend(+input.value))));
    input.min = bend(low);
    input.max = bend(high);
    input.step = whole && scale !== "log" ? 1 : (bend(high) - bend(low)) / 200;
    if (document.activeElement !== input || !this.pressing) input.value = bend(value);
    output.textContent = short(value);
    input.onpointerdown = () => (this.pressing = true);
    input.onpointerup = () => (this.pressing = false);
    input.oninput = () => {
      output.textContent = short(read());
      clearTimeout(this.countTimer);
      // Another number of particles restarts the world: sent only once the slider rests.
      const send = () => this.page.send({ type: "set", name, value: read() });
      if (name === "count") this.countTimer = setTimeout(send, 150);
      else send();
    };
  }

  key(event) {
    if (event.target.matches("select, input[type=text]") || event.ctrlKey || event.metaKey) return;
    const acts = {
      " ": () => this.page.play(!this.page.world.playing), s: () => $("one").click(), r: () => $("reset").click(),
      p: () => $("fold").click(), f: () => this.page.fit(),
    };
    const act = acts[event.key] ?? $("brushes").children[(+event.key + 9) % 10]?.onclick;
    if (!act || (event.key === " " && event.target.matches("button, summary"))) return;
    event.preventDefault();
    act();
  }
}

// Pictures and films of the canvas.
class Film {
  constructor(page) {
    this.page = page;
    this.recording = null;
  }

  offer(name, url) {
    const item = make("li"), link = make("a", { href: url, download: name, textContent: name });
    item.append(link);
    $("files").prepend(item);
    $("film").open = true;
    $("writing").hidden = true;
    this.page.controls.fold(false);
    item.scrollIntoView({ block: "center" });
    return link;
  }

  snapshot() {
    this.page.draw({ still: true });
    this.page.canvas.toBlob((blob) => {
      const name = `${this.page.world.title}-${this.page.frame?.step ?? 0}.png`.replace(/[^\w.-]+/g, "-");
      this.offer(name, URL.createObjectURL(blob)).click();
    }, "image/png");
  }

  // Sends pictures to an engine that makes films; else the browser records the canvas.
  record(on) {
    this.showRecording(on);
    $("writing").hidden = on;
    if (!on) {
      $("writing").scrollIntoView({ block: "nearest" });
      this.recording.stop();
      this.recording = null;
    } else if (this.page.world.capabilities.includes("film")) {
      const picture = make("canvas", { width: FILM_SIZE, height: FILM_SIZE });
      this.recording = { picture, last: 0, stop: () => this.page.send({ type: "film", action: "stop" }) };
      this.page.send({ type: "film", action: "start" });
      this.page.dirty = true;
    } else this.recording = recorder(this.page.canvas, (name, url) => this.offer(name, url));
  }

  showRecording(on) {
    $("record").setAttribute("aria-pressed", String(Boolean(on)));
    $("record").textContent = on ? "Stop" : "Record";
  }

  // Ends a recording whose film the engine has ended.
  end() {
    if (!this.recording?.picture) return;
    this.showRecording((this.recording = null));
    $("writing").hidden = false;
  }

  // Adds the canvas to the film, if one is being recorded for the engine.
  add() {
    const { recording, page: { canvas, camera } } = this, now = performance.now();
    if (!recording?.picture || now - recording.last < FILM_PAUSE) return;
    recording.last = now;
    const { picture } = recording, [width, height] = camera.open(canvas.width, canvas.height);
    const side = Math.min(width, height);
    picture.getContext("2d").drawImage(
      canvas, (width - side) / 2, (height - side) / 2, side, side, 0, 0, FILM_SIZE, FILM_SIZE);
    picture.toBlob((blob) => { if (blob) this.page.send(blob); }, "image/jpeg", QUALITY);
  }
}

function recorder(canvas, done) {
  const type = ["video/mp4", "video/webm"].find((format) => MediaRecorder.isTypeSupported(format));
  const chunks = [], media = new MediaRecorder(canvas.captureStream(30), { mimeType: type });
  media.ondataavailable = ({ data }) => chunks.push(data);
  media.onstop = () => done(`film.${type.slice(6)}`, URL.createObjectURL(new Blob(chunks, { type })));
  media.start(500);
  return { stop: () => media.stop() };
}

function options(select, names, chosen, words = {}) {
  if (select.dataset.names !== names.join("\n")) {
    select.dataset.names = names.join("\n");
    select.replaceChildren(...names.map((name) => new Option(words[name] ?? name, name)));
  }
  if (chosen) select.value = chosen;
}

// The settings of the physics that are not those that the rule was trained with.
function changed({ settings }) {
  return Object.entries(settings).filter(([name, { value, trained }]) => PHYSICS.includes(name) && value !== trained);
}

// The components from 0 to 1 of a colour such as "rgb(13, 16, 23)".
function components(colour) {
  return colour.match(/\d+/g).map((component) => component / 255);
}
