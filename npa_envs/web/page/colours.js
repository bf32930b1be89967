// Colours of particles by state, density, species, speed or update mask, by the formulas of `Colouring` of
// npa_envs/web/live_world.py; test_particles_have_the_colours_of_the_viewer of tests/web/test_export.py compares all.

import { inner } from "./brushes.js";
import { padded } from "./physics.js";

const ROWS_TOGETHER = 64;
const JACOBI_SWEEPS = 12;

// Computes red, green and blue bytes of each particle, frame by frame.
export class Colouring {
  // tables: `colour_tables` of npa_envs/web/live_world.py, as Uint8Array; constants: `CONSTANTS` of export.py there.
  constructor(tables, constants) {
    this.tables = tables;
    this.constants = constants;
    this.average = null; // moving average of the states' covariance
    this.basis = null;
  }

  // live: the RuleWorld; show: one of its shows.
  of(live, show) {
    const { world } = live, { ramp, state, species, mask } = this.tables;
    const bytes = new Uint8ClampedArray(3 * world.count);
    if (show === "colours") {
      live.ruleColours.forEach((colours, number) => colours.write(world, number, bytes));
    } else if (show === "density") {
      this.densities(live, bytes);
    } else if (show === "components") {
      this.components(world.s, live.channels, bytes);
    } else if (show === "species") {
      writeColours(bytes, (i) => entryOf(species, world.species[i]));
    } else if (show === "speed") {
      const fast = Math.max(0.01, live.travelled.slice().sort()[Math.ceil(0.99 * world.count) - 1] || 0);
      writeColours(bytes, (i) => between(ramp, Math.sqrt((live.travelled[i] || 0) / fast)));
    } else if (show === "mask") {
      writeColours(bytes, (i) => entryOf(mask, live.updated[i]));
    } else {
      const channel = parseInt(show.slice("state ".length)), gain = this.constants.STATE_GAIN;
      writeColours(bytes, (i) => between(state, 1 / (1 + Math.exp(-gain * world.s[i * live.channels + channel]))));
    }
    return new Uint8Array(bytes.buffer);
  }

  // 1 is a world whose particles fill [-1, 1]^D, or its box, evenly. Worlds in open space are denser.
  densities({ physics, world, values: { eps }, box, dimension, seedCount }, bytes) {
    physics.sort(world, eps, box);
    physics.computeDensities(world.count);
    const volume = box === null ? 2 ** dimension : box.reduce((product, side) => product * side, 1);
    const usual = (seedCount / volume) * (box === null ? 4 : 1);
    for (let k = 0; k < world.count; k++) {
      writeColour(bytes, physics.order[k], between(this.tables.ramp, 1 - 2 ** (-physics.density[k] / usual)));
    }
  }

  // The first three principal components as colours; their basis moves slowly.
  components(s, channels, bytes) {
    const count = s.length / channels;
    // A NaN would stay in the moving average.
    const known = [];
    for (let i = 0; i < count; i++) {
      if (s.subarray(i * channels, (i + 1) * channels).every(Number.isFinite)) known.push(i);
    }
    const mean = new Float64Array(channels);
    for (const i of known) for (let c = 0; c < channels; c++) mean[c] += s[i * channels + c] / known.length;
    const covariance = new Float64Array(channels * channels);
    const row = new Float64Array(channels);
    for (const i of known) {
      for (let c = 0; c < channels; c++) row[c] = s[i * channels + c] - mean[c];
      for (let a = 0; a < channels; a++) {
        for (let b = 0; b < channels; b++) covariance[a * channels + b] += (row[a] * row[b]) / known.length;
      }
    }
    if (this.average?.length !== covariance.length) {
      this.average = covariance.slice();
      this.basis = null;
    }
    const { BALANCE } = this.constants;
    this.average = this.average.map((average, k) => BALANCE * average + (1 - BALANCE) * covariance[k]);
    const components = eigenvectors(this.average, channels).slice(0, 3);
    components.forEach(({ vector }, k) => {
      // An eigenvector's sign is arbitrary: colours must not flip between frames.
      if (this.basis?.[k] && inner(vector, this.basis[k]) < 0) vector.forEach((part, c) => (vector[c] = -part));
    });
    this.basis = components.map(({ vector }) => vector);
    const tint = [0.5, 0.5, 0.5];
    for (let i = 0; i < count; i++) {
      components.forEach(({ value, vector }, k) => {
        let sum = 0;
        for (let c = 0; c < channels; c++) sum += (s[i * channels + c] - mean[c]) * vector[c];
        tint[k] = 0.5 + (0.22 * sum) / Math.sqrt(Math.max(value, 1e-12));
      });
      writeColour(bytes, i, tint);
    }
  }
}

// The entry of a table of colours at a fraction of its length.
function between(table, fraction) {
  return entryOf(table, Math.round((table.length / 3 - 1) * Math.min(1, Math.max(0, fraction))));
}

function entryOf(table, index) {
  return [table[3 * index] / 255, table[3 * index + 1] / 255, table[3 * index + 2] / 255];
}

// Colours of one rule's particles by the outputs of its read-out, or their states: the last three, or the
// colour of the class with the largest output, greyer the smaller it is.
export class RuleColours {
  // rule: of RuleWorld; its `classes` are {palette, undecided}, or null. offset: COLOUR_OFFSET of the constants.
  constructor(rule, kernels, offset) {
    this.classes = rule.classes;
    this.offset = offset;
    this.channels = rule.state_dim;
    const { weights, readout_dim: outputs, readout_hidden_dim: hidden } = rule;
    this.kernels = kernels;
    this.outputs = outputs === 0 ? this.channels : rule.classes === null ? 3 : outputs;
    if (outputs === 0) return;
    // Only the read-out's outputs that are colours or classes.
    const width = this.outputs;
    this.first = kernels.makeLayer(weights["readout.0.weight"], weights["readout.0.bias"], this.channels, hidden);
    this.second = kernels.makeLayer(
      weights["readout.2.weight"].slice((outputs - width) * hidden), weights["readout.2.bias"].slice(outputs - width), hidden, width,
    );
    this.width = padded(this.channels);
    this.rows = kernels.floats(ROWS_TOGETHER * this.width);
    this.hidden = kernels.floats(ROWS_TOGETHER * this.first.width);
    this.results = kernels.floats(ROWS_TOGETHER * this.second.width);
  }

  // Writes red, green and blue of the particles of species `number` to `bytes`.
  write({ s, species, count }, number, bytes) {
    const { channels, width } = this;
    if (this.first === undefined) {
      for (let i = 0; i < count; i++) if (species[i] === number) writeColour(bytes, i, this.tint(s, i * channels));
      return;
    }
    const block = [];
    const flush = () => {
      block.forEach((i, row) => this.rows.set(s.subarray(i * channels, (i + 1) * channels), row * width));
      this.kernels.applyLayer(this.first, block.length, this.rows, width, this.hidden, true);
      this.kernels.applyLayer(this.second, block.length, this.hidden, this.first.width, this.results, false);
      block.forEach((i, row) => writeColour(bytes, i, this.tint(this.results, row * this.second.width)));
      block.length = 0;
    };
    for (let i = 0; i < count; i++) {
      if (species[i] === number && block.push(i) === ROWS_TOGETHER) flush();
    }
    flush();
  }

  // Red, green and blue of a particle whose outputs begin at index `at` of `values`.
  tint(values, at) {
    if (this.classes === null) {
      const last = at + this.outputs, { offset } = this;
      return [values[last - 3] + offset, values[last - 2] + offset, values[last - 1] + offset];
    }
    const { palette, undecided } = this.classes;
    let chosen = 0;
    for (let k = 1; k < this.outputs; k++) if (values[at + k] > values[at + chosen]) chosen = k;
    const sure = Math.min(1, Math.max(0, values[at + chosen]));
    return undecided.map((grey, c) => grey + sure * (palette[chosen % palette.length][c] - grey));
  }
}

function writeColours(bytes, tintOf) {
  for (let i = 0; 3 * i < bytes.length; i++) writeColour(bytes, i, tintOf(i));
}

function writeColour(bytes, i, tint) {
  bytes[3 * i] = 255 * tint[0];
  bytes[3 * i + 1] = 255 * tint[1];
  bytes[3 * i + 2] = 255 * tint[2];
}

// Eigenvalues and eigenvectors of a symmetric matrix, the largest first, by Jacobi's rotations.
function eigenvectors(matrix, size) {
  const m = Float64Array.from(matrix);
  const vectors = new Float64Array(size * size);
  for (let k = 0; k < size; k++) vectors[k * size + k] = 1;
  for (let sweep = 0; sweep < JACOBI_SWEEPS; sweep++) {
    for (let p = 0; p < size; p++) {
      for (let q = p + 1; q < size; q++) {
        const off = m[p * size + q];
        if (Math.abs(off) < 1e-18) continue;
        const theta = (m[q * size + q] - m[p * size + p]) / (2 * off);
        const t = (theta >= 0 ? 1 : -1) / (Math.abs(theta) + Math.sqrt(theta * theta + 1));
        const cosine = 1 / Math.sqrt(t * t + 1), sine = t * cosine;
        const turn = (array, i, j) => {
          const first = array[i], second = array[j];
          array[i] = cosine * first - sine * second;
          array[j] = sine * first + cosine * second;
        };
        for (let k = 0; k < size; k++) turn(m, k * size + p, k * size + q);
        for (let k = 0; k < size; k++) turn(m, p * size + k, q * size + k);
        for (let k = 0; k < size; k++) turn(vectors, k * size + p, k * size + q);
      }
    }
  }
  const pairs = Array.from({ length: size }, (_, k) => ({
    value: m[k * size + k],
    vector: Float64Array.from({ length: size }, (_, c) => vectors[c * size + k]),
  }));
  return pairs.sort((a, b) => b.value - a.value);
}
