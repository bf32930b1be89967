// The kernels of `plainKernels` of physics.js in WebAssembly, whose vectors of four float32 make a step more than twice
// as fast. The page builds the module when it starts: `xCode` writes kernel x as in WebAssembly text, by functions that
// return the bytes of instructions (the assembler below), and `assemble` joins the kernels. So no compiler is needed,
// and sizes are constants in the code. Instructions and format: https://webassembly.github.io/spec/core/binary/.

import { plainKernels, TILE_OUTPUTS, tiledLayer } from "./physics.js";

const MEMORY_PAGES = 512;
const PAGE_BYTES = 65536;

// Rows that `applyLayer` computes at a time, in registers.
const TILE_ROWS = 4;

// The assembler: functions return the bytes of an instruction and of its operands.

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
const unary = (...code) => (value) => [...value, ...code];
const binary = (...code) => (left, right) => [...left, ...right, ...code];
const select = (yes, no, condition) => [...yes, ...no, ...condition, 0x1b];

// Instructions by the types and names of WebAssembly text; arguments are the bytes of operands. Addresses of arrays
// are multiples of 2^2 bytes, which the 2 of loads and stores says.
const i32 = {
  const: (value) => [0x41, ...signed(value)], load: unary(0x28, 2, 0), store: binary(0x36, 2, 0),
  eqz: unary(0x45), lt_u: binary(0x49), popcnt: unary(0x69), add: binary(0x6a), mul: binary(0x6c),
};
const v128 = {
  const: (bytes) => vector(0x0c, ...bytes), and: binary(...vector(0x4e)),
  load: (at, offset = 0) => [...at, ...vector(0x00, 2, ...unsigned(offset))],
  load32_splat: (at, offset = 0) => [...at, ...vector(0x09, 2, ...unsigned(offset))],
  store: (at, value, offset = 0) => [...at, ...value, ...vector(0x0b, 2, ...unsigned(offset))],
};
const f32x4 = {
  lt: binary(...vector(0x43)), nearest: unary(...vector(0x6a)), sqrt: unary(...vector(0xe3)),
  add: binary(...vector(0xe4)), sub: binary(...vector(0xe5)), mul: binary(...vector(0xe6)),
  div: binary(...vector(0xe7)), max: binary(...vector(0xe9)),
};
const i32x4 = {
  splat: unary(...vector(0x11)), lt_s: binary(...vector(0x39)), bitmask: unary(...vector(0xa4)),
  add: binary(...vector(0xae)), mul: binary(...vector(0xb5)),
};
const i8x16 = { swizzle: binary(...vector(0x0e)) };
const [BLOCK, LOOP, IF, END, BR, BR_IF, NO_RESULT] = [0x02, 0x03, 0x04, 0x0b, 0x0c, 0x0d, 0x40];

const zeros = v128.const(new Array(16).fill(0));

// Repeats a body while a local is below a limit; tests before the first time.
function loopBelow(local, limit, body) {
  const leave = [...i32.eqz(i32.lt_u(local.get, limit)), BR_IF, 1];
  return [BLOCK, NO_RESULT, LOOP, NO_RESULT, ...leave, ...body, BR, 0, END, END];
}

// Makers of a function's locals: `parameters`, then `integers`, then `vectors` return as many new ones as asked for.
function makeLocals() {
  const counts = { parameters: 0, integers: 0, vectors: 0 };
  let made = 0;
  const makerOf = (kind) => (count) => Array.from({ length: count }, () => {
    const index = unsigned(made++);
    counts[kind]++;
    return { get: [0x20, ...index], set: (value) => [...value, 0x21, ...index] };
  });
  return { counts, parameters: makerOf("parameters"), integers: makerOf("integers"), vectors: makerOf("vectors") };
}

// sumNeighbours(states, own, listBytes, stateAt, smoothing, slopeX, slopeY, slopeZ, sums): addresses in bytes; `own` is
// that of the particle's state.
function sumNeighboursCode(width, dimension) {
  const { counts, parameters, integers, vectors } = makeLocals();
  const [states, own, listBytes, stateAt] = parameters(4), lists = parameters(4), [sums] = parameters(1);
  const [done, at] = integers(2);
  const [other, offset] = vectors(2), factors = vectors(4), mine = vectors(2);
  // The sums of each list, each of two vectors; in 2D the last list is not used.
  const listSums = lists.map(() => vectors(2)).slice(0, dimension + 1);
  const code = [];
  const addProduct = (sum, factor, term) => sum.set(f32x4.add(sum.get, f32x4.mul(factor.get, term.get)));
  // Two vectors at a time: their sums stay in registers.
  for (let first = 0; first < width; first += 8) {
    const parts = first + 4 < width ? [0, 1] : [0];
    const byte = (part) => 4 * first + 16 * part;
    const neighbour = [
      ...at.set(i32.add(states.get, i32.mul(i32.load(i32.add(stateAt.get, done.get)), i32.const(4)))),
      ...listSums.flatMap((_, k) => factors[k].set(v128.load32_splat(i32.add(lists[k].get, done.get)))),
      ...parts.flatMap((part) => [
        ...other.set(v128.load(at.get, byte(part))),
        ...offset.set(f32x4.sub(other.get, mine[part].get)),
        ...listSums.flatMap(({ [part]: sum }, k) => addProduct(sum, factors[k], k === 0 ? other : offset)),
      ]),
      ...done.set(i32.add(done.get, i32.const(4))),
    ];
    code.push(
      ...parts.flatMap((part) => [
        ...mine[part].set(v128.load(own.get, byte(part))),
        ...listSums.flatMap((sum) => sum[part].set(zeros)),
      ]),
      ...done.set(i32.const(0)),
      ...loopBelow(done, listBytes.get, neighbour),
      ...parts.flatMap((part) => listSums.flatMap((sum, k) =>
        v128.store(sums.get, sum[part].get, 4 * width * k + byte(part)))),
    );
  }
  return { ...counts, code };
}

// The number of the particle's and the step's constants that `listNeighbours` reads, each a word in memory: position
// (3), eps, eps², weight, slope, sides (3), inverse sides (3).
const SCALARS = 13;

// listNeighbours(scalars, order, X, Y, Z, volume, ranges, rangesEnd, width, stateAt, smoothing, slopeX, slopeY, slopeZ,
// out): `order` has for each set of lanes the bytes that bring them to the front; `out` gets the number of neighbours,
// and from its 16th byte on six vectors, whose lanes add up to the entries of the moment matrix.
function listNeighboursCode(dimension) {
  const { counts, parameters, integers, vectors } = makeLocals();
  const [scalars, order] = parameters(2), positions = parameters(3), [volume, ranges, rangesEnd, width] = parameters(4);
  const [stateAt, smoothing] = parameters(2), slopes = parameters(3), [out] = parameters(1);
  const [byte, end, count, hits, at] = integers(5);
  const [lanes] = vectors(1), d = vectors(3), [squared, inside, left, distance, factor, front] = vectors(6);
  const moment = [vectors(3), vectors(2), vectors(1)]; // the upper triangle, row by row
  const scaled = vectors(3), constants = vectors(SCALARS), [eps, square, weight, slope] = constants.slice(3);
  const [own, sides, perSide] = [0, 7, 10].map((first) => constants.slice(first, first + 3));
  const axes = [0, 1, 2].slice(0, dimension);

  const append = (list, code) => v128.store(i32.add(list.get, at.get), i8x16.swizzle(code, front.get));
  const volumes = v128.load(i32.add(volume.get, byte.get));
  const appendFour = [
    ...distance.set(f32x4.sqrt(squared.get)),
    ...left.set(f32x4.sub(square.get, squared.get)),
    ...factor.set(f32x4.sub(eps.get, distance.get)),
    ...factor.set(f32x4.div(f32x4.mul(slope.get, f32x4.mul(factor.get, factor.get)), distance.get)),
    ...factor.set(f32x4.mul(factor.get, volumes)),
    // Masks the NaN of the particle itself, and lanes behind the last particle.
    ...factor.set(v128.and(factor.get, v128.and(inside.get, f32x4.lt(zeros, squared.get)))),
    ...axes.flatMap((a) => scaled[a].set(f32x4.mul(factor.get, d[a].get))),
    ...axes.flatMap((a) => axes.slice(a).flatMap((b) =>
      moment[a][b - a].set(f32x4.add(moment[a][b - a].get, f32x4.mul(scaled[a].get, d[b].get))))),
    ...front.set(v128.load(i32.add(order.get, i32.mul(hits.get, i32.const(16))))),
    ...at.set(i32.mul(count.get, i32.const(4))),
    ...append(stateAt, i32x4.mul(lanes.get, i32x4.splat(width.get))),
    ...append(smoothing,
      f32x4.mul(f32x4.mul(weight.get, f32x4.mul(left.get, f32x4.mul(left.get, left.get))), volumes)),
    ...axes.flatMap((a) => append(slopes[a], scaled[a].get)),
    ...count.set(i32.add(count.get, i32.popcnt(hits.get))),
  ];
  const toNearest = (a) => f32x4.mul(sides[a].get, f32x4.nearest(f32x4.mul(d[a].get, perSide[a].get)));
  const four = [
    ...axes.flatMap((a) => [
      ...d[a].set(f32x4.sub(v128.load(i32.add(positions[a].get, byte.get)), own[a].get)),
      ...d[a].set(f32x4.sub(d[a].get, toNearest(a))),
    ]),
    ...squared.set(axes.map((a) => f32x4.mul(d[a].get, d[a].get)).reduce((sum, term) => f32x4.add(sum, term))),
    ...inside.set(v128.and(f32x4.lt(squared.get, square.get), i32x4.lt_s(lanes.get, i32x4.splat(end.get)))),
    ...hits.set(i32x4.bitmask(inside.get)),
    ...hits.get, IF, NO_RESULT, ...appendFour, END,
    ...byte.set(i32.add(byte.get, i32.const(16))),
    ...lanes.set(i32x4.add(lanes.get, i32x4.splat(i32.const(4)))),
  ];
  const firstLanes = v128.const([0, 0, 0, 0, 1, 0, 0, 0, 2, 0, 0, 0, 3, 0, 0, 0]);
  const range = [
    ...byte.set(i32.mul(i32.load(ranges.get), i32.const(4))),
    ...lanes.set(i32x4.add(i32x4.splat(i32.load(ranges.get)), firstLanes)),
    ...end.set(i32.load(i32.add(ranges.get, i32.const(4)))),
    ...loopBelow(byte, i32.mul(end.get, i32.const(4)), four),
    ...ranges.set(i32.add(ranges.get, i32.const(8))),
  ];
  const code = [
    ...constants.flatMap((local, k) => local.set(v128.load32_splat(scalars.get, 4 * k))),
    ...loopBelow(ranges, rangesEnd.get, range),
    ...i32.store(out.get, count.get),
    ...moment.flat().flatMap((entry, k) => v128.store(out.get, entry.get, 16 + 16 * k)),
  ];
  return { ...counts, code };
}

// applyLayer(rows, rowBytes, rowEnd, weights, bias, outputs, outputBytes, inputBytes, limit, tiles): for all
// rows out = W in + b, and max(out, 0) where `limit` is 1. Weights lie tile by tile: [tiles, inputs, 8].
function applyLayerCode() {
  const { counts, parameters, integers, vectors } = makeLocals();
  const [rows, rowBytes, rowEnd, weights, bias, outputs, outputBytes, inputBytes, limit, tiles] = parameters(10);
  const [row, input, weight, out, tile] = integers(5), at = integers(4);
  const [left, right, spread, other] = vectors(4), sums = at.map(() => vectors(2));
  const addProduct = (sum, four) => sum.set(f32x4.add(sum.get, f32x4.mul(spread.get, four.get)));
  const limited = (sum, byte) => [
    ...other.set(sum.get),
    ...v128.store(out.get, select(f32x4.max(other.get, zeros), other.get, limit.get), byte),
  ];
  const inner = [
    ...left.set(v128.load(weight.get)), ...right.set(v128.load(weight.get, 16)),
    ...sums.flatMap(([leftSum, rightSum], k) => [
      ...spread.set(v128.load32_splat(i32.add(at[k].get, input.get))),
      ...addProduct(leftSum, left), ...addProduct(rightSum, right),
    ]),
    ...weight.set(i32.add(weight.get, i32.const(4 * TILE_OUTPUTS))),
    ...input.set(i32.add(input.get, i32.const(4))),
  ];
  const perRows = [
    ...sums.flatMap(([leftSum, rightSum], k) => [
      ...at[k].set(i32.add(row.get, i32.mul(rowBytes.get, i32.const(k)))),
      ...leftSum.set(v128.load(bias.get)), ...rightSum.set(v128.load(bias.get, 16)),
    ]),
    ...weight.set(weights.get), ...input.set(i32.const(0)),
    ...loopBelow(input, inputBytes.get, inner),
    ...sums.flatMap(([leftSum, rightSum]) => [
      ...limited(leftSum, 0), ...limited(rightSum, 16),
      ...out.set(i32.add(out.get, outputBytes.get)),
    ]),
    ...row.set(i32.add(row.get, i32.mul(rowBytes.get, i32.const(TILE_ROWS)))),
  ];
  const perTile = [
    ...row.set(rows.get),
    ...out.set(i32.add(outputs.get, i32.mul(tile.get, i32.const(4 * TILE_OUTPUTS)))),
    ...loopBelow(row, rowEnd.get, perRows),
    ...weights.set(i32.add(weights.get, i32.mul(inputBytes.get, i32.const(TILE_OUTPUTS)))),
    ...bias.set(i32.add(bias.get, i32.const(4 * TILE_OUTPUTS))),
    ...tile.set(i32.add(tile.get, i32.const(1))),
  ];
  return { ...counts, code: [...tile.set(i32.const(0)), ...loopBelow(tile, tiles.get, perTile)] };
}

// A module of some functions, exported by their names; all parameters are integers, none returns.
function assemble(functions) {
  const text = (word) => [...unsigned(word.length), ...new TextEncoder().encode(word)];
  const list = (entries) => [...unsigned(entries.length), ...entries.flat()];
  const section = (id, content) => [id, ...unsigned(content.length), ...content];
  const named = Object.entries(functions);
  const [INTEGER, VECTOR] = [0x7f, 0x7b];
  const types = named.map(([, body]) => [0x60, ...list(new Array(body.parameters).fill([INTEGER])), 0]);
  const imports = [[...text("page"), ...text("memory"), 0x02, 0x00, ...unsigned(MEMORY_PAGES)]];
  const exported = named.map(([name], index) => [...text(name), 0x00, ...unsigned(index)]);
  const bodies = named.map(([, { integers, vectors, code }]) => {
    const locals = list([[...unsigned(integers), INTEGER], [...unsigned(vectors), VECTOR]]);
    const body = [...locals, ...code, END];
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
  const code = assemble({
    sumNeighbours: sumNeighboursCode(width, dimension), listNeighbours: listNeighboursCode(dimension),
    applyLayer: applyLayerCode(),
  });
  const instance = new WebAssembly.Instance(new WebAssembly.Module(code), { page: { memory } });
  const run = instance.exports;
  let used = 16;
  // Makes an array of a kind, for example Float32Array, in unused memory.
  const reserve = (Kind, length) => {
    const at = used;
    used += 16 * Math.ceil((Kind.BYTES_PER_ELEMENT * length) / 16);
    if (used > MEMORY_PAGES * PAGE_BYTES) throw new RangeError("the world is too large for the kernels' memory");
    return new Kind(memory.buffer, at, length);
  };
  const floats = (length) => reserve(Float32Array, length);

  function sumNeighbours({ states, list: { count, stateAt, smoothing, slopes }, sums }, i) {
    const at = states.byteOffset;
    run.sumNeighbours(
      at, at + 4 * i * width, 4 * count, stateAt.byteOffset, smoothing.byteOffset,
      slopes[0].byteOffset, slopes[1].byteOffset, slopes[2].byteOffset, sums.byteOffset,
    );
  }

  const scalars = floats(SCALARS);
  // For each set of four lanes the bytes that bring them to the front, in order: [16, 16].
  const order = reserve(Uint8Array, 256).fill(0xff);
  for (let set = 0; set < 16; set++) {
    const bytes = [0, 1, 2, 3].filter((lane) => set & (1 << lane)).flatMap((lane) => [0, 1, 2, 3].map((k) => 4 * lane + k));
    order.set(bytes, 16 * set);
  }
  const out = floats(4 + 6 * 4);
  const neighbourCount = new Int32Array(memory.buffer, out.byteOffset, 1);

  function listNeighbours(physics, i) {
    const { ranges, rangesEnd, eps, weight, slope, sides, perSide, list } = physics;
    const { x, y, z, volume } = physics.points;
    scalars.set([x[i], y[i], z[i], eps, eps * eps, weight, slope]);
    scalars.set(sides, 7);
    scalars.set(perSide, 10);
    const at = ranges.byteOffset;
    const { stateAt, smoothing, slopes } = list;
    run.listNeighbours(
      scalars.byteOffset, order.byteOffset, x.byteOffset, y.byteOffset, z.byteOffset, volume.byteOffset,
      at, at + 4 * rangesEnd, width, stateAt.byteOffset, smoothing.byteOffset,
      slopes[0].byteOffset, slopes[1].byteOffset, slopes[2].byteOffset, out.byteOffset,
    );
    list.count = neighbourCount[0];
    for (let k = 0; k < 6; k++) list.moment[k] = out[4 + 4 * k] + out[5 + 4 * k] + out[6 + 4 * k] + out[7 + 4 * k];
  }

  // Rows are taken four at a time: arrays have room for a multiple of them.
  function applyLayer({ inputs, width, weights, offset }, count, rows, rowWidth, out, rectified) {
    const end = rows.byteOffset + 4 * rowWidth * TILE_ROWS * Math.ceil(count / TILE_ROWS);
    run.applyLayer(
      rows.byteOffset, 4 * rowWidth, end, weights.byteOffset, offset.byteOffset,
      out.byteOffset, 4 * width, 4 * inputs, rectified ? 1 : 0, width / TILE_OUTPUTS,
    );
  }

  return {
    name: "WebAssembly", floats, integers: (length) => reserve(Int32Array, length),
    sumNeighbours, listNeighbours, makeLayer: (...matrix) => tiledLayer(floats, ...matrix), applyLayer,
  };
}
