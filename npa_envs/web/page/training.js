// The card for pictures of one's own: it takes a dropped or picked file or an emoji, tells how its training goes,
// and offers what was learned. npa_envs/web/messages.py describes its messages and events.

import { make } from "./plots.js";

const ACTIVE = ["reading", "starting", "learning"];
const KINDS = "image/*,.glb,.gltf,.obj,.off,.ply,.stl";
const FOLDED = { open: false, choosing: false };
const MINE = "npa-envs training"; // of the tab's storage: the id of the training that it has begun

export class TrainingCard {
  // `send` sends messages to the server.
  constructor(send) {
    this.send = send;
    this.event = null; // the last event "training"
    this.psnr = null; // of the world that is shown [dB]
    this.upload = null; // what the server took last, for another try
    this.showing = ""; // the id of the training whose world is shown
    this.stopping = ""; // the id of the training that the user has stopped
    this.open = false;
    this.choosing = false; // whether to choose another one, where one is learned already
    this.refusal = ""; // why the server did not take the last upload
    this.busy = false; // whether it did not because something was being learned
  }

  listen(event) {
    if (event.type === "psnr") return this.change({ psnr: event.value });
    if (event.type !== "training") return;
    if (!this.card) this.build();
    // A tab learns of a training once, and may then fold the card.
    if (ACTIVE.includes(event.state) && event.id !== this.event?.id)
      Object.assign(this, { open: true, choosing: false });
    this.event = event;
    const mine = sessionStorage.getItem(MINE) === event.id;
    if (event.has_rule && mine && this.showing !== event.id) this.show();
    this.render();
  }

  build() {
    this.file = make("input", { type: "file", accept: KINDS, hidden: true });
    this.file.onchange = () => { if (this.file.files[0]) this.take(this.file.files[0]); this.file.value = ""; };
    this.card = make("section", { id: "training" });
    this.card.setAttribute("aria-label", "Grow your own picture");
    this.cover = make("div", { id: "drop", hidden: true, textContent: "Drop it: it is learned while you watch" });
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
    addEventListener("keydown", ({ key }) => { if (key === "Escape") this.change(FOLDED); });
    addEventListener("paste", ({ clipboardData }) => {
      if (clipboardData.files[0]) this.take(clipboardData.files[0]);
    });
  }

  // Uploads a file, or an emoji as text. `options` are keywords of the server's `upload`.
  async take(content, options = {}) {
    const name = content.name ?? content;
    Object.assign(this, { open: true, choosing: false, refusal: "", busy: false });
    if (typeof content === "string") options.emoji = "1";
    try {
      const mib = (size) => Math.ceil(size / 2 ** 20), { limit } = this.event;
      if (content.size > limit)
        throw Error(`${name} has ${mib(content.size)} MiB, at most ${mib(limit)} are taken: give a smaller file`);
      const answer = await fetch(addressOf("training", { name, ...options }), { method: "POST", body: content });
      this.busy = answer.status === 409;
      if (!answer.ok) throw Error(await answer.text());
      sessionStorage.setItem(MINE, (await answer.json()).id);
      Object.assign(this, { upload: content, psnr: null });
    } catch (error) {
      this.refusal = error.message;
    }
    this.render();
  }

  // Opens the card, and lets the page show the world of the training.
  show() {
    const { event: { id }, psnr } = this, shown = this.showing === id;
    if (!shown) this.send({ type: "training", action: "show" });
    this.change({ showing: id, psnr: shown ? psnr : null, open: true, choosing: false });
  }

  leave() {
    sessionStorage.removeItem(MINE);
    this.send({ type: "training", action: "leave" });
    this.change({ showing: "" });
  }

  render() {
    const { event, card } = this, learned = event.has_rule && !this.choosing;
    const shown = !this.open ? "closed" : ACTIVE.includes(event.state) ? "active" : learned ? "learned" : "empty";
    // Not made anew while one types or presses a button, which keeps the focus.
    const content = shown + this.problem;
    if (content === this.content && (shown === "empty" || card.matches(":active"))) return;
    this.content = content;
    const { activeElement: focused } = document, inside = card.contains(focused);
    card.replaceChildren(...this[shown](), ...(this.open ? this.problems() : []), this.file);
    const again = [...card.querySelectorAll("button, a")].find((one) => one.textContent === focused.textContent);
    if (inside) again?.focus();
    card.className = shown;
    document.page.dirty = true; // The card covers another part of the world.
  }

  // Renders with changed fields.
  change(fields) {
    this.render(Object.assign(this, fields));
  }

  // What went wrong last, for the user.
  get problem() {
    const { refusal, event: { name, state, cure, message, refused = name } } = this;
    // What was being learned may have ended since.
    if (refusal && (!this.busy || ACTIVE.includes(state))) return refusal;
    if (cure === "whole") return `${refused} is opaque and its border has many colours, so there is no part to cut out: ` +
      "give a picture with a transparent background, or grow all of it";
    return message ?? "";
  }

  closed() {
    const { id, state, name, has_rule, iteration = 0, total = Infinity } = this.event, active = ACTIVE.includes(state);
    const watch = !active && has_rule && this.showing !== id ? [button(`Watch ${name}`, () => this.show())] : [];
    const share = `Learning ${name}: ${Math.floor((100 * iteration) / total)} %`;
    const open = () => this.change({ open: true, choosing: !active });
    return [button(active ? share : "Grow your own picture", open), ...watch];
  }

  empty() {
    const emoji = make("input", { type: "text", placeholder: "\u{1F98A}", maxLength: 16, size: 4 });
    emoji.setAttribute("aria-label", "An emoji");
    const typed = () => this.take(emoji.value.trim() || emoji.placeholder);
    emoji.onkeydown = ({ key }) => { if (key === "Enter") typed(); };
    return [
      this.heading("Grow your own picture"),
      text("Choose or drop a picture or a 3D file. Particles learn it while you watch."),
      row(button("Choose a file", () => this.file.click())),
      row(text("or an emoji"), emoji, button("Grow", typed)),
      ...(this.event.has_rule ? [row(button(`Watch ${this.event.name}`, () => this.show()))] : []),
    ];
  }

  active() {
    const { id, name, note, state, iteration = 0, total, has_rule, expected, seconds_left: left } = this.event;
    const bar = make("progress", { max: total ?? 1 });
    if (total) bar.value = iteration;
    const guess = expected ? `, about ${duration(expected)} on an idle CPU` : "";
    const words = {
      reading: "Reading the file…", starting: `Starting the training${guess}…`,
      learning: `Iteration ${iteration} of ${total}${left === undefined ? guess : `, ${duration(left)} left`}`,
    };
    const unlearned = state === "learning" && iteration < total / 50 ? "The rule has learned next to nothing yet." : "";
    const stopping = this.stopping === id, stop = button("Stop", () => {
      this.send({ type: "training", action: "stop" });
      this.change({ stopping: id });
    });
    return [
      this.heading(`Learning ${name}`), bar, ...this.target(),
      text(stopping ? "Stopping; what it has learned is saved…" : words[state]), text(unlearned), text(note),
      row(this.quality(), ...(has_rule && this.showing !== id ? [this.watch()] : []), ...(stopping ? [] : [stop])),
    ];
  }

  learned() {
    const { id, name, state, folder, seconds, iteration, total, preset } = this.event;
    const stem = name.replace(/\.\w+$/, "");
    const link = (label, file, end) => make("a", {
      textContent: label, href: addressOf(`training/${id}/${file}`), download: `${stem}${end}`,
    });
    const how = state === "done" ? `Learned in ${duration(seconds)}` : `Stopped at iteration ${iteration} of ${total}`;
    const finished = preset === "best" ? " Cut it, wipe a part of it." : " Cut it, wipe a part of it: it heals in part.";
    const watched = this.showing === id, hint = state === "done" && watched ? finished : "";
    return [
      this.heading(watched ? name : `Your ${name}`), ...this.target(), text(`${how}.${hint}`), watched ? this.quality() : "",
      row(link("Save rule", "rule.safetensors", ".safetensors"), link("Save page", "page.html", ".html"),
        watched ? button("Back", () => this.leave()) : this.watch(),
        button("Another", () => this.change({ choosing: true }))),
      make("p", { className: "path", textContent: `The run is in ${folder}` }),
    ];
  }

  // A title, and a button that folds the card.
  heading(words) {
    const close = button("\u00D7", () => this.change(FOLDED));
    close.setAttribute("aria-label", "Fold");
    return row(make("h2", { textContent: words }), close);
  }

  // The picture that is learned, made once: it must not flicker.
  target() {
    const { id, picture } = this.event;
    if (!picture) return [];
    const src = addressOf(`training/${id}/${picture}`).href;
    if (this.image?.src !== src) this.image = make("img", { src, alt: "The picture that is learned" });
    return [this.image];
  }

  watch() {
    return button("Watch", () => this.show());
  }

  // The training's loss, and how near the world comes to the picture.
  quality() {
    const { loss, id } = this.event, parts = [];
    if (loss !== undefined) parts.push(`Loss\u00a0${loss.toPrecision(3)}`);
    if (this.psnr !== null && this.showing === id) parts.push(`PSNR\u00a0${this.psnr.toFixed(1)}\u00a0dB`);
    return text(parts.join(" · "));
  }

  problems() {
    const { problem, upload } = this;
    if (!problem) return [];
    const line = make("p", { className: "problem", textContent: problem });
    line.setAttribute("role", "alert");
    const cured = problem !== this.refusal && this.event.cure === "whole" && upload;
    return cured ? [line, row(button("Grow the whole picture", () => this.take(upload, { whole: "1" })))] : [line];
  }
}

// The address of a part of the server, with the token of the page's address.
export function addressOf(path, fields = {}) {
  const address = new URL(path, location.href), token = new URLSearchParams(location.search).get("token");
  address.search = new URLSearchParams(token ? { ...fields, token } : fields);
  return address;
}

// A time in words.
function duration(seconds) {
  return seconds < 90 ? `${Math.round(seconds)} s` : `${Math.round(seconds / 60)} minutes`;
}

function text(words) {
  return make("p", { textContent: words });
}

function row(...parts) {
  const line = make("div", { className: "buttons" });
  line.append(...parts);
  return line;
}

function button(label, onclick) {
  return make("button", { textContent: label, onclick });
}
