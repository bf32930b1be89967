// The kernels of `plainKernels` of physics.js in WebAssembly, whose vectors of four float32 make a step ten times
// as fast. The page builds the module when it starts: `xCode` writes kernel x as in WebAssembly text, by functions that
// return the bytes of instructions (the assembler below), and `assemble` joins the kernels. So no compiler is needed,
// and sizes are constants in the code. Instructions and format: https://webassembly.github.io/spec/core/binary/.

import { numbersBelow, padded, plainKernels, TILE_OUTPUTS, tiledLayer } from "./physics.js";

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
  bitselect: (yes, no, mask) => [...yes, ...no, ...mask, ...vector(0x52)],
  load: (at, offset = 0) => [...at, ...vector(0x00, 2, ...unsigned(offset))],
  load32_splat: (at, offset = 0) => [...at, ...vector(0x09, 2, ...unsigned(offset))],
  store: (at, value, offset = 0) => [...at, ...value, ...vector(0x0b, 2, ...unsigned(offset))],
  store32_lane: (at, value, offset = 0) => [...at, ...value, ...vector(0x5a, 2, ...unsigned(offset), 0)],
};
const f32x4 = {
  eq: binary(...vector(0x41)), lt: binary(...vector(0x43)), nearest: unary(...vector(0x6a)), sqrt: unary(...vector(0xe3)),
  add: binary(...vector(0xe4)), sub: binary(...vector(0xe5)), mul: binary(...vector(0xe6)),
  div: binary(...vector(0xe7)), max: binary(...vector(0xe9)), convert_i32x4_s: unary(...vector(0xfa)),
  splat: (value) => v128.const([...new Uint8Array(new Float32Array(4).fill(value).buffer)]),
};
const i32x4 = {
  splat: unary(...vector(0x11)), lt_s: binary(...vector(0x39)), bitmask: unary(...vector(0xa4)),
  shl: binary(...vector(0xab)), shr_s: binary(...vector(0xac)),
  add: binary(...vector(0xae)), sub: binary(...vector(0xb1)), mul: binary(...vector(0xb5)),
};
const i8x16 = {
  swizzle: binary(...vector(0x0e)), shuffle: (value, bytes) => [...value, ...value, ...vector(0x0d, ...bytes)],
};
// a b + c, in one instruction where the browser has it, which rounds once.
const products = [
  (a, b, c) => f32x4.add(f32x4.mul(a, b), c),
  (a, b, c) => [...a, ...b, ...c, ...vector(0x105)],
];
const [INTEGER, VECTOR] = [0x7f, 0x7b];
const [BLOCK, LOOP, IF, END, BR, BR_IF, NO_RESULT] = [0x02, 0x03, 0x04, 0x0b, 0x0c, 0x0d, 0x40];

const zeros = v128.const(new Array(16).fill(0));

// Repeats a body while a local is below a limit; tests before the first time.
function loopBelow(local, limit, body) {
  const leave = [...i32.eqz(i32.lt_u(local.get, limit)), BR_IF, 1];
  return [BLOCK, NO_RESULT, LOOP, NO_RESULT, ...leave, ...body, BR, 0, END, END];
}

// Makers of a function's locals: first `parameters`, then `integers` and `vectors` return as many new ones as asked for.
function makeLocals() {
  const counts = { parameters: 0, runs: [] };
  let made = 0;
  const makerOf = (declare) => (count) => {
    declare(count);
    return Array.from({ length: count }, () => {
      const index = unsigned(made++);
      return { get: [0x20, ...index], set: (value) => [...value, 0x21, ...index] };
    });
  };
  const runOf = (type) => makerOf((count) => counts.runs.push([...unsigned(count), type]));
  const parameters = makerOf((count) => (counts.parameters += count));
  return { counts, parameters, integers: runOf(INTEGER), vectors: runOf(VECTOR) };
}

// Writes the sum of the four lanes of `local` to an address.
function storeSum(at, local, offset = 0) {
  const turned = (by) => i8x16.shuffle(local.get, numbersBelow(16).map((k) => (k + by) % 16));
  return [8, 4].flatMap((by) => local.set(f32x4.add(local.get, turned(by))))
    .concat(v128.store32_lane(at, local.get, offset));
}

// Code that visits particles around one, four at a time: `visit(own, body)` runs `body` where any of four is within
// the radius of the particle at `own` bytes of the positions. Then `inside` masks those that are, `hits` has a bit for
// each, `d` is the vector to them, `squared` its square, and `factor` the spiky kernel over the distance, 0 for itself.
function makeVisits({ integers, vectors }, { dimension, periodic }, constantsAt, positions, ranges, rangesEnd) {
  const [byte, end, hits, at] = integers(4);
  const axes = numbersBelow(dimension);
  const [lanes, squared, inside, distance, factor, left, smooth] = vectors(7), [d, own] = [vectors(3), vectors(3)];
  const constants = vectors(10), [eps, square, weight, slope] = constants;
  const sides = constants.slice(4), perSide = constants.slice(7);
  const toNearest = (a) => f32x4.mul(sides[a].get, f32x4.nearest(f32x4.mul(d[a].get, perSide[a].get)));
  const kernels = [
    ...distance.set(f32x4.sqrt(squared.get)),
    ...left.set(f32x4.sub(square.get, squared.get)),
    ...smooth.set(f32x4.mul(f32x4.mul(weight.get, left.get), f32x4.mul(left.get, left.get))),
    ...factor.set(f32x4.sub(eps.get, distance.get)),
    ...factor.set(f32x4.div(f32x4.mul(slope.get, f32x4.mul(factor.get, factor.get)), distance.get)),
    // Masks the NaN of the particle itself, and lanes behind the last particle.
    ...factor.set(v128.and(factor.get, v128.and(inside.get, f32x4.lt(zeros, squared.get)))),
  ];
  const four = (body) => [
    ...axes.flatMap((a) => [
      ...d[a].set(f32x4.sub(v128.load(i32.add(positions[a].get, byte.get)), own[a].get)),
      ...(periodic ? d[a].set(f32x4.sub(d[a].get, toNearest(a))) : []),
    ]),
    ...squared.set(axes.map((a) => f32x4.mul(d[a].get, d[a].get)).reduce((sum, term) => f32x4.add(sum, term))),
    ...inside.set(v128.and(f32x4.lt(squared.get, square.get), i32x4.lt_s(lanes.get, i32x4.splat(end.get)))),
    ...hits.set(i32x4.bitmask(inside.get)),
    ...hits.get, IF, NO_RESULT, ...kernels, ...body, END,
    ...byte.set(i32.add(byte.get, i32.const(16))),
    ...lanes.set(i32x4.add(lanes.get, i32x4.splat(i32.const(4)))),
  ];
  const firstLanes = v128.const([0, 0, 0, 0, 1, 0, 0, 0, 2, 0, 0, 0, 3, 0, 0, 0]);
  const visit = (particle, body) => [
    ...axes.flatMap((a) => own[a].set(v128.load32_splat(i32.add(positions[a].get, particle)))),
    ...at.set(ranges.get),
    ...loopBelow(at, rangesEnd.get, [
      ...byte.set(i32.mul(i32.load(at.get), i32.const(4))),
      ...lanes.set(i32x4.add(i32x4.splat(i32.load(at.get)), firstLanes)),
      ...end.set(i32.load(i32.add(at.get, i32.const(4)))),
      ...loopBelow(byte, i32.mul(end.get, i32.const(4)), four(body)),
      ...at.set(i32.add(at.get, i32.const(8))),
    ]),
  ];
  const begin = constants.flatMap((local, k) => local.set(v128.load32_splat(constantsAt.get, 4 * k)));
  return { begin, visit, d, inside, hits, factor, smooth, byte, lanes, axes };
}

// sumDensities(constants, X, Y, Z, density, gradientX, gradientY, gradientZ, own, ownEnd, ranges, rangesEnd): of the
// particles from `own` to `ownEnd`, in bytes.
function sumDensitiesCode(space, madd) {
  const { counts, parameters, ...makers } = makeLocals();
  const [constants] = parameters(1), positions = parameters(3), outputs = parameters(4);
  const [own, ownEnd, ranges, rangesEnd] = parameters(4);
  const visits = makeVisits(makers, space, constants, positions, ranges, rangesEnd);
  const { begin, visit, d, inside, factor, smooth, axes } = visits;
  const sums = makers.vectors(1 + space.dimension);
  const code = [
    ...begin,
    ...loopBelow(own, ownEnd.get, [
      ...sums.flatMap((sum) => sum.set(zeros)),
      ...visit(own.get, [
        ...sums[0].set(f32x4.add(sums[0].get, v128.and(smooth.get, inside.get))),
        ...axes.flatMap((a) => sums[1 + a].set(madd(factor.get, d[a].get, sums[1 + a].get))),
      ]),
      ...sums.flatMap((sum, k) => storeSum(i32.add(outputs[k].get, own.get), sum)),
      ...own.set(i32.add(own.get, i32.const(4))),
    ]),
  ];
  return { ...counts, code };
}

// sumNeighbours(states, own, listBytes, stateAt, smoothing, slopeX, slopeY, slopeZ, row, inverse): addresses in bytes;
// `own` is that of the particle's state.
function sumNeighboursCode(width, dimension, madd) {
  const { counts, parameters, integers, vectors } = makeLocals();
  const [states, own, listBytes, stateAt] = parameters(4), lists = parameters(4), [row, inverse] = parameters(2);
  const [done, at] = integers(2), axes = numbersBelow(dimension);
  const [other, offset] = vectors(2), factors = vectors(4), mine = vectors(2), entries = vectors(6), scaled = vectors(3);
  const matrix = [[0, 1, 2], [1, 3, 4], [2, 4, 5]].map((line) => line.map((k) => entries[k]));
  const [length, mantissa, exponent, ratio, square] = vectors(5);
  // The sums of each list, each of two vectors; in 2D the last list is not used.
  const listSums = lists.map(() => vectors(2)).slice(0, dimension + 1);
  const addProduct = (sum, factor, term) => sum.set(madd(factor.get, term.get, sum.get));
  const sumOf = ([[first, second], ...pairs]) =>
    pairs.reduce((sum, [a, b]) => madd(a.get, b.get, sum), f32x4.mul(first.get, second.get));
  const one = f32x4.splat(1), lowest = i32x4.splat(i32.const(0x3f3504f3)); // the bits of √½
  // log m = 2 (t + t³ / 3 + t⁵ / 5 + ...) with t = (m - 1) / (m + 1), for m in [√½, √2).
  const series = [1 / 9, 1 / 7, 1 / 5, 1 / 3, 1].map(f32x4.splat).reduce((sum, term) => madd(sum, square.get, term));
  const logFactor = [
    ...length.set(f32x4.add(f32x4.sqrt(sumOf(axes.map((a) => [scaled[a], scaled[a]]))), one)),
    ...exponent.set(i32x4.shr_s(i32x4.sub(length.get, lowest), i32.const(23))),
    ...mantissa.set(i32x4.sub(length.get, i32x4.shl(exponent.get, i32.const(23)))),
    ...ratio.set(f32x4.div(f32x4.sub(mantissa.get, one), f32x4.add(mantissa.get, one))),
    ...square.set(f32x4.mul(ratio.get, ratio.get)),
    ...ratio.set(f32x4.mul(f32x4.add(ratio.get, ratio.get), series)),
    ...ratio.set(madd(f32x4.convert_i32x4_s(exponent.get), f32x4.splat(Math.LN2), ratio.get)),
    // log(1 + |v|) / |v| from the rounded 1 + |v| in both, which is exact to rounding; 1 where they are 1.
    ...ratio.set(f32x4.div(ratio.get, f32x4.sub(length.get, one))),
    ...ratio.set(v128.bitselect(one, ratio.get, f32x4.eq(length.get, one))),
  ];
  const code = entries.flatMap((entry, k) => entry.set(v128.load32_splat(inverse.get, 4 * k)));
  // Two vectors at a time: their sums stay in registers.
  for (let first = 0; first < width; first += 8) {
    const parts = first + 4 < width ? [0, 1] : [0];
    const byte = (part, k = 0) => 4 * (k * width + first) + 16 * part;
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
      ...parts.flatMap((part) => [
        ...axes.flatMap((a) => scaled[a].set(sumOf(axes.map((b) => [listSums[1 + b][part], matrix[a][b]])))),
        ...logFactor,
        ...v128.store(row.get, mine[part].get, byte(part)),
        ...v128.store(row.get, listSums[0][part].get, byte(part, 1)),
        ...axes.flatMap((a) => v128.store(row.get, f32x4.mul(ratio.get, scaled[a].get), byte(part, 2 + a))),
      ]),
    );
  }
  return { ...counts, code };
}

// listNeighbours(constants, order, X, Y, Z, volume, own, ranges, rangesEnd, width, stateAt, smoothing, slopeX, slopeY,
// slopeZ, out): `order` has for each set of lanes the bytes that bring them to the front; `out` gets the number of
// neighbours and the moment matrix.
function listNeighboursCode(space, madd) {
  const { counts, parameters, ...makers } = makeLocals();
  const [constants, order] = parameters(2), positions = parameters(3);
  const [volume, own, ranges, rangesEnd, width] = parameters(5);
  const [stateAt, smoothing] = parameters(2), slopes = parameters(3), [out] = parameters(1);
  const visits = makeVisits(makers, space, constants, positions, ranges, rangesEnd);
  const { begin, visit, d, hits, factor, smooth, byte, lanes, axes } = visits;
  const [count, at] = makers.integers(2), [front, volumes] = makers.vectors(2), scaled = makers.vectors(3);
  const moment = [makers.vectors(3), makers.vectors(2), makers.vectors(1)]; // the upper triangle, row by row
  const append = (list, code) => v128.store(i32.add(list.get, at.get), i8x16.swizzle(code, front.get));
  const code = [
    ...begin,
    ...visit(own.get, [
      ...volumes.set(v128.load(i32.add(volume.get, byte.get))),
      ...factor.set(f32x4.mul(factor.get, volumes.get)),
      ...axes.flatMap((a) => scaled[a].set(f32x4.mul(factor.get, d[a].get))),
      ...axes.flatMap((a) => axes.slice(a).flatMap((b) =>
        moment[a][b - a].set(madd(scaled[a].get, d[b].get, moment[a][b - a].get)))),
      ...front.set(v128.load(i32.add(order.get, i32.mul(hits.get, i32.const(16))))),
      ...at.set(i32.mul(count.get, i32.const(4))),
      ...append(stateAt, i32x4.mul(lanes.get, i32x4.splat(width.get))),
      ...append(smoothing, f32x4.mul(smooth.get, volumes.get)),
      ...axes.flatMap((a) => append(slopes[a], scaled[a].get)),
      ...count.set(i32.add(count.get, i32.popcnt(hits.get))),
    ]),
    ...i32.store(out.get, count.get),
    ...moment.flat().flatMap((entry, k) => storeSum(out.get, entry, 4 + 4 * k)),
  ];
  return { ...counts, code };
}

// applyLayer(rows, rowBytes, rowEnd, weights, bias, outputs, outputBytes, inputBytes, limit, tiles): for all
// rows out = W in + b, and max(out, 0) where `limit` is 1. Weights lie tile by tile: [tiles, inputs, 8], inputs padded.
function applyLayerCode(madd) {
  const { counts, parameters, integers, vectors } = makeLocals();
  const [rows, rowBytes, rowEnd, weights, bias, outputs, outputBytes, inputBytes, limit, tiles] = parameters(10);
  const [row, input, weight, out, tile] = integers(5), at = integers(4);
  const [left, right, spread, other] = vectors(4), sums = at.map(() => vectors(2));
  const addProduct = (sum, four) => sum.set(madd(spread.get, four.get, sum.get));
  const limited = (sum, byte) => [
    ...other.set(sum.get),
    ...v128.store(out.get, select(f32x4.max(other.get, zeros), other.get, limit.get), byte),
  ];
  const inner = [
    ...at.flatMap((each, k) => each.set(i32.add(row.get, i32.add(i32.mul(rowBytes.get, i32.const(k)), input.get)))),
    ...numbersBelow(4).flatMap((p) => [
      ...left.set(v128.load(weight.get, 4 * TILE_OUTPUTS * p)),
      ...right.set(v128.load(weight.get, 4 * TILE_OUTPUTS * p + 16)),
      ...sums.flatMap(([leftSum, rightSum], k) => [
        ...spread.set(v128.load32_splat(at[k].get, 4 * p)), ...addProduct(leftSum, left), ...addProduct(rightSum, right),
      ]),
    ]),
    ...weight.set(i32.add(weight.get, i32.const(16 * TILE_OUTPUTS))),
    ...input.set(i32.add(input.get, i32.const(16))),
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
  const types = named.map(([, body]) => [0x60, ...list(new Array(body.parameters).fill([INTEGER])), 0]);
  const imports = [[...text("page"), ...text("memory"), 0x02, 0x00, ...unsigned(MEMORY_PAGES)]];
  const exported = named.map(([name], index) => [...text(name), 0x00, ...unsigned(index)]);
  const bodies = named.map(([, { runs, code }]) => {
    const body = [...list(runs), ...code, END];
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

// Kernels for states of some width (channels, padded to a multiple of four) in 2D or 3D, in a periodic box or none; the
// plain ones where the browser has no WebAssembly with vectors, or does not let the page use it.
export function fastestKernels(width, dimension, periodic) {
  try {
    return simdKernels(width, dimension, periodic);
  } catch {
    return plainKernels();
  }
}

export function simdKernels(width, dimension, periodic = true) {
  const space = { dimension, periodic };
  const modules = products.map((madd) => assemble({
    sumDensities: sumDensitiesCode(space, madd), listNeighbours: listNeighboursCode(space, madd),
    sumNeighbours: sumNeighboursCode(width, dimension, madd), applyLayer: applyLayerCode(madd),
  }));
  const memory = new WebAssembly.Memory({ initial: MEMORY_PAGES });
  const code = modules.findLast(WebAssembly.validate) ?? modules[0];
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

  // For each set of four lanes the bytes that bring them to the front, in order: [16, 16].
  const order = reserve(Uint8Array, 256).fill(0xff);
  for (let set = 0; set < 16; set++) {
    const bytes = [0, 1, 2, 3].filter((lane) => set & (1 << lane)).flatMap((lane) => [0, 1, 2, 3].map((k) => 4 * lane + k));
    order.set(bytes, 16 * set);
  }
  const out = floats(1 + 6);
  const neighbourCount = new Int32Array(memory.buffer, out.byteOffset, 1);

  function sumDensities({ constants, points: { x, y, z }, density, gradient, ranges, rangesEnd }, first, end) {
    run.sumDensities(
      constants.byteOffset, x.byteOffset, y.byteOffset, z.byteOffset, density.byteOffset,
      gradient[0].byteOffset, gradient[1].byteOffset, gradient[2].byteOffset, 4 * first, 4 * end,
      ranges.byteOffset, ranges.byteOffset + 4 * rangesEnd,
    );
  }

  function listNeighbours({ constants, points: { x, y, z, volume }, ranges, rangesEnd, list }, i) {
    const { stateAt, smoothing, slopes } = list;
    run.listNeighbours(
      constants.byteOffset, order.byteOffset, x.byteOffset, y.byteOffset, z.byteOffset, volume.byteOffset, 4 * i,
      ranges.byteOffset, ranges.byteOffset + 4 * rangesEnd, width, stateAt.byteOffset, smoothing.byteOffset,
      slopes[0].byteOffset, slopes[1].byteOffset, slopes[2].byteOffset, out.byteOffset,
    );
    list.count = neighbourCount[0];
    for (let k = 0; k < 6; k++) list.moment[k] = out[1 + k];
  }

  function sumNeighbours({ states, list: { count, stateAt, smoothing, slopes }, rows, inverse }, i, at) {
    run.sumNeighbours(
      states.byteOffset, states.byteOffset + 4 * i * width, 4 * count, stateAt.byteOffset, smoothing.byteOffset,
      slopes[0].byteOffset, slopes[1].byteOffset, slopes[2].byteOffset, rows.byteOffset + 4 * at,
      inverse.byteOffset,
    );
  }

  // Rows are taken four at a time: arrays have room for a multiple of them.
  function applyLayer({ inputs, width, weights, offset }, count, rows, rowWidth, out, rectified) {
    const end = rows.byteOffset + 4 * rowWidth * TILE_ROWS * Math.ceil(count / TILE_ROWS);
    run.applyLayer(
      rows.byteOffset, 4 * rowWidth, end, weights.byteOffset, offset.byteOffset,
      out.byteOffset, 4 * width, 4 * padded(inputs), rectified ? 1 : 0, width / TILE_OUTPUTS,
    );
  }

  return {
    name: "WebAssembly", floats, integers: (length) => reserve(Int32Array, length),
    sumDensities, listNeighbours, sumNeighbours,
    makeLayer: (...matrix) => tiledLayer(floats, ...matrix), applyLayer,
  };
}
