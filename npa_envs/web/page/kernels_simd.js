// The kernels of `plainKernels` of physics.js in WebAssembly, whose vectors of four float32 make a step more than twice
// as fast. The page builds the module when it starts: `xCode` writes kernel x by functions that return the
// bytes of instructions (the assembler below), and `assemble` joins the kernels. So no compiler is needed, and sizes
// are constants in the code. Instructions and format: https://webassembly.github.io/spec/core/binary/.

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
const get = (local) => [0x20, ...unsigned(local)];
const set = (local, value) => [...value, 0x21, ...unsigned(local)];
const when = (condition, body) => [...condition, 0x04, 0x40, ...body, 0x0b];
const select = (yes, no, condition) => [...yes, ...no, ...condition, 0x1b];

// Integers.
const number = (value) => [0x41, ...signed(value)];
const add = binary(0x6a), multiply = binary(0x6c), below = binary(0x49), ones = unary(0x69);
const loadInteger = unary(0x28, 2, 0), storeInteger = binary(0x36, 2, 0);

// Vectors of four floats, and of four integers.
const constant = (bytes) => vector(0x0c, ...bytes);
const load = (at, offset = 0) => [...at, ...vector(0x00, 2, ...unsigned(offset))];
const loadSplat = (at, offset = 0) => [...at, ...vector(0x09, 2, ...unsigned(offset))];
const store = (at, value, offset = 0) => [...at, ...value, ...vector(0x0b, 2, ...unsigned(offset))];
const plus = binary(...vector(0xe4)), minus = binary(...vector(0xe5)), times = binary(...vector(0xe6));
const over = binary(...vector(0xe7)), root = unary(...vector(0xe3)), nearest = unary(...vector(0x6a));
const larger = binary(...vector(0xe9)), less = binary(...vector(0x43)), and = binary(...vector(0x4e));
const spreadInteger = unary(...vector(0x11)), bits = unary(...vector(0xa4));
const plusIntegers = binary(...vector(0xae)), timesIntegers = binary(...vector(0xb5));
const lessIntegers = binary(...vector(0x39)), shuffled = binary(...vector(0x0e));

const zeros = constant(new Array(16).fill(0));

// Repeats a body while a local is below a limit; tests before the first time.
function loopBelow(local, limit, body) {
  return [0x02, 0x40, 0x03, 0x40, ...below(get(local), limit), 0x45, 0x0d, 1, ...body, 0x0c, 0, 0x0b, 0x0b];
}

// A function's locals by name: its parameters and other integers, then vectors; `counts` are how many.
function namedLocals(parameters, integers, vectors) {
  const names = [...parameters, ...integers, ...vectors];
  const local = (name) => names.indexOf(name);
  return {
    local, value: (name) => get(local(name)), put: (name, code) => set(local(name), code),
    counts: { parameters: parameters.length, integers: integers.length, vectors: vectors.length },
  };
}

// The axes, and the factors of a particle's neighbours in the sums.
const AXES = ["X", "Y", "Z"], LISTS = ["smoothing", "slopeX", "slopeY", "slopeZ"];

// sumNeighbours(states, own, listBytes, stateAt, smoothing, slopeX, slopeY, slopeZ, sums): addresses in bytes; `own` is
// that of the particle's state.
function sumNeighboursCode(width, dimension) {
  const lists = LISTS.slice(0, dimension + 1);
  const { local, value, put, counts } = namedLocals(
    ["states", "own", "listBytes", "stateAt", ...LISTS, "sums"],
    ["done", "at"],
    [
      "other", "offset", ...LISTS.map((list) => `spread ${list}`), "mine 0", "mine 1",
      ...LISTS.flatMap((list) => [`sum ${list} 0`, `sum ${list} 1`]),
    ],
  );
  const code = [];
  // Two vectors at a time: their sums stay in registers.
  for (let first = 0; first < width; first += 8) {
    const parts = first + 4 < width ? [0, 1] : [0];
    const byte = (part) => 4 * first + 16 * part;
    const addNeighbour = (list, part) => {
      const sum = `sum ${list} ${part}`, factor = value(list === "smoothing" ? "other" : "offset");
      return put(sum, plus(value(sum), times(value(`spread ${list}`), factor)));
    };
    const neighbour = [
      ...put("at", add(value("states"), multiply(loadInteger(add(value("stateAt"), value("done"))), number(4)))),
      ...lists.flatMap((list) => put(`spread ${list}`, loadSplat(add(value(list), value("done"))))),
      ...parts.flatMap((part) => [
        ...put("other", load(value("at"), byte(part))),
        ...put("offset", minus(value("other"), value(`mine ${part}`))),
        ...lists.flatMap((list) => addNeighbour(list, part)),
      ]),
      ...put("done", add(value("done"), number(4))),
    ];
    code.push(
      ...parts.flatMap((part) => [
        ...put(`mine ${part}`, load(value("own"), byte(part))),
        ...lists.flatMap((list) => put(`sum ${list} ${part}`, zeros)),
      ]),
      ...put("done", number(0)),
      ...loopBelow(local("done"), value("listBytes"), neighbour),
      ...parts.flatMap((part) => lists.flatMap((list, k) =>
        store(value("sums"), value(`sum ${list} ${part}`), 4 * width * k + byte(part)))),
    );
  }
  return { ...counts, code };
}

// The particle whose neighbours `listNeighbours` lists, and constants of the step: each a word in memory.
const SCALARS = ["x", "y", "z", "eps", "square", "weight", "slope", "sideX", "sideY", "sideZ", "perX", "perY", "perZ"];

// listNeighbours(scalars, order, X, Y, Z, volume, ranges, rangesEnd, width, stateAt, smoothing, slopeX, slopeY, slopeZ,
// out): `order` has for each set of lanes the bytes that bring them to the front; `out` gets the number of neighbours,
// and from its 16th byte on six vectors, whose lanes add up to the entries of the moment matrix.
function listNeighboursCode(dimension) {
  const names = namedLocals(
    ["scalars", "order", ...AXES, "volume", "ranges", "rangesEnd", "width", "stateAt", ...LISTS, "out"],
    ["byte", "end", "count", "hits", "at"],
    [
      "lanes", "dX", "dY", "dZ", "squared", "inside", "left", "distance", "factor", "front",
      "XX", "XY", "XZ", "YY", "YZ", "ZZ", "sX", "sY", "sZ",
      ...SCALARS.map((name) => `scalar ${name}`),
    ],
  );
  const { local, value, put, counts } = names;
  const scalar = (name) => value(`scalar ${name}`);
  const axes = AXES.slice(0, dimension);
  const offset = (axis) => {
    const difference = value(`d${axis}`);
    return [
      ...put(`d${axis}`, minus(load(add(value(axis), value("byte"))), scalar(axis.toLowerCase()))),
      ...put(`d${axis}`, minus(difference, times(scalar(`side${axis}`), nearest(times(difference, scalar(`per${axis}`)))))),
    ];
  };
  const squares = axes.map((axis) => times(value(`d${axis}`), value(`d${axis}`)));
  const four = [
    ...axes.flatMap(offset),
    ...put("squared", squares.reduce((sum, square) => plus(sum, square))),
    ...put("inside", and(less(value("squared"), scalar("square")), lessIntegers(value("lanes"), spreadInteger(value("end"))))),
    ...put("hits", bits(value("inside"))),
    ...when(value("hits"), appendNeighboursCode(names, axes)),
    ...put("byte", add(value("byte"), number(16))),
    ...put("lanes", plusIntegers(value("lanes"), spreadInteger(number(4)))),
  ];
  const firstLanes = constant([0, 0, 0, 0, 1, 0, 0, 0, 2, 0, 0, 0, 3, 0, 0, 0]);
  const range = [
    ...put("byte", multiply(loadInteger(value("ranges")), number(4))),
    ...put("lanes", plusIntegers(spreadInteger(loadInteger(value("ranges"))), firstLanes)),
    ...put("end", loadInteger(add(value("ranges"), number(4)))),
    ...loopBelow(local("byte"), multiply(value("end"), number(4)), four),
    ...put("ranges", add(value("ranges"), number(8))),
  ];
  const code = [
    ...SCALARS.flatMap((name, k) => put(`scalar ${name}`, loadSplat(value("scalars"), 4 * k))),
    ...loopBelow(local("ranges"), value("rangesEnd"), range),
    ...storeInteger(value("out"), value("count")),
    ...["XX", "XY", "XZ", "YY", "YZ", "ZZ"].flatMap((name, k) => store(value("out"), value(name), 16 + 16 * k)),
  ];
  return { ...counts, code };
}

// The part of `listNeighbours` that appends those of four particles that are neighbours.
function appendNeighboursCode({ value, put }, axes) {
  const scalar = (name) => value(`scalar ${name}`);
  const append = (list, code) => store(add(value(list), value("at")), shuffled(code, value("front")));
  return [
    ...put("distance", root(value("squared"))),
    ...put("left", minus(scalar("square"), value("squared"))),
    ...put("factor", minus(scalar("eps"), value("distance"))),
    ...put("factor", over(times(scalar("slope"), times(value("factor"), value("factor"))), value("distance"))),
    ...put("factor", times(value("factor"), load(add(value("volume"), value("byte"))))),
    // Masks the NaN of the particle itself, and lanes behind the last particle.
    ...put("factor", and(value("factor"), and(value("inside"), less(zeros, value("squared"))))),
    ...axes.flatMap((axis) => put(`s${axis}`, times(value("factor"), value(`d${axis}`)))),
    ...axes.flatMap((axis, k) => axes.slice(k).flatMap((other) =>
      put(axis + other, plus(value(axis + other), times(value(`s${axis}`), value(`d${other}`)))))),
    ...put("front", load(add(value("order"), multiply(value("hits"), number(16))))),
    ...put("at", multiply(value("count"), number(4))),
    ...append("stateAt", timesIntegers(value("lanes"), spreadInteger(value("width")))),
    ...append("smoothing", times(
      times(scalar("weight"), times(value("left"), times(value("left"), value("left")))),
      load(add(value("volume"), value("byte"))),
    )),
    ...axes.flatMap((axis) => append(`slope${axis}`, value(`s${axis}`))),
    ...put("count", add(value("count"), ones(value("hits")))),
  ];
}

// For each set of four lanes the bytes that bring them to the front, in order: [16, 16].
function lanesToFront() {
  const order = new Uint8Array(256).fill(0xff);
  for (let set = 0; set < 16; set++) {
    const lanes = [0, 1, 2, 3].filter((lane) => set & (1 << lane));
    lanes.forEach((lane, k) => {
      for (let byte = 0; byte < 4; byte++) order[16 * set + 4 * k + byte] = 4 * lane + byte;
    });
  }
  return order;
}

// applyLayer(rows, rowBytes, rowEnd, weights, bias, outputs, outputBytes, inputBytes, limit, tiles): for all
// rows out = W in + b, and max(out, 0) where `limit` is 1. Weights lie tile by tile: [tiles, inputs, 8].
function applyLayerCode() {
  const four = [0, 1, 2, 3];
  const { local, value, put, counts } = namedLocals(
    ["rows", "rowBytes", "rowEnd", "weights", "bias", "outputs", "outputBytes", "inputBytes", "limit", "tiles"],
    ["row", "input", "weight", "out", "tile", ...four.map((k) => `at ${k}`)],
    ["left", "right", "spread", "other", ...four.flatMap((k) => [`left ${k}`, `right ${k}`])],
  );
  const addProduct = (sum, weights) => put(sum, plus(value(sum), times(value("spread"), value(weights))));
  const limited = (sum, byte) => [
    ...put("other", value(sum)),
    ...store(value("out"), select(larger(value("other"), zeros), value("other"), value("limit")), byte),
  ];
  const inner = [
    ...put("left", load(value("weight"))), ...put("right", load(value("weight"), 16)),
    ...four.flatMap((k) => [
      ...put("spread", loadSplat(add(value(`at ${k}`), value("input")))),
      ...addProduct(`left ${k}`, "left"), ...addProduct(`right ${k}`, "right"),
    ]),
    ...put("weight", add(value("weight"), number(4 * TILE_OUTPUTS))),
    ...put("input", add(value("input"), number(4))),
  ];
  const perRows = [
    ...four.flatMap((k) => [
      ...put(`at ${k}`, add(value("row"), multiply(value("rowBytes"), number(k)))),
      ...put(`left ${k}`, load(value("bias"))), ...put(`right ${k}`, load(value("bias"), 16)),
    ]),
    ...put("weight", value("weights")), ...put("input", number(0)),
    ...loopBelow(local("input"), value("inputBytes"), inner),
    ...four.flatMap((k) => [
      ...limited(`left ${k}`, 0), ...limited(`right ${k}`, 16),
      ...put("out", add(value("out"), value("outputBytes"))),
    ]),
    ...put("row", add(value("row"), multiply(value("rowBytes"), number(TILE_ROWS)))),
  ];
  const perTile = [
    ...put("row", value("rows")),
    ...put("out", add(value("outputs"), multiply(value("tile"), number(4 * TILE_OUTPUTS)))),
    ...loopBelow(local("row"), value("rowEnd"), perRows),
    ...put("weights", add(value("weights"), multiply(value("inputBytes"), number(TILE_OUTPUTS)))),
    ...put("bias", add(value("bias"), number(4 * TILE_OUTPUTS))),
    ...put("tile", add(value("tile"), number(1))),
  ];
  return { ...counts, code: [...put("tile", number(0)), ...loopBelow(local("tile"), value("tiles"), perTile)] };
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
    const body = [...locals, ...code, 0x0b];
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

// Returns a function that makes an array of a kind, for example Float32Array, in unused memory.
function reserveIn(memory) {
  let used = 16;
  return (Kind, length) => {
    const at = used;
    used += 16 * Math.ceil((Kind.BYTES_PER_ELEMENT * length) / 16);
    if (used > MEMORY_PAGES * PAGE_BYTES) throw new RangeError("the world is too large for the kernels' memory");
    return new Kind(memory.buffer, at, length);
  };
}

export function simdKernels(width, dimension) {
  const memory = new WebAssembly.Memory({ initial: MEMORY_PAGES });
  const code = assemble({
    sumNeighbours: sumNeighboursCode(width, dimension), listNeighbours: listNeighboursCode(dimension),
    applyLayer: applyLayerCode(),
  });
  const instance = new WebAssembly.Instance(new WebAssembly.Module(code), { page: { memory } });
  const run = instance.exports;
  const reserve = reserveIn(memory);
  const floats = (length) => reserve(Float32Array, length);

  function sumNeighbours({ states, list: { count, stateAt, smoothing, slopes }, sums }, i) {
    const at = states.byteOffset;
    run.sumNeighbours(
      at, at + 4 * i * width, 4 * count, stateAt.byteOffset, smoothing.byteOffset,
      slopes[0].byteOffset, slopes[1].byteOffset, slopes[2].byteOffset, sums.byteOffset,
    );
  }

  const scalars = floats(SCALARS.length);
  const order = reserve(Uint8Array, 256);
  order.set(lanesToFront());
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
