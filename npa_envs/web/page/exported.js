// The engine of the exported page, a worker in the page, and a gallery to choose a rule. See page.js.

import { start } from "./page.js";

// Starts the worker with the code in the element `settings.worker`; the other settings are those of
// LiveWorld.
async function connect({ worker: element, ...settings }, listener) {
  const text = document.getElementById(element).textContent;
  const worker = new Worker(URL.createObjectURL(new Blob([text], { type: "text/javascript" })));
  // The worker computes a frame ahead; the page gets it when it has drawn the frame before.
  const ready = [];
  let drawing = false;
  const pump = () => {
    if (drawing || ready.length === 0) return;
    drawing = true;
    listener(ready.shift());
  };
  const drop = () => worker.postMessage({ type: "drawn" });
  worker.onmessage = ({ data }) => {
    if (data.type === "frame") ready.push(data);
    else {
      // Drops the frames of the former world.
      if (data.type === "world") ready.splice(0).forEach(drop);
      listener(data);
    }
    pump();
  };
  worker.onerror = (event) => {
    event.preventDefault();
    listener({ type: "error", message: event.message || "this browser does not let the page start a worker" });
  };
  // "?engine=processor" in the address avoids the graphics card, "?engine=gpu" always uses it.
  const engine = new URLSearchParams(location.search).get("engine") ?? "auto";
  worker.postMessage({ type: "begin", settings: { ...settings, engine } });
  return {
    send(message) {
      worker.postMessage(message);
      if (message.type !== "drawn") return;
      drawing = false;
      // Later, not within this call of the page.
      queueMicrotask(pump);
    },
  };
}

// Starts the page with the settings in its element `rules`.
export function begin() {
  const settings = JSON.parse(document.getElementById("rules").textContent);
  const pictured = settings.rules.filter((rule) => rule.preview);
  if (pictured.length === 0) start(connect, settings);
  else new Gallery(settings, pictured);
}

// The address decides: "#gecko" shows that rule's world, without a name all pictures are shown.
class Gallery {
  constructor(settings, pictured) {
    this.settings = settings;
    this.page = null;
    this.stage = document.querySelector("main");
    this.grid = document.createElement("section");
    this.grid.id = "gallery";
    const title = document.createElement("h1");
    title.textContent = document.title;
    const hint = document.createElement("p");
    hint.textContent =
      "Small neural networks, one in every particle. Choose one, watch it grow, then remove a part of it.";
    const list = document.createElement("ul");
    for (const { name, preview } of pictured) {
      const item = document.createElement("li"), link = document.createElement("a");
      const picture = new Image(), caption = document.createElement("span");
      Object.assign(picture, { src: preview, alt: "" });
      caption.textContent = name;
      link.href = `#${encodeURIComponent(name)}`;
      link.append(picture, caption);
      item.append(link);
      list.append(item);
    }
    this.grid.append(title, hint, list);
    this.back = document.createElement("a");
    Object.assign(this.back, { id: "back", href: "#", textContent: "All rules" });
    document.body.append(this.grid, this.back);
    addEventListener("hashchange", () => this.show());
    this.show();
  }

  async show() {
    const wanted = decodeURIComponent(location.hash.slice(1));
    const chosen = this.settings.rules.find(({ name }) => name === wanted);
    this.stage.hidden = this.back.hidden = chosen === undefined;
    this.grid.hidden = chosen !== undefined;
    if (chosen === undefined) {
      this.page?.play(false);
    } else if (this.page === null) {
      const others = this.settings.rules.filter((rule) => rule !== chosen);
      this.page = await start(connect, { ...this.settings, rules: [chosen, ...others] });
    } else {
      // Setting the rule announces whether the world runs.
      this.page.play(true);
      this.page.send({ type: "set", name: "rule", value: chosen.name });
    }
  }
}
