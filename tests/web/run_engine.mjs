// Runs modules of the exported page: answers each line of JSON from the standard input with one of JSON.
// Floats travel as base64 of little-endian float32.

import { createInterface } from "node:readline";
import { pathToFileURL } from "node:url";

const folder = process.argv[2];
const load = (name) => import(pathToFileURL(`${folder}/${name}`));
const { Physics, padded, plainKernels, prepareRule } = await load("physics.js");
const { simdKernels } = await load("kernels_simd.js");
const { RuleWorld, serve } = await load("rule_world.js");
const { Colouring } = await load("colours.js");

const floats = (text) => new Float32Array(Uint8Array.from(Buffer.from(text, "base64")).buffer);
const text = (array) => Buffer.from(array.buffer, array.byteOffset, array.byteLength).toString("base64");

// Makes helpers of live worlds, in this process, of a processor with so many threads; `asked` counts what they are asked.
function startHelpers(threads, fail) {
  const helpers = { asked: 0 };
  Object.defineProperty(globalThis, "navigator", { value: { hardwareConcurrency: threads }, configurable: true });
  globalThis.Worker = class {
    constructor() {
      this.scope = { postMessage: (data) => this.onmessage({ data: structuredClone(data) }) };
      serve(this.scope);
    }

    postMessage(message) {
      helpers.asked++;
      const data = structuredClone(message);
      queueMicrotask(() => (fail ? this.onerror({ preventDefault() {} }) : this.scope.onmessage({ data })));
    }
  };
  return helpers;
}

const acts = {
  // One step of rules with given masks.
  step({ rules, kernels: kind, x, s, species, mask, eps, box, noise, densityCounts = null }) {
    const { state_dim: channels, space_dim: dimension } = rules[0];
    const kernels = kind === "simd" ? simdKernels(padded(channels), dimension) : plainKernels();
    const prepared = rules.map((rule) => {
      const weights = Object.fromEntries(Object.entries(rule.weights).map(([name, data]) => [name, floats(data)]));
      return prepareRule({ ...rule, weights }, kernels);
    });
    const world = { x: floats(x), s: floats(s), species: Uint8Array.from(species), count: species.length };
    const physics = new Physics(prepared, world.count, kernels);
    physics.step(world, {
      eps, box, densityCounts, mask: mask && Uint8Array.from(mask), noise: noise && floats(noise),
    });
    return { x: text(world.x), s: text(world.s), kernels: kernels.name };
  },

  // Principal components of states, frame after frame.
  components({ channels, frames, constants }) {
    const colouring = new Colouring({}, constants);
    return frames.map((s) => {
      const bytes = new Uint8ClampedArray((3 * floats(s).length) / channels);
      colouring.components(floats(s), channels, bytes);
      return [...bytes];
    });
  },

  // A live world: what it sends on messages and on going on.
  async live({ settings, script, threads = 1, fail = false }) {
    const helpers = startHelpers(threads, fail);
    const events = [];
    const errors = [];
    const live = new RuleWorld(settings, (event) => events.push(event));
    for (const message of script) {
      if (message.type === "advance") {
        await live.advance();
        live.undrawn = 0;
        continue;
      }
      try {
        await live.receive(message);
      } catch (error) {
        errors.push(error.message);
      }
    }
    return {
      errors,
      asked: helpers.asked,
      events: events.map((event) =>
        event.type === "frame" ? { ...event, positions: text(event.positions), colours: [...event.colours] } : event,
      ),
      x: text(live.world.x), s: text(live.world.s), species: [...live.world.species], updated: [...live.updated],
      travelled: text(live.travelled),
    };
  },
};

for await (const line of createInterface({ input: process.stdin })) {
  const { act, ...fields } = JSON.parse(line);
  let answer;
  try {
    answer = await acts[act](fields);
  } catch (error) {
    answer = { failed: error.stack };
  }
  process.stdout.write(`${JSON.stringify(answer)}\n`);
}
