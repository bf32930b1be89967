// The engine of an exported page: a worker in the page, which runs the RuleWorld of rule_world.js. Also the gallery
// to choose a rule. npa_envs/web/export.py joins this file and its imports into one script.

import { start } from "./page.js";

// Starts the worker with the code in the element `worker`; the settings are those of RuleWorld.
async function connect(settings, listener) {
  const text = document.getElementById("worker").textContent;
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
  // "?engine=processor" in the address avoids the GPU, "?engine=gpu" always uses it.
  const engine = new URLSearchParams(location.search).get("engine") ?? "auto";
  worker.postMessage({ type: "begin", settings: { ...settings, engine, code: text } });
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

// Starts the page with the settings in its element `rules`. In a page with a gallery the address decides:
// "#gecko" shows that rule's world, without a name all pictures are shown.
export function begin() {
  const settings = JSON.parse(document.getElementById("rules").textContent);
  const gallery = document.getElementById("gallery");
  if (gallery === null) return start(connect, settings);
  let page = null;
  const show = async () => {
    const name = decodeURIComponent(location.hash.slice(1));
    const chosen = settings.rules.find((rule) => rule.name === name);
    document.querySelector("main").hidden = document.getElementById("back").hidden = chosen === undefined;
    gallery.hidden = chosen !== undefined;
    if (chosen === undefined) {
      page?.play(false);
    } else if (page === null) {
      const others = settings.rules.filter((rule) => rule !== chosen);
      page = await start(connect, { ...settings, rules: [chosen, ...others] });
    } else {
      // Setting the rule announces whether the world runs.
      page.play(true);
      page.send({ type: "set", name: "rule", value: name });
    }
  };
  addEventListener("hashchange", show);
  return show();
}
