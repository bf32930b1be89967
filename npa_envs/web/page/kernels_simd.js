// The two kernels of physics.js in WebAssembly with 128-bit vectors, assembled here: no compiler, no
// binary file. Four channels, or four hidden units, are added up at a time, in float32.
//
// The texts of the kernels stand below as functions of the assembler's words; the instructions and
// the format of a module are those of https://webassembly.github.io/spec/core/binary/.

import { plainKernels, tiled } from "./physics.js";

const MEMORY_PAGES = 512;
const PAGE_BYTES = 65536;

// Rows and outputs that a step of the product computes together, in registers.
export const TILE_ROWS = 4;
const TILE_OUTPUTS = tiled(1);

// The assembler's words: each gives the bytes of one instruction.

function unsigned(value) {
  const bytes = [];
  do {
    const low = value & 0x7f;
    value >>>= 7;
    bytes.push(value ? low | 0x80 : low);
  } while (value);
  return bytes;
}

function signed(value) {
  const bytes = [];
  for (;;) {
    const low = value & 0x7f;
    value >>= 7;
    if ((value === 0 && !(low & 0x40)) || (value === -1 && low & 0x40)) return [...bytes, low];
    bytes.push(low | 0x80);
  }
}

const vector = (code, ...rest) => [0xfd, ...unsigned(code), ...rest];
const get = (local) => [0x20, ...unsigned(local)];
const set = (local, value) => [...value, 0x21, ...unsigned(local)];
const number = (value) => [0x41, ...signed(value)];
const add = (left, right) => [...left, ...right, 0x6a];
const multiply = (left, right) => [...left, ...right, 0x6c];
const below = (left, right) => [...left, ...right, 0x49];
const loadInteger = (at) => [...at, 0x28, 2, 0];
const load = (at, offset = 0) => [...at, ...vector(0x00, 2, ...unsigned(offset))];
const loadSplat = (at, offset = 0) => [...at, ...vector(0x09, 2, ...unsigned(offset))];
const store = (at, value, offset = 0) => [...at, ...value, ...vector(0x0b, 2, ...unsigned(offset))];
const zeros = vector(0x0c, ...new Array(16).fill(0));
const plus = (left, right) => [...left, ...right, ...vector(0xe4)];
const minus = (left, right) => [...left, ...right, ...vector(0xe5)];
const times = (left, right) => [...left, ...right, ...vector(0xe6)];
const larger = (left, right) => [...left, ...right, ...vector(0xe9)];
const select = (yes, no, condition) => [...yes, ...no, ...condition, 0x1b];

// Repeats a body while a local is below a limit, which is looked at first.
function loopBelow(local, limit, body) {
  return [0x02, 0x40, 0x03, 0x40, ...below(get(local), limit), 0x45, 0x0d, 1, ...body, 0x0c, 0, 0x0b, 0x0b];
}

// gather(states, own, listBytes, place, a, kx, ky, kz, sums): as in plainKernels, addresses in bytes.
function gatherCode(width, dimension) {
  const [states, own, listBytes, place, a, kx, ky, kz, sums] = [0, 1, 2, 3, 4, 5, 6, 7, 8];
  const [done, at, other, offset] = [9, 10, 11, 12];
  const slopes = [kx, ky, kz].slice(0, dimension);
  const spread = [13, 14, 15, 16];
  const mine = (part) => 17 + part;
  const sum = (axis, part) => 19 + 2 * axis + part;
  const code = [];
  // Two vectors at a time: their sums stay in registers.
  for (let first = 0; first < width; first += 8) {
    const parts = first + 4 < width ? [0, 1] : [0];
    const byte = (part) => 4 * first + 16 * part;
    for (const part of parts) {
      code.push(...set(mine(part), load(get(own), byte(part))));
      for (let axis = 0; axis <= dimension; axis++) code.push(...set(sum(axis, part), zeros));
    }
    code.push(...set(done, number(0)));
    const body = [...set(at, add(get(states), multiply(loadInteger(add(get(place), get(done))), number(4))))];
    [a, ...slopes].forEach((list, axis) => body.push(...set(spread[axis], loadSplat(add(get(list), get(done))))));
    for (const part of parts) {
      body.push(...set(other, load(get(at), byte(part))));
      body.push(...set(offset, minus(get(other), get(mine(part)))));
      body.push(...set(sum(0, part), plus(get(sum(0, part)), times(get(spread[0]), get(other)))));
      slopes.forEach((_, axis) => {
        const total = sum(axis + 1, part);
        body.push(...set(total, plus(get(total), times(get(spread[axis + 1]), get(offset)))));
      });
    }
    body.push(...set(done, add(get(done), number(4))));
    code.push(...loopBelow(done, get(listBytes), body));
    for (const part of parts) {
      for (let axis = 0; axis <= dimension; axis++) {
        code.push(...store(get(sums), get(sum(axis, part)), 4 * width * axis + byte(part)));
      }
    }
  }
  return { parameters: 9, integers: 2, vectors: 2 + 4 + 2 + 8, code };
}

// product(rows, rowBytes, rowEnd, weights, bias, outputs, outputBytes, inputBytes, limit, tiles): for all
// rows out = W in + b, and max(out, 0) where `limit` is 1. Weights lie tile by tile: [tiles, inputs, 8].
function productCode() {
  const [rows, rowBytes, rowEnd, weights, bias, outputs, outputBytes, inputBytes, limit, tiles] = [0, 1, 2, 3, 4, 5, 6, 7, 8, 9];
  const [row, input, weight, out, tile, at0, at1, at2, at3] = [10, 11, 12, 13, 14, 15, 16, 17, 18];
  const places = [at0, at1, at2, at3];
  const [left, right, spread, other] = [19, 20, 21, 22];
  const sum = (k, half) => 23 + 2 * k + half;
  const inner = [
    ...set(left, load(get(weight))),
    ...set(right, load(get(weight), 16)),
  ];
  places.forEach((place, k) => {
    inner.push(...set(spread, loadSplat(add(get(place), get(input)))));
    inner.push(...set(sum(k, 0), plus(get(sum(k, 0)), times(get(spread), get(left)))));
    inner.push(...set(sum(k, 1), plus(get(sum(k, 1)), times(get(spread), get(right)))));
  });
  inner.push(...set(weight, add(get(weight), number(4 * TILE_OUTPUTS))));
  inner.push(...set(input, add(get(input), number(4))));
  const perRows = [];
  places.forEach((place, k) => {
    perRows.push(...set(place, add(get(row), multiply(get(rowBytes), number(k)))));
    perRows.push(...set(sum(k, 0), load(get(bias))), ...set(sum(k, 1), load(get(bias), 16)));
  });
  perRows.push(...set(weight, get(weights)), ...set(input, number(0)));
  perRows.push(...loopBelow(input, get(inputBytes), inner));
  places.forEach((_, k) => {
    for (const half of [0, 1]) {
      perRows.push(...set(other, get(sum(k, half))));
      perRows.push(...store(get(out), select(larger(get(other), zeros), get(other), get(limit)), 16 * half));
    }
    perRows.push(...set(out, add(get(out), get(outputBytes))));
  });
  perRows.push(...set(row, add(get(row), multiply(get(rowBytes), number(TILE_ROWS)))));
  const perTile = [
    ...set(row, get(rows)),
    ...set(out, add(get(outputs), multiply(get(tile), number(4 * TILE_OUTPUTS)))),
    ...loopBelow(row, get(rowEnd), perRows),
    ...set(weights, add(get(weights), multiply(get(inputBytes), number(TILE_OUTPUTS)))),
    ...set(bias, add(get(bias), number(4 * TILE_OUTPUTS))),
    ...set(tile, add(get(tile), number(1))),
  ];
  return { parameters: 10, integers: 9, vectors: 4 + 8, code: [...set(tile, number(0)), ...loopBelow(tile, get(tiles), perTile)] };
}

// A module of some functions, exported by their names; all parameters are integers, none returns.
function assemble(functions) {
  const text = (word) => [...unsigned(word.length), ...new TextEncoder().encode(word)];
  const list = (entries) => [...unsigned(entries.length), ...entries.flat()];
  const section = (id, content) => [id, ...unsigned(content.length), ...content];
  const named = Object.entries(functions);
  const [INTEGER, VECTOR] = [0x7f, 0x7b];
  const types = named.map(([, own]) => [0x60, ...list(new Array(own.parameters).fill([INTEGER])), 0]);
  const imports = [[...text("page"), ...text("memory"), 0x02, 0x00, ...unsigned(MEMORY_PAGES)]];
  const exported = named.map(([name], index) => [...text(name), 0x00, ...unsigned(index)]);
  const bodies = named.map(([, own]) => {
    const locals = list([[...unsigned(own.integers), INTEGER], [...unsigned(own.vectors), VECTOR]]);
    const body = [...locals, ...own.code, 0x0b];
    return [...unsigned(body.length), ...body];
  });
  return new Uint8Array([
    0x00, 0x61, 0x73, 0x6d, 1, 0, 0, 0,
    ...section(1, list(types)),
    ...section(2, list(imports)),
    ...section(3, list(named.map((_, index) => unsigned(index)))),
    ...section(7, list(exported)),
    ...section(10, list(bodies)),
  ]);
}

// Kernels for states of some width (channels, padded to a multiple of four) in 2D or 3D; the plain
// ones where the browser has no WebAssembly with vectors, or does not let the page use it.
export function fastestKernels(width, dimension) {
  try {
    return simdKernels(width, dimension);
  } catch {
    return plainKernels();
  }
}

export function simdKernels(width, dimension) {
  const memory = new WebAssembly.Memory({ initial: MEMORY_PAGES });
  const code = assemble({ gather: gatherCode(width, dimension), product: productCode() });
  const instance = new WebAssembly.Instance(new WebAssembly.Module(code), { page: { memory } });
  const { gather: gatherAt, product: multiplyAt } = instance.exports;
  let used = 16;
  const reserve = (Kind, length) => {
    const at = used;
    used += 16 * Math.ceil((4 * length) / 16);
    if (used > MEMORY_PAGES * PAGE_BYTES) throw new RangeError("the world is too large for the kernels' memory");
    return new Kind(memory.buffer, at, length);
  };
  const floats = (length) => reserve(Float32Array, length);

  function gather(states, stateWidth, space, own, { count, place, a, slopes }, sums) {
    const at = states.byteOffset;
    gatherAt(
      at, at + 4 * own, 4 * count, place.byteOffset, a.byteOffset,
      slopes[0].byteOffset, slopes[1].byteOffset, slopes[2].byteOffset, sums.byteOffset,
    );
  }

  function layer(weight, bias, inputs, outputs) {
    const width = tiled(outputs);
    const weights = floats(width * inputs), offset = floats(width);
    if (bias !== null) offset.set(bias);
    for (let a = 0; a < outputs; a++) {
      const tile = Math.floor(a / TILE_OUTPUTS) * inputs;
      for (let p = 0; p < inputs; p++) {
        weights[(tile + p) * TILE_OUTPUTS + (a % TILE_OUTPUTS)] = weight[a * inputs + p];
      }
    }
    return { inputs, width, weights, offset };
  }

  // Rows are taken four at a time: arrays have room for a multiple of them.
  function product({ inputs, width, weights, offset }, count, rows, rowWidth, out, rectified) {
    const end = rows.byteOffset + 4 * rowWidth * TILE_ROWS * Math.ceil(count / TILE_ROWS);
    multiplyAt(
      rows.byteOffset, 4 * rowWidth, end, weights.byteOffset, offset.byteOffset,
      out.byteOffset, 4 * width, 4 * inputs, rectified ? 1 : 0, width / TILE_OUTPUTS,
    );
  }

  return { name: "WebAssembly", floats, integers: (length) => reserve(Int32Array, length), gather, layer, product };
}
