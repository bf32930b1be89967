// The engine in the page itself: worlds that a worker computes, with no server behind. See page.js.

// Starts the worker whose text stands in the element that `settings.worker` names; the rest of the
// settings is what LiveWorld takes.
export async function connect({ worker: element, ...settings }, listener) {
  const text = document.getElementById(element).textContent;
  const worker = new Worker(URL.createObjectURL(new Blob([text], { type: "text/javascript" })));
  // The worker is a frame ahead; the page gets the next one when it has drawn the one before.
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
      // Frames of a world that is no more.
      if (data.type === "world") ready.splice(0).forEach(drop);
      listener(data);
    }
    pump();
  };
  worker.onerror = (event) => {
    event.preventDefault();
    listener({ type: "error", message: event.message || "this browser does not let the page start a worker" });
  };
  // "?engine=processor" behind the address keeps off the graphics card, "?engine=gpu" insists on it.
  const engine = new URLSearchParams(location.search).get("engine") ?? "auto";
  worker.postMessage({ type: "begin", settings: { ...settings, engine } });
  return {
    send(message) {
      worker.postMessage(message);
      if (message.type !== "drawn") return;
      drawing = false;
      // Never from within a call of the page's own.
      queueMicrotask(pump);
    },
  };
}
