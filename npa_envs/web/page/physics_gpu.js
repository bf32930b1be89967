// The step of physics.js on the GPU, through WebGPU. The CPU only counts which particles each cell has, and chooses
// active ones. The head of physics.js says which formulas are here as well.

import { CELLS_PER_RADIUS, MAX_CELLS, MOMENT_THRESHOLD, numbersBelow, SQUARED_MOMENT_SOFTENING } from "./physics.js";

const GROUP = 64;
const UNIFORM_BYTES = 96;
const SPAN = 2 * CELLS_PER_RADIUS + 1;

// Returns a device of the browser, or null.
export async function openDevice() {
  const adapter = await navigator.gpu?.requestAdapter({ powerPreference: "high-performance" });
  return adapter ? adapter.requestDevice() : null;
}

// The shaders are WGSL. Loops over quads, four numbers at a time, are written out, so that their variables stay in
// registers.
const each = (count, text) => numbersBelow(count).map(text).join("\n    ");

// Runs `body`, WGSL that may read j, d, w and spike, for all neighbours j of sorted particle k, itself included: the
// vector d to it, the smoothing kernel w there, and `spike`, where spike d is the spiky kernel's gradient. Cells of a row
// are contiguous: `counts` on each axis, from `first` on, of which a row has `before` up to the end of the grid.
function visitNeighbours(body) {
  return `
    let own = points[k].xyz;
    let cell = indices[world.capacity + indices[k]];
    let at = vec3u(cell % world.cells.x, (cell / world.cells.x) % world.cells.y, cell / (world.cells.x * world.cells.y));
    let counts = min(world.cells.xyz, vec3u(${SPAN}));
    // In a small box each cell is visited once.
    let around = (at + world.cells.xyz - vec3u(${CELLS_PER_RADIUS})) % world.cells.xyz;
    let first = select(around, vec3u(0), counts < vec3u(${SPAN}));
    let before = min(counts.x, world.cells.x - first.x);
    for (var cz = 0u; cz < counts.z; cz++) {
      for (var cy = 0u; cy < counts.y; cy++) {
        let there = (first + vec3u(0, cy, cz)) % world.cells.xyz;
        let row = 3 * world.capacity + (there.z * world.cells.y + there.y) * world.cells.x;
        for (var part = 0u; part < 2; part++) {
          let end = indices[row + select(counts.x - before, first.x + before, part == 0)];
          for (var j = indices[row + select(0, first.x, part == 0)]; j < end; j++) {
            var d = points[j].xyz - own;
            d -= world.sides.xyz * round(d * world.per.xyz);
            let square = dot(d, d);
            if (square >= world.eps * world.eps) { continue; }
            let left = world.eps * world.eps - square;
            let length = sqrt(square);
            let w = world.weight * left * left * left;
            let spike = select(0.0, world.slope * (world.eps - length) * (world.eps - length) / length, square > 0.0);
            ${body}
          }
        }
      }
    }`;
}

// The adjugate and the determinant of the moment matrix, by the dimension.
const ADJUGATES = {
  2: "let adjugate = array<f32, 6>(yy, -xy, 0.0, xx, 0.0, 0.0); let determinant = xx * yy - xy * xy;",
  3: `let adjugate = array<f32, 6>(yy * zz - yz * yz, xz * yz - xy * zz, xy * yz - xz * yy,
        xx * zz - xz * xz, xy * xz - xx * yz, xx * yy - xy * xy);
      let determinant = xx * adjugate[0] + xy * adjugate[1] + xz * adjugate[2];`,
};

// The moment matrix's inverse m from both, by NPARule's `moment_inverse`.
const INVERSES = {
  smooth: `let divisor = determinant * determinant + ${SQUARED_MOMENT_SOFTENING};
      ${each(6, (n) => `m[${n}] = (determinant * adjugate[${n}] + ${SQUARED_MOMENT_SOFTENING} * m[${n}]) / divisor;`)}`,
  threshold: `if (abs(determinant) >= ${MOMENT_THRESHOLD}) { ${each(6, (n) => `m[${n}] = adjugate[${n}] / determinant;`)} }`,
};

// The shaders, in the order in which they run, and whether they read or write the buffers of bindings 1 to 7: cards may
// cache what a shader only reads. `place` sorts copies of particles.
const SHADERS = { place: "wwrww--", density: "--rr-w-", advance: "wwrrrrr" };

// The shaders of one rule: sizes are constants in them.
export function shaders({ state_dim: channels, space_dim: dimension, inputs, hidden_dim: hidden, outputs, ...rule }) {
  const axes = ["x", "y", "z"].slice(0, dimension);
  const quads = Math.ceil(channels / 4), inputQuads = inputs / 4, outputQuads = Math.ceil(outputs / 4);
  const state = (c) => (c < channels ? `s[i * ${channels} + ${c}]` : "0.0");
  const update = (a) => `y${a >> 2}.${"xyzw"[a & 3]}`;
  const moved = rule.static ? 0 : dimension;
  return `
  struct World {
    sides: vec4f, per: vec4f, cells: vec4u,
    eps: f32, weight: f32, slope: f32, scale: f32, densityScale: f32, reach: f32, deadZone: f32,
    capacity: u32, count: u32, firstRow: u32, rows: u32,
  }
  @group(0) @binding(0) var<uniform> world: World;
  @group(0) @binding(1) var<storage, read_write> x: array<f32>;
  @group(0) @binding(2) var<storage, read_write> s: array<f32>;
  // In parts of world.capacity: particles sorted by cell; the cell of each particle; the active of sorted ones; and
  // where each cell begins.
  @group(0) @binding(3) var<storage, read> indices: array<u32>;
  @group(0) @binding(4) var<storage, read> points: array<vec4f>;
  @group(0) @binding(4) var<storage, read_write> newPoints: array<vec4f>;
  @group(0) @binding(5) var<storage, read> states: array<vec4f>;
  @group(0) @binding(5) var<storage, read_write> newStates: array<vec4f>;
  // The density's gradient, and the volume.
  @group(0) @binding(6) var<storage, read> fields: array<vec4f>;
  @group(0) @binding(6) var<storage, read_write> newFields: array<vec4f>;
  @group(0) @binding(7) var<storage, read> weights: array<vec4f>;

  // log(1 + n) / n; for small n without the logarithm, which would lose digits.
  fn logFactor(n: vec4f) -> vec4f {
    return select(log(1.0 + n) / max(n, vec4f(1e-30)), 1.0 - 0.5 * n + n * n / 3.0, n < vec4f(0.01));
  }

  @compute @workgroup_size(${GROUP})
  fn place(@builtin(global_invocation_id) id: vec3u) {
    let k = id.x;
    if (k >= world.count) { return; }
    let i = indices[k];
    let p = vec3f(${["x", "y", "z"].map((_, d) => (d < dimension ? `x[i * ${dimension} + ${d}]` : "0.0"))});
    newPoints[k] = vec4f(p - world.sides.xyz * floor(p * world.per.xyz + 0.5), 0.0);
    ${each(quads, (q) => `newStates[k * ${quads} + ${q}] = vec4f(${numbersBelow(4).map((n) => state(4 * q + n))});`)}
  }

  @compute @workgroup_size(${GROUP})
  fn density(@builtin(global_invocation_id) id: vec3u) {
    let k = id.x;
    if (k >= world.count) { return; }
    var rho = 0.0;
    var gradient = vec3f(0.0);
    ${visitNeighbours("rho += w; gradient += spike * d;")}
    newFields[k] = vec4f(gradient, 1.0 / rho);
  }

  @compute @workgroup_size(${GROUP})
  fn advance(@builtin(global_invocation_id) id: vec3u) {
    if (id.x >= world.rows) { return; }
    let k = indices[2 * world.capacity + world.firstRow + id.x];
    let i = indices[k];
    // The perception vector: the state, the smoothed state, its slopes along each axis, the density's slopes and 1.
    ${each(inputQuads, (q) => `var z${q} = ${q < quads ? `states[k * ${quads} + ${q}]` : "vec4f(0.0)"};`)}
    var xx = 0.0; var xy = 0.0; var xz = 0.0; var yy = 0.0; var yz = 0.0; var zz = 0.0;
    ${visitNeighbours(`
            let volume = fields[j].w;
            let t = spike * volume * d;
            xx += t.x * d.x; xy += t.x * d.y; xz += t.x * d.z; yy += t.y * d.y; yz += t.y * d.z; zz += t.z * d.z;
            ${each(quads, (q) => `{
              let other = states[j * ${quads} + ${q}];
              z${quads + q} += w * volume * other;
              ${axes.map((axis, d) => `z${(2 + d) * quads + q} += t.${axis} * (other - z${q});`).join(" ")}
            }`)}`)}
    var m = array<f32, 6>(1.0, 0.0, 0.0, 1.0, 0.0, 1.0);
    ${rule.moment_correction ? `{ ${ADJUGATES[dimension]} ${INVERSES[rule.moment_inverse]} }` : ""}
    ${each(quads, (q) => {
      const [gx, gy, gz = "vec4f(0.0)"] = axes.map((_, d) => `z${(2 + d) * quads + q}`);
      return `{
      let vx = world.scale * (${gx} * m[0] + ${gy} * m[1] + ${gz} * m[2]);
      let vy = world.scale * (${gx} * m[1] + ${gy} * m[3] + ${gz} * m[4]);
      let vz = world.scale * (${gx} * m[2] + ${gy} * m[4] + ${gz} * m[5]);
      let factor = logFactor(sqrt(vx * vx + vy * vy + vz * vz));
      ${axes.map((axis, d) => `z${(2 + d) * quads + q} = factor * v${axis};`).join(" ")}
    }`;
    })}
    let slope = world.densityScale * fields[k].xyz;
    z${inputQuads - 1} = vec4f(logFactor(vec4f(length(slope))).xyz * slope, 1.0);
    ${each(outputQuads, (q) => `var y${q} = vec4f(0.0);`)}
    for (var h = 0u; h < ${hidden}; h++) {
      let at = h * ${inputQuads + outputQuads};
      var four = weights[at] * z0;
      ${each(inputQuads - 1, (q) => `four += weights[at + ${q + 1}] * z${q + 1};`)}
      let sum = max(four.x + four.y + four.z + four.w, 0.0);
      ${each(outputQuads, (q) => `y${q} += sum * weights[at + ${inputQuads + q}];`)}
    }
    ${each(outputQuads, (q) => `y${q} = select(y${q}, vec4f(0.0), abs(y${q}) <= vec4f(world.deadZone));`)}
    let reach = world.reach / (1.0 + sqrt(0.0${numbersBelow(moved).map((d) => ` + ${update(d)} * ${update(d)}`).join("")}));
    ${each(moved, (d) => `x[i * ${dimension} + ${d}] += reach * ${update(d)};`)}
    ${each(channels, (c) => `${state(c)} += ${update(moved + c)};`)}
  }`;
}

// The weights as `advance` reads them, hidden unit by hidden unit: those of its inputs, then of its outputs.
function packedWeights({ matrix, inputs, outputs, hidden_dim: hidden, weights }) {
  const stride = inputs + 4 * Math.ceil(outputs / 4), packed = new Float32Array(hidden * stride);
  for (let h = 0; h < hidden; h++) {
    packed.set(matrix.subarray(h * inputs, (h + 1) * inputs), h * stride);
    for (let a = 0; a < outputs; a++) packed[h * stride + inputs + a] = weights["output.weight"][a * hidden + h];
  }
  return packed;
}

// Physics on the GPU; `step` returns a promise.
export class GpuPhysics {
  // Makes an instance; throws if the device refuses a shader or a buffer.
  static async make(device, physics) {
    for (const kind of ["out-of-memory", "validation"]) device.pushErrorScope(kind);
    const gpu = new GpuPhysics(device, physics);
    const error = [await device.popErrorScope(), await device.popErrorScope()].find((entry) => entry !== null);
    if (error) throw Error(error.message);
    return gpu;
  }

  // physics: a Physics of the same rules, whose order of particles is used.
  constructor(device, physics) {
    this.device = device;
    this.physics = physics;
    const { capacity, width, dimension, channels, rules } = physics;
    const { STORAGE, UNIFORM, COPY_DST, COPY_SRC, MAP_READ } = GPUBufferUsage;
    this.buffers = [];
    const buffer = (size, usage) => {
      this.buffers.push(device.createBuffer({ size: 16 * Math.ceil(size / 16), usage }));
      return this.buffers.at(-1);
    };
    this.x = buffer(4 * dimension * capacity, STORAGE | COPY_DST | COPY_SRC);
    this.s = buffer(4 * channels * capacity, STORAGE | COPY_DST | COPY_SRC);
    this.indices = buffer(4 * (3 * capacity + MAX_CELLS[dimension] ** dimension + 1), STORAGE | COPY_DST);
    this.mapped = buffer(4 * (dimension + channels) * capacity, MAP_READ | COPY_DST);
    const sorted = [16, 4 * width, 16].map((bytes) => buffer(bytes * capacity, STORAGE));
    const types = { u: "uniform", r: "read-only-storage", w: "storage" };
    this.species = rules.map((rule) => {
      const module = device.createShaderModule({ code: shaders(rule) }), packed = packedWeights(rule);
      const weights = buffer(packed.byteLength, STORAGE | COPY_DST);
      device.queue.writeBuffer(weights, 0, packed);
      const world = buffer(UNIFORM_BYTES, UNIFORM | COPY_DST);
      const buffers = [world, this.x, this.s, this.indices, ...sorted, weights];
      const stages = Object.entries(SHADERS).map(([entryPoint, uses]) => {
        const bindings = [...buffers.keys()].filter((binding) => `u${uses}`[binding] !== "-");
        const entry = (binding) => ({
          binding, visibility: GPUShaderStage.COMPUTE, buffer: { type: types[`u${uses}`[binding]] },
        });
        const layout = device.createBindGroupLayout({ entries: bindings.map(entry) });
        const group = device.createBindGroup({
          layout, entries: bindings.map((binding) => ({ binding, resource: { buffer: buffers[binding] } })),
        });
        const pipeline = device.createComputePipeline({
          layout: device.createPipelineLayout({ bindGroupLayouts: [layout] }), compute: { module, entryPoint },
        });
        return { group, pipeline };
      });
      return { rule, world, stages };
    });
    this.chosen = new Uint32Array(capacity);
  }

  async step(world, { eps, box = null, mask = null, noise = null, densityCounts = null }) {
    const { physics, device, chosen } = this, { count, x, s, species } = world;
    physics.orderByCell(x, count, physics.setGrid(x, count, eps, box));
    const { order, cellOf, starts, cellCount, capacity } = physics;
    const write = (buffer, array, length, at = 0) => device.queue.writeBuffer(buffer, 4 * at, array, 0, length);
    const encoder = device.createCommandEncoder();
    const pass = encoder.beginComputePass();
    let rows = 0;
    this.species.forEach(({ rule, world: uniform, stages }, number) => {
      const firstRow = rows;
      for (let k = 0; k < count; k++) {
        if (species[order[k]] === number && (mask === null || mask[order[k]] !== 0)) chosen[rows++] = k;
      }
      write(uniform, uniforms(physics, rule, count, firstRow, rows - firstRow, densityCounts?.[number] ?? count));
      const threads = [count, count, rows - firstRow];
      stages.forEach(({ group, pipeline }, n) => {
        if (threads[n] === 0 || (n < 2 && number > 0)) return;
        pass.setPipeline(pipeline);
        pass.setBindGroup(0, group);
        pass.dispatchWorkgroups(Math.ceil(threads[n] / GROUP));
      });
    });
    pass.end();
    write(this.x, x, x.length);
    write(this.s, s, s.length);
    const parts = [[order, count], [cellOf, count], [chosen, rows], [starts, cellCount + 1]];
    parts.forEach(([array, length], part) => write(this.indices, array, length, part * capacity));
    encoder.copyBufferToBuffer(this.x, 0, this.mapped, 0, x.byteLength);
    encoder.copyBufferToBuffer(this.s, 0, this.mapped, x.byteLength, s.byteLength);
    device.queue.submit([encoder.finish()]);
    const bytes = x.byteLength + s.byteLength;
    await this.mapped.mapAsync(GPUMapMode.READ, 0, bytes);
    const result = new Float32Array(this.mapped.getMappedRange(0, bytes));
    x.set(result.subarray(0, x.length));
    s.set(result.subarray(x.length));
    this.mapped.unmap();
    physics.finish(world, noise, box);
  }

  close() {
    for (const buffer of this.buffers) buffer.destroy();
  }
}

function uniforms(physics, rule, count, firstRow, rows, densityCount) {
  const { sides, perSide, cells, dimension, eps, weight, slope, capacity } = physics;
  const bytes = new ArrayBuffer(UNIFORM_BYTES);
  const floats = new Float32Array(bytes), integers = new Uint32Array(bytes);
  floats.set(sides);
  floats.set(perSide, 4);
  integers.set(cells, 8);
  const scale = eps / rule.eps0;
  floats.set([eps, weight, slope, scale, scale ** (1 + dimension) / densityCount, rule.alpha * eps, rule.dead_zone], 12);
  integers.set([capacity, count, firstRow, rows], 19);
  return floats;
}
