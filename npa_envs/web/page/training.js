// The card for pictures of one's own: it takes a dropped or picked file or an emoji, tells how its training goes,
// and offers what was learned. npa_envs/web/messages.py describes its messages and events.

import { make } from "./plots.js";

const ACTIVE = ["reading", "starting", "learning"];
const KINDS = "image/*,.glb,.gltf,.obj,.off,.ply,.stl";
const MINE = "npa-envs training"; // of the tab's storage: the id of the training that it has begun

export class TrainingCard {
  // `send` sends messages to the server; `token` is that of the page's address, or null.
  constructor(send, token) {
    this.send = send;
    this.token = token;
    this.event = null; // the last event "training"
    this.psnr = null; // of the world that is shown [dB]
    this.upload = null; // what was uploaded last, for another try
    this.showing = ""; // the id of the training whose world is shown
    this.stopping = ""; // the id of the training that the user has stopped
    this.open = false;
    this.choosing = false; // whether to choose another one, where one is learned already
    this.refusal = ""; // why the server did not take the last upload
    this.busy = false; // whether it did not because something was being learned
  }

  listen(event) {
    if (event.type === "psnr") this.psnr = event.value;
    else if (event.type === "training") {
      if (!this.card) this.build();
      // A tab learns of a training once, and may then fold the card.
      if (ACTIVE.includes(event.state) && event.id !== this.event?.id) this.open = true;
      this.event = event;
      const mine = sessionStorage.getItem(MINE) === event.id;
      if (event.has_rule && mine && this.showing !== event.id) this.show();
    } else return;
    this.render();
  }

  build() {
    const link = make("link", { rel: "stylesheet", href: "training.css" });
    this.file = make("input", { type: "file", accept: KINDS, hidden: true });
    this.file.onchange = () => { if (this.file.files[0]) this.take(this.file.files[0]); this.file.value = ""; };
    this.card = make("section", { id: "training" });
    this.card.setAttribute("aria-label", "Grow your own picture");
    this.cover = make("div", { id: "drop", hidden: true, textContent: "Drop it: it is learned while you watch" });
    document.head.append(link);
    document.querySelector(".stage").append(this.card, this.cover);
    addEventListener("dragover", (event) => {
      if (!event.dataTransfer.types.includes("Files")) return;
      event.preventDefault();
      this.cover.hidden = false;
    });
    addEventListener("dragleave", (event) => { if (!event.relatedTarget) this.cover.hidden = true; });
    addEventListener("drop", (event) => {
      event.preventDefault();
      this.cover.hidden = true;
      if (event.dataTransfer.files[0]) this.take(event.dataTransfer.files[0]);
    });
    addEventListener("paste", ({ clipboardData }) => {
      if (clipboardData.files[0]) this.take(clipboardData.files[0]);
    });
  }

  // Uploads a file, or an emoji as text. `options` are keywords of the server's `upload`.
  async take(content, options = {}) {
    const name = content.name ?? content;
    Object.assign(this, { upload: content, open: true, choosing: false, refusal: "", busy: false });
    if (typeof content === "string") options.emoji = "1";
    try {
      const mib = (size) => Math.ceil(size / 2 ** 20), { limit } = this.event;
      if (content.size > limit)
        throw Error(`${name} has ${mib(content.size)} MiB, at most ${mib(limit)} are taken: give a smaller file`);
      const answer = await fetch(this.address("training", { name, ...options }), { method: "POST", body: content });
      this.busy = answer.status === 409;
      if (!answer.ok) throw Error(await answer.text());
      sessionStorage.setItem(MINE, (await answer.json()).id);
      this.psnr = null;
    } catch (error) {
      this.refusal = error.message;
    }
    this.render();
  }

  address(path, fields = {}) {
    const query = new URLSearchParams(this.token ? { ...fields, token: this.token } : fields);
    return `${path}?${query}`;
  }

  show() {
    this.showing = this.event.id;
    this.psnr = null;
    this.send({ type: "training", action: "show" });
  }

  leave() {
    sessionStorage.removeItem(MINE);
    this.send({ type: "training", action: "leave" });
    this.change({ showing: "" });
  }

  render() {
    const { event } = this, active = ACTIVE.includes(event.state);
    const learned = event.has_rule && !this.choosing;
    const shown = !this.open ? "closed" : active ? "active" : learned ? "learned" : "empty";
    const parts = { closed: this.closed, active: this.active, learned: this.learned, empty: this.chooser };
    // Not made anew while one types or presses a button, which keeps the focus.
    const same = shown === this.shown && this.problem === this.problemShown;
    if (same && (shown === "empty" || this.card.matches(":active"))) return;
    const { activeElement: focused } = document, inside = this.card.contains(focused);
    this.card.replaceChildren(...parts[shown].call(this));
    const again = [...this.card.querySelectorAll("button, a")].find((one) => one.textContent === focused.textContent);
    if (inside) again?.focus();
    this.shown = shown;
    this.problemShown = this.problem;
    this.card.className = shown;
    // On a phone the card lies above the bar.
    this.card.style.setProperty("--bar", `${document.getElementById("bar").offsetHeight}px`);
  }

  // What went wrong last, for the user.
  get problem() {
    const { refusal, event: { name, state, cure, message } } = this;
    // What was being learned may have ended since.
    if (refusal && (!this.busy || ACTIVE.includes(state))) return refusal;
    if (cure === "whole") return `${name} is opaque and its border has many colours, so there is no part to cut out: ` +
      "give a picture with a transparent background, or grow all of it";
    return state === "failed" ? message : "";
  }

  closed() {
    const { state, name, iteration = 0, total = Infinity, has_rule: learned } = this.event;
    const share = `Learning ${name}: ${Math.floor((100 * iteration) / total)} %`;
    const label = ACTIVE.includes(state) ? share : learned ? name : "Grow your own picture";
    return [button(label, () => this.change({ open: true }))];
  }

  fold() {
    this.change({ open: false, choosing: false });
  }

  // Renders with changed fields.
  change(fields) {
    this.render(Object.assign(this, fields));
  }

  chooser() {
    const emoji = make("input", { type: "text", placeholder: "\u{1F98A}", maxLength: 16, size: 4 });
    emoji.setAttribute("aria-label", "An emoji");
    const typed = () => this.take(emoji.value.trim() || emoji.placeholder);
    emoji.onkeydown = ({ key }) => { if (key === "Enter") typed(); };
    return [
      heading("Grow your own picture", () => this.fold()),
      text("Drop a picture or a 3D file anywhere here. Particles learn it while you watch."),
      row(button("Choose a file", () => this.file.click())),
      row(text("or an emoji"), emoji, button("Grow", typed)),
      ...this.problems(), this.file,
    ];
  }

  active() {
    const { id, name, state, iteration = 0, total, seconds_left: left } = this.event;
    const bar = make("progress", { max: total ?? 1 });
    if (total) bar.value = iteration;
    const words = {
      reading: "Reading the file…", starting: "Starting the training…",
      learning: `Iteration ${iteration} of ${total}${left === undefined ? "" : `, ${duration(left)} left`}`,
    };
    const stop = () => {
      this.send({ type: "training", action: "stop" });
      this.change({ stopping: id });
    };
    const watch = this.showing !== id && this.event.has_rule ? [button("Watch", () => this.show())] : [];
    return [
      heading(`Learning ${name}`, () => this.fold()), bar,
      text(this.stopping === id ? "Stopping; what it has learned is saved…" : words[state]),
      ...(this.event.note ? [text(this.event.note)] : []),
      row(...this.quality(), ...watch, button("Stop", stop)), ...this.problems(),
    ];
  }

  learned() {
    const { id, name, state, folder, seconds, iteration, total } = this.event;
    const stem = name.replace(/\.\w+$/, "");
    const link = (label, file, end) => make("a", {
      textContent: label, href: this.address(`training/${id}/${file}`), download: `${stem}${end}`,
    });
    const how = state === "done" ? `Learned in ${duration(seconds)}` : `Stopped at iteration ${iteration} of ${total}`;
    const watches = this.showing === id;
    return [
      heading(name, () => this.fold()), text(`${how}. Cut it, wipe a part of it.`), ...this.quality(),
      row(link("Save rule", "rule.safetensors", ".safetensors"), link("Save page", "page.html", ".html"),
        watches ? button("Back", () => this.leave()) : button("Watch", () => this.show()),
        button("Another", () => this.change({ choosing: true }))),
      make("p", { className: "path", textContent: `The run is in ${folder}` }), ...this.problems(), this.file,
    ];
  }

  // Loss, and how near the world comes to the picture.
  quality() {
    const { loss } = this.event, parts = [];
    if (loss !== undefined) parts.push(`loss ${loss.toPrecision(3)}`);
    if (this.psnr !== null && this.showing === this.event.id) parts.push(`PSNR ${this.psnr.toFixed(1)} dB`);
    return parts.length ? [text(parts.join(" · "))] : [];
  }

  problems() {
    if (!this.problem) return [];
    const line = make("p", { className: "problem", textContent: this.problem });
    line.setAttribute("role", "alert");
    const retry = !this.refusal && this.event.cure === "whole" && this.upload
      ? [row(button("Grow the whole picture", () => this.take(this.upload, { whole: "1" })))] : [];
    return [line, ...retry];
  }
}

// A time in words.
function duration(seconds) {
  return seconds < 90 ? `${Math.round(seconds)} s` : `${Math.round(seconds / 60)} minutes`;
}

function text(words) {
  return make("p", { textContent: words });
}

function row(...parts) {
  const line = make("div", { className: "row" });
  line.append(...parts);
  return line;
}

function button(label, onclick) {
  return make("button", { textContent: label, onclick });
}

// A title, and a button that folds the card where that is possible.
function heading(words, fold = null) {
  const line = row(make("h2", { textContent: words }));
  if (fold) {
    const close = button("\u00D7", fold);
    close.setAttribute("aria-label", "Fold");
    line.append(close);
  }
  return line;
}
