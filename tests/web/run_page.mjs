// Runs the page without a browser, over stubs of a browser's interfaces: `node run_page.mjs FOLDER SCRIPT`
// prints as JSON what the script returns. Its names: page; sent, the messages of the page to its engine;
// listen, which hands the page an event; tick, a frame of the screen; element, by its id.

import { pathToFileURL } from "node:url";

function makeElement() {
  const element = {
    dataset: {}, style: {}, children: [], value: "0.1", hidden: false, open: false, checked: false, textContent: "",
    classList: { add() {}, remove() {}, toggle() {} }, clientWidth: 100, clientHeight: 100, offsetTop: 80,
    width: 100, height: 100, setAttribute() {}, remove() {}, addEventListener() {},
    getBoundingClientRect: () => ({ left: 0, top: 0 }), setPointerCapture() {}, scrollIntoView() {},
    append: (...added) => element.children.push(...added),
    prepend: (...added) => element.children.unshift(...added),
    replaceChildren: (...added) => (element.children = added),
    querySelector: makeElement, getContext: () => new Proxy({}, { get: () => () => null, set: () => true }),
    toBlob: (take) => take(new Blob(["x"])),
    get parentElement() { return makeElement(); },
  };
  return element;
}

const elements = {};
const element = (name) => (elements[name] ??= makeElement());
let waiting = [];
Object.assign(globalThis, {
  document: {
    getElementById: element, createElement: makeElement, documentElement: makeElement(), body: makeElement(),
    activeElement: null, querySelectorAll: () => [],
  },
  window: globalThis, location: { search: "?painter=canvas" }, innerWidth: 1000, innerHeight: 900, devicePixelRatio: 1,
  getComputedStyle: () => ({ backgroundColor: "rgb(0, 0, 0)", color: "rgb(0, 0, 0)" }), matchMedia: () => ({}), addEventListener() {},
  ResizeObserver: class { observe() {} }, Option: class {},
  requestAnimationFrame: (act) => waiting.push(act),
});
const tick = () => waiting.splice(0).forEach((act) => act());

const [folder, script] = process.argv.slice(2);
const { start } = await import(pathToFileURL(`${folder}/page.js`));
const sent = [];
let listen;
const connect = async (_, listener) => {
  listen = listener;
  return { send: (message) => sent.push(message) };
};
const page = await start(connect, {});
page.painter = { draw() {} };
const result = new Function("page", "sent", "listen", "tick", "element", script)(page, sent, listen, tick, element);
process.stdout.write(JSON.stringify(result));
process.exit();
