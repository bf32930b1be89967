// The world of an exported page, which follows RuleWorld of npa_envs/web/rule_world.py. npa_envs/web/messages.py has
// its messages and events.

import { clump, cut, cutAlong, wipeState, inject, insideBall, push, scatter, stateAround } from "./brushes.js";
import { Colouring, RuleColours } from "./colours.js";
import { fastestKernels } from "./kernels_simd.js";
import { numbersBelow, padded, Physics, prepareRule, wrap } from "./physics.js";
import { GpuPhysics, openDevice } from "./physics_gpu.js";

// Maximum number of frames that the page has not drawn yet: the world waits for a slow or hidden page.
const FRAMES_AHEAD = 2;

// The number of steps in which the GPU is compared with the CPU, how many times as fast it needs no more of them, and the
// largest difference of right results.
const TRIAL_STEPS = 4;
const CLEARLY_FASTER = 4;
const TRIAL_TOLERANCE = 1e-3;

// What brushes do, by the names of `BRUSHES` of npa_envs/web/messages.py: functions of a RuleWorld and a message
// "brush", whose `strength` has become an `amount`. tests/web/test_export.py compares them with RuleWorld's:
// test_brushes_of_a_page_are_those_of_the_viewer.
const BRUSHES = {
  wipe: ({ world }, { at, radius }) => wipeState(world, at, radius),
  noise: ({ world, random }, { at, radius, amount }) =>
    scatter(world, at, radius, random.normals(world.x.length, amount * radius)),
  remove(live, { at, radius }) {
    const removed = new Set(insideBall(live.world, at, radius));
    if (removed.size === 0) return;
    const { x, s, species } = live.world;
    const others = (array, width) => array.filter((_, k) => !removed.has(Math.floor(k / width)));
    live.setParticles(others(x, live.dimension), others(s, live.channels), others(species, 1));
  },
  push: ({ world }, { at, move, radius, amount }) => push(world, at, move, radius, amount),
  clump: ({ world }, { at, radius, amount }) => clump(world, at, radius, amount),
  cut: ({ world }, { at, move, radius, view }) => cutAlong(world, at, move, radius, view ?? [0, 0, 1]),
  inject({ world }, { at, radius, amount, source }) {
    const state = stateAround(world, source ?? at, radius);
    if (state !== null) inject(world, at, radius, state, amount);
  },
  graft(live, { at, radius, rule }) {
    const index = live.speciesOf(rule, live.seedCount);
    for (const i of insideBall(live.world, at, radius)) live.world.species[i] = index;
  },
  add(live, { at, radius, amount, rule }) {
    const { world: { x, s, species }, dimension } = live;
    const count = Math.max(live.constants.MIN_SEED, Math.round(amount * live.seedCount));
    const room = (live.rule.world.settings.count?.high ?? live.seedCount) - live.world.count;
    if (count > room) throw Error(`the world has room for ${Math.max(0, room)} particles more, got ${count}`);
    // A new species divides densities by its own number of particles, as in a world of its own.
    const index = live.speciesOf(rule, count);
    const ball = live.random.ball(count, dimension, radius);
    for (let k = 0; k < ball.length; k++) ball[k] += at[k % dimension];
    live.setParticles(
      joined(x, ball),
      joined(s, new Float32Array(count * live.channels)),
      joined(species, new Uint8Array(count).fill(index)),
    );
  },
};

// What the kinds of damage do, as `damage_worlds` of npa_envs/tasks/damage.py: functions of a RuleWorld, the kind's
// size [length units], and the position of a random particle. tests/web/test_export.py checks how far particles move.
const DAMAGES = {
  wipe: ({ world }, size, centre) => wipeState(world, centre, size),
  cut: ({ world, random }, size) => cut(world, meanOf(world), random.direction(world.dimension), size),
  clump: ({ world, constants }, size, centre) => clump(world, centre, size, constants.CLUMP_FACTOR),
  noise: ({ world: { x }, random }, size) => random.normals(x.length, size).forEach((offset, k) => (x[k] += offset)),
};

// Helpers are workers that advance parts of a world of at least so many particles: half of the processor's threads,
// less this worker, at most so many.
const MIN_SHARED = 2048;
const MAX_HELPERS = 3;

// Starts helpers that run `code`; none without it, or where the browser does not let a worker start others.
function startHelpers(code) {
  if (!code) return [];
  try {
    const address = URL.createObjectURL(new Blob([code], { type: "text/javascript" }));
    const count = Math.min(MAX_HELPERS, (navigator.hardwareConcurrency >> 1) - 1);
    return numbersBelow(Math.max(0, count)).map(() => new Worker(address));
  } catch {
    return [];
  }
}

// Physics of rules with weights prepared, by the fastest kernels.
function makePhysics(rules, capacity, periodic) {
  const kernels = fastestKernels(padded(rules[0].state_dim), rules[0].space_dim, periodic);
  return new Physics(rules.map((rule) => prepareRule(rule, kernels)), capacity, kernels);
}

export class RuleWorld {
  // settings: {rules, seed, colours, constants} as npa_envs/web/export.py writes them; the first rule is shown
  // first. send(event, transferred) sends an event to the page; device: a GPU, or null.
  // settings.engine: "auto" uses the GPU if it is faster, "gpu" always. settings.code: what helpers run, if any may.
  constructor(settings, send, device = null) {
    this.device = device;
    this.engine = settings.engine ?? "auto";
    this.rules = settings.rules.map(decoded);
    this.colourTables = mapped(settings.colours, bytesOf);
    this.constants = settings.constants;
    this.send = send;
    this.helpers = startHelpers(settings.code);
    this.playing = true;
    this.changed = false;
    this.undrawn = 0;
    this.show = "colours";
    this.seed = settings.seed;
    this.choose(this.rules[0]);
  }

  // Chooses a rule with the settings of its task, and starts a new world.
  choose(rule) {
    this.rule = rule;
    this.dimension = rule.space_dim;
    this.channels = rule.state_dim;
    this.box = rule.world.box;
    this.values = mapped(rule.world.settings, ({ value }) => value);
    this.values.count ??= rule.world.count;
    if (!rule.world.shows.includes(this.show)) this.show = "colours";
    this.reset(this.seed);
  }

  // Starts a new world whose particles all follow the chosen rule.
  reset(seed) {
    this.seed = seed;
    this.random = new Random(seed);
    this.steps = this.milliseconds = 0;
    this.species = [this.rule];
    // Each species divides densities by the particles of a newly seeded world: particles that a brush adds or
    // removes change only the densities around them.
    this.seedCount = this.values.count;
    this.densityCounts = [this.seedCount];
    this.colouring = new Colouring(this.colourTables, this.constants);
    this.setParticles(this.seedPositions(), new Float32Array(this.seedCount * this.channels), new Uint8Array(this.seedCount));
    this.prepare();
    this.announce();
  }

  // Returns positions of a newly seeded world [length units].
  seedPositions() {
    const { seed } = this.rule.world;
    if (seed.kind === "ball") return this.random.ball(this.seedCount, this.dimension, seed.radius);
    if (seed.kind === "box") return this.random.box(this.seedCount, this.box);
    return seed.clouds[this.random.below(seed.clouds.length)].slice();
  }

  // Replaces the particles of the world.
  setParticles(x, s, species) {
    const count = species.length, { dimension, channels, box } = this;
    this.world = { count, x, s, species, dimension, channels, box };
    // Each particle's path in the last step over the longest possible one, and whether it was updated.
    this.travelled = new Float32Array(count);
    this.updated = new Uint8Array(count);
    if (this.physics !== undefined && count > this.physics.capacity) this.prepare();
  }

  // Allocates memory for the present particles, and prepares the weights of the present species.
  prepare() {
    this.physics = makePhysics(this.species, this.world.count, this.box !== null);
    const kernels = (this.kernels = this.physics.kernels);
    this.helpersKnow = false;
    this.ruleColours = this.species.map((rule) => new RuleColours(rule, kernels, this.constants.COLOUR_OFFSET));
    this.gpu?.close();
    this.gpu = null;
    // Steps that are left of the trial, and the shortest time of a step on each [ms].
    this.trial = { left: this.engine === "gpu" ? 0 : TRIAL_STEPS, cpu: Infinity, gpu: Infinity };
  }

  // Makes a step of the physics, on the GPU if it is faster and its results are right.
  async compute(options) {
    const { world, physics, trial } = this;
    if (this.device === null) return this.share(options);
    try {
      this.gpu ??= await GpuPhysics.make(this.device, physics);
      if (trial.left === 0) return await this.gpu.step(world, options);
    } catch {
      this.leaveGpu();
      return this.share(options);
    }
    const other = { ...world, x: world.x.slice(), s: world.s.slice() };
    const started = performance.now();
    await this.share(options);
    const between = performance.now();
    const agrees = await this.gpu.step(other, options).then(() => alike(world, other), () => false);
    trial.cpu = Math.min(trial.cpu, between - started);
    trial.gpu = Math.min(trial.gpu, performance.now() - between);
    trial.left = trial.cpu > CLEARLY_FASTER * trial.gpu ? 0 : trial.left - 1;
    if (!agrees || (trial.left === 0 && trial.gpu > trial.cpu)) this.leaveGpu();
  }

  // Makes a step on the processor. Pages from a disk may not share memory: helpers get a copy of the world, and return
  // the particles of their parts.
  async share({ eps, box, noise, ...options }) {
    const { world, physics, helpers } = this;
    const parts = 1 + (this.kernels.name === "WebAssembly" && world.count >= MIN_SHARED ? helpers.length : 0);
    const begin = this.helpersKnow ? null : { rules: this.species, capacity: physics.capacity };
    const replies = helpers.slice(0, parts - 1).map((helper, k) => new Promise((resolve) => {
      helper.onmessage = ({ data }) => resolve(data);
      helper.onerror = (event) => {
        event.preventDefault();
        resolve(null);
      };
      helper.postMessage({ type: "share", begin, world, options: { ...options, eps, box }, part: k + 1, parts });
    }));
    if (parts > 1) this.helpersKnow = true;
    physics.sort(world, eps, box);
    physics.advancePart(world, options, 0, parts);
    for (const [k, values] of (await Promise.all(replies)).entries()) {
      if (values !== null) physics.exchange(world, k + 1, parts, values);
      else {
        physics.advancePart(world, options, k + 1, parts);
        this.helpers = [];
      }
    }
    physics.finish(world, noise, box);
  }

  leaveGpu() {
    this.gpu?.close();
    this.gpu = this.device = null;
  }

  async step() {
    const started = performance.now();
    const { world, random, values, dimension, box, updated, densityCounts, values: { eps } } = this;
    if (world.count > 0) {
      const before = world.x.slice();
      for (let i = 0; i < world.count; i++) updated[i] = random.uniform() < values.update_prob ? 1 : 0;
      const noise = values.noise > 0 ? random.normals(world.x.length, values.noise) : null;
      await this.compute({ eps, box, mask: updated, noise, densityCounts });
      const longest = eps * Math.max(...this.species.map((rule) => rule.alpha));
      for (let i = 0; i < world.count; i++) {
        let square = 0;
        for (let d = 0; d < dimension; d++) {
          let difference = world.x[i * dimension + d] - before[i * dimension + d];
          if (box !== null) difference -= box[d] * Math.round(difference / box[d]);
          square += difference * difference;
        }
        this.travelled[i] = Math.sqrt(square) / longest;
      }
    }
    this.steps++;
    const taken = performance.now() - started;
    this.milliseconds += (this.milliseconds > 0 ? 0.2 : 1) * (taken - this.milliseconds);
  }

  // Applies a message of the page.
  async receive(message) {
    const acts = {
      drawn: () => (this.undrawn = Math.max(0, this.undrawn - 1)),
      play: () => (this.playing = Boolean(message.on)),
      step: () => {
        this.playing = false;
        return this.step();
      },
      reset: () => this.reset(message.seed ?? this.seed + 1),
      set: () => this.set(message.name, message.value),
      brush: () => this.brush(message),
      damage: () => this.damage(message.name),
    };
    await entry(acts, message.type, "message")();
    if (message.type !== "drawn" && message.type !== "play") this.changed = true;
  }

  set(name, value) {
    if (name === "loss") return;
    if (name === "rule") return this.choose(named(this.rules, value, "rule"));
    if (name === "show") {
      if (!this.rule.world.shows.includes(value)) throw Error(`nothing to show is called ${value}`);
      this.show = value;
      return this.announce();
    }
    const range = entry(this.rule.world.settings, name, "setting");
    if (!(value >= range.low && value <= range.high)) {
      const [low, high] = [range.low, range.high].map((end) => +end.toPrecision(3));
      throw Error(`${name} must lie in [${low}, ${high}], got ${value}`);
    }
    this.values[name] = value;
    if (name === "count") this.reset(this.seed);
    else this.announce();
  }

  // Applies a message "brush".
  brush(message) {
    const brush = named(this.rule.world.tools, message.tool, "brush");
    const [least, added] = brush.amounts;
    BRUSHES[brush.name](this, { ...message, amount: Math.min(1, least + added * message.strength) });
    this.wrapPositions();
  }

  // Returns the index of a rule's species; a rule that is new in the world is appended.
  speciesOf(name, densityCount) {
    const rule = named(this.rules, name, "rule");
    const index = this.species.indexOf(rule);
    if (index >= 0) return index;
    if (!this.mayJoin(rule)) {
      const fields = this.constants.AGREEMENTS.join(", ");
      throw Error(`${name} cannot live in a world of ${this.rule.name}: rules of one world must agree in ${fields}`);
    }
    this.species.push(rule);
    this.densityCounts.push(densityCount);
    this.prepare();
    this.announce();
    return this.species.length - 1;
  }

  mayJoin(rule) {
    return this.constants.AGREEMENTS.every((field) => rule[field] === this.rule[field]);
  }

  // Damages the world at a random particle, or through the middle at a random angle. name: of DAMAGES.
  damage(name) {
    const apply = entry(DAMAGES, name, "damage");
    const { dimension, world: { x, count } } = this;
    if (count === 0) return;
    const particle = this.random.below(count);
    const centre = x.slice(particle * dimension, (particle + 1) * dimension);
    apply(this, this.constants.DAMAGE_SIZES[name], centre);
    this.wrapPositions();
  }

  // Moves particles that have left a periodic box back into it.
  wrapPositions() {
    if (this.box !== null) wrap(this.world.x, this.world.count, this.box);
  }

  // Whether there is a new frame to show, and the page is ready for it.
  get pending() {
    return (this.playing || this.changed) && this.undrawn < FRAMES_AHEAD;
  }

  // Runs to the next frame unless the world is paused, and sends the frame.
  async advance() {
    if (this.playing) for (let k = 0; k < this.values.speed; k++) await this.step();
    const positions = this.world.x.slice();
    const colours = this.colouring.of(this, this.show);
    const { steps: step, milliseconds } = this;
    const engine = this.gpu !== null && this.trial.left === 0 ? "WebGPU" : this.kernels.name;
    this.undrawn++;
    this.changed = false;
    this.send({ type: "frame", step, positions, colours, milliseconds, engine }, [positions.buffer, colours.buffer]);
  }

  // Sends the event "world".
  announce() {
    const { rule, values, show, playing, seed } = this;
    const { settings: ranges, ...world } = rule.world;
    const settings = mapped(ranges, (range, name) => ({ ...range, value: values[name] }));
    this.changed = true;
    const names = (rules) => rules.map(({ name }) => name);
    this.send({
      type: "world",
      ...world,
      rules: names(this.rules),
      rule: rule.name,
      others: names(this.rules.filter((other) => this.mayJoin(other))),
      species: names(this.species),
      show, settings, playing, seed,
    });
  }
}

// Returns table[name]; throws an error if there is none. what: the kind of name, for its message.
function entry(table, name, what) {
  if (!Object.hasOwn(table, name)) throw Error(`no ${what} is called ${name}`);
  return table[name];
}

// Returns the entry of a list that has a name, in the same way.
function named(list, name, what) {
  return entry(Object.fromEntries(list.map((one) => [one.name, one])), name, what);
}

function alike(world, other) {
  const close = (a, b) => a.every((value, k) => Math.abs(value - b[k]) <= TRIAL_TOLERANCE);
  return close(world.x, other.x) && close(world.s, other.s);
}

function joined(first, second) {
  const both = new first.constructor(first.length + second.length);
  both.set(first);
  both.set(second, first.length);
  return both;
}

function meanOf({ x, dimension }) {
  const mean = new Array(dimension).fill(0);
  for (let k = 0; k < x.length; k++) mean[k % dimension] += (x[k] * dimension) / x.length;
  return mean;
}

// Returns a rule with its weights and clouds as arrays of numbers.
function decoded(rule) {
  const floats = (text) => new Float32Array(bytesOf(text).buffer);
  const { weights, world: { seed } } = rule;
  const world = seed.clouds ? { ...rule.world, seed: { ...seed, clouds: seed.clouds.map(floats) } } : rule.world;
  return { ...rule, weights: mapped(weights, floats), world };
}

// Returns an object of the same names whose values are `change` of the value and its name.
function mapped(object, change) {
  return Object.fromEntries(Object.entries(object).map(([name, value]) => [name, change(value, name)]));
}

function bytesOf(text) {
  return Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
}

// Runs a live world in a worker: answers its messages, and computes frames between them.
export function serve(scope) {
  const send = (event, transferred = []) => scope.postMessage(event, transferred);
  const messages = [], clock = new MessageChannel();
  let live = null, busy = false, physics = null;

  const apply = async ({ type, settings, ...rest }) => {
    if (type !== "begin") return live.receive({ type, ...rest });
    const device = settings.engine === "processor" ? null : await openDevice().catch(() => null);
    live = new RuleWorld(settings, send, device);
  };

  // One message, or one frame where there is none, never two at a time.
  const handleNext = async () => {
    if (busy) return;
    busy = true;
    const message = messages.shift();
    try {
      if (message !== undefined) await apply(message);
      else if (live?.pending) await live.advance();
    } catch (error) {
      send({ type: "error", message: error.message });
      // A world that fails is paused.
      if (message === undefined) live.playing = live.changed = false;
    }
    busy = false;
    if (messages.length > 0 || live?.pending) clock.port2.postMessage(null);
  };

  clock.port1.onmessage = handleNext;
  const share = ({ begin, world, options, part, parts }) => {
    if (begin !== null) physics = makePhysics(begin.rules, begin.capacity, options.box !== null);
    physics.sort(world, options.eps, options.box);
    physics.advancePart(world, options, part, parts);
    return physics.exchange(world, part, parts);
  };

  scope.onmessage = ({ data }) => {
    if (data.type === "share") return send(share(data));
    messages.push(data);
    handleNext();
  };
}

// Random numbers that depend only on the seed, and differ from Python's for the same seed.
// The generator is sfc32 of Chris Doty-Humphrey (PractRand), 128 bits of state.
class Random {
  constructor(seed) {
    this.a = seed >>> 0;
    this.b = Math.floor(seed / 2 ** 32) >>> 0;
    this.c = 0x9e3779b9;
    this.counter = 1;
    for (let k = 0; k < 16; k++) this.bits();
  }

  bits() {
    const sum = (this.a + this.b + this.counter) >>> 0;
    this.counter = (this.counter + 1) >>> 0;
    this.a = this.b ^ (this.b >>> 9);
    this.b = (this.c + (this.c << 3)) >>> 0;
    this.c = ((this.c << 21) | (this.c >>> 11)) >>> 0;
    this.c = (this.c + sum) >>> 0;
    return sum;
  }

  // A number uniform in [0, 1).
  uniform() {
    return this.bits() / 2 ** 32;
  }

  below(count) {
    return Math.floor(this.uniform() * count);
  }

  normal() {
    const radius = Math.sqrt(-2 * Math.log(1 - this.uniform()));
    return radius * Math.cos(2 * Math.PI * this.uniform());
  }

  normals(length, deviation) {
    return Float32Array.from({ length }, () => deviation * this.normal());
  }

  // A random vector of length 1.
  direction(dimension) {
    const vector = Array.from({ length: dimension }, () => this.normal());
    const length = Math.hypot(...vector) || 1;
    return vector.map((part) => part / length);
  }

  // Points uniform in a ball around the origin [length units].
  ball(count, dimension, radius) {
    const points = new Float32Array(count * dimension);
    for (let i = 0; i < count; i++) {
      const distance = radius * this.uniform() ** (1 / dimension);
      points.set(this.direction(dimension).map((part) => distance * part), i * dimension);
    }
    return points;
  }

  // Points uniform in a box around the origin with these sides [length units].
  box(count, sides) {
    return Float32Array.from({ length: count * sides.length }, (_, k) => sides[k % sides.length] * (this.uniform() - 0.5));
  }
}
