// The step of physics.js with densities, perception and networks on the GPU, through WebGPU. The CPU sorts and moves
// particles, a small part of the time. The head of physics.js says which formulas are here as well.

import { CELLS_PER_RADIUS, MAX_CELLS, MOMENT_THRESHOLD, SQUARED_MOMENT_SOFTENING } from "./physics.js";

const GROUP = 64;
const UNIFORM_BYTES = 96;
const SPAN = 2 * CELLS_PER_RADIUS + 1;

// Returns a device of the browser, or null.
export async function openDevice() {
  const adapter = await navigator.gpu?.requestAdapter({ powerPreference: "high-performance" });
  return adapter ? adapter.requestDevice() : null;
}

// Pieces of shaders, in WGSL. Sorted particle i is at `own`; cells around it: `counts` on each axis, from `first` on.
const CELLS_AROUND = `
    let own = points[i].xyz;
    let cell = home[i];
    let at = vec3u(cell % world.cells.x, (cell / world.cells.x) % world.cells.y, cell / (world.cells.x * world.cells.y));
    let counts = min(world.cells.xyz, vec3u(${SPAN}));
    // In a small box each cell is visited once.
    let first = select(at + world.cells.xyz - vec3u(${CELLS_PER_RADIUS}), vec3u(0), counts < vec3u(${SPAN}));`;

// The vector d from i to particle j, the smoothing kernel w there, and k, where k d is the spiky kernel's gradient.
// `weight` and `slope` are the norms of these kernels; `per` is 1 / side of the box, 0 in open space.
const KERNELS = `
            var d = points[j].xyz - own;
            d -= world.sides.xyz * round(d * world.per.xyz);
            let square = dot(d, d);
            if (square >= world.eps * world.eps) { continue; }
            let left = world.eps * world.eps - square;
            let length = sqrt(square);
            let w = world.weight * left * left * left;
            let k = select(0.0, world.slope * (world.eps - length) * (world.eps - length) / length, square > 0.0);`;

// Runs `body`, WGSL that may read i, j, d, w and k, for all neighbours j of sorted particle i, itself included.
function visitNeighbours(body) {
  return `${CELLS_AROUND}
    for (var cz = 0u; cz < counts.z; cz++) {
      for (var cy = 0u; cy < counts.y; cy++) {
        for (var cx = 0u; cx < counts.x; cx++) {
          let there = (first + vec3u(cx, cy, cz)) % world.cells.xyz;
          let number = (there.z * world.cells.y + there.y) * world.cells.x + there.x;
          for (var j = starts[number]; j < starts[number + 1]; j++) {${KERNELS}
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
  smooth: `
      let divisor = determinant * determinant + ${SQUARED_MOMENT_SOFTENING};
      for (var k = 0; k < 6; k++) { m[k] = (determinant * adjugate[k] + ${SQUARED_MOMENT_SOFTENING} * m[k]) / divisor; }`,
  threshold: `
      if (abs(determinant) >= ${MOMENT_THRESHOLD}) { for (var k = 0; k < 6; k++) { m[k] = adjugate[k] / determinant; } }`,
};

// Writes the components of v along the axes to `z`.
const writeVector = (axes) => axes.map((axis) => `z[to] = v.${axis}; to++;`).join(" ");

// Writes L(∇s) of all channels, from the sums `slopes` and the moment matrix, to `z`.
function stateGradient(rule, axes) {
  return `
    var m = array<f32, 6>(1.0, 0.0, 0.0, 1.0, 0.0, 1.0);
    ${rule.moment_correction ? `{ ${ADJUGATES[axes.length]} ${INVERSES[rule.moment_inverse]} }` : ""}
    for (var c = 0u; c < CHANNELS; c++) {
      let g = slopes[c];
      let v = logScaled(world.scale * vec3f(
        g.x * m[0] + g.y * m[1] + g.z * m[2], g.x * m[1] + g.y * m[3] + g.z * m[4], g.x * m[2] + g.y * m[4] + g.z * m[5]));
      ${writeVector(axes)}
    }`;
}

// The shaders `density` and `advance` of one rule: sizes are constants in them.
function shaders(rule) {
  const { state_dim: channels, inputs, hidden_dim: hidden, outputs } = rule;
  return `
  struct World {
    sides: vec4f, per: vec4f, cells: vec4u,
    eps: f32, weight: f32, slope: f32, scale: f32, densityScale: f32, dummy: f32, count: u32, rows: u32,
  }
  const CHANNELS = ${channels}u;
  const WIDTH = ${rule.width}u;
  const INPUTS = ${inputs}u;
  const HIDDEN = ${hidden}u;
  const OUTPUTS = ${outputs}u;
  @group(0) @binding(0) var<uniform> world: World;
  @group(0) @binding(1) var<storage, read> points: array<vec4f>;
  @group(0) @binding(2) var<storage, read> home: array<u32>;
  @group(0) @binding(3) var<storage, read> starts: array<u32>;
  @group(0) @binding(4) var<storage, read> states: array<f32>;
  // The density's gradient, and the volume.
  @group(0) @binding(5) var<storage, read_write> fields: array<vec4f>;
  @group(0) @binding(6) var<storage, read> chosen: array<u32>;
  @group(0) @binding(7) var<storage, read> weights: array<f32>;
  @group(0) @binding(8) var<storage, read_write> updates: array<f32>;

  fn logScaled(v: vec3f) -> vec3f {
    let length = length(v);
    // For small vectors, as the logarithm would lose digits.
    let factor = select(log(1.0 + length) / max(length, 1e-30), 1.0 - 0.5 * length + length * length / 3.0, length < 0.01);
    return factor * v;
  }

  @compute @workgroup_size(${GROUP})
  fn density(@builtin(global_invocation_id) id: vec3u) {
    let i = id.x;
    if (i >= world.count) { return; }
    var rho = 0.0;
    var gradient = vec3f(0.0);
    ${visitNeighbours("rho += w; gradient += k * d;")}
    fields[i] = vec4f(gradient, 1.0 / rho);
  }

${advanceShader(rule)}`;
}

// The shader that perceives active particles, and applies the network to what they perceive.
function advanceShader({ state_dim: channels, inputs, outputs, ...rule }) {
  const axes = ["x", "y", "z"].slice(0, rule.space_dim);
  return `  @compute @workgroup_size(${GROUP})
  fn advance(@builtin(global_invocation_id) id: vec3u) {
    let row = id.x;
    if (row >= world.rows) { return; }
    let i = chosen[row];
    var z: array<f32, ${inputs}>;
    var smoothed: array<f32, ${channels}>;
    var slopes: array<vec3f, ${channels}>;
    var xx = 0.0; var xy = 0.0; var xz = 0.0; var yy = 0.0; var yz = 0.0; var zz = 0.0;
    ${visitNeighbours(`
            let volume = fields[j].w;
            let s = k * volume * d;
            xx += s.x * d.x; xy += s.x * d.y; xz += s.x * d.z; yy += s.y * d.y; yz += s.y * d.z; zz += s.z * d.z;
            for (var c = 0u; c < CHANNELS; c++) {
              let other = states[j * WIDTH + c];
              smoothed[c] += w * volume * other;
              slopes[c] += (other - states[i * WIDTH + c]) * s;
            }`)}
    var to = 0u;
    for (var c = 0u; c < CHANNELS; c++) { z[to] = states[i * WIDTH + c]; to++; }
    for (var c = 0u; c < CHANNELS; c++) { z[to] = smoothed[c]; to++; }
    ${rule.state_gradient ? stateGradient(rule, axes) : ""}
    ${rule.density_gradient ? `{
      let v = logScaled(world.densityScale * fields[i].xyz);
      ${writeVector(axes)}
    }` : ""}
    var y: array<f32, ${outputs}>;
    for (var h = 0u; h < HIDDEN; h++) {
      var sum = weights[HIDDEN * INPUTS + h];
      for (var p = 0u; p < INPUTS; p++) { sum += weights[h * INPUTS + p] * z[p]; }
      if (sum > 0.0) {
        for (var a = 0u; a < OUTPUTS; a++) { y[a] += sum * weights[HIDDEN * (INPUTS + 1u + a) + h]; }
      }
    }
    for (var a = 0u; a < OUTPUTS; a++) { updates[row * OUTPUTS + a] = y[a]; }
  }`;
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

  // physics: a Physics of the same rules, whose order and updates are used.
  constructor(device, physics) {
    this.device = device;
    this.physics = physics;
    const { capacity, width, dimension, rules } = physics;
    const { STORAGE, UNIFORM, COPY_DST, COPY_SRC, MAP_READ } = GPUBufferUsage;
    this.buffers = [];
    const buffer = (size, usage) => {
      this.buffers.push(device.createBuffer({ size: 16 * Math.ceil(size / 16), usage }));
      return this.buffers.at(-1);
    };
    const input = STORAGE | COPY_DST;
    this.points = buffer(16 * capacity, input);
    this.home = buffer(4 * capacity, input); // the cell of each particle
    this.starts = buffer(4 * (MAX_CELLS[dimension] ** dimension + 1), input);
    this.states = buffer(4 * width * capacity, input);
    this.fields = buffer(16 * capacity, STORAGE);
    const compute = GPUShaderStage.COMPUTE;
    const entry = (binding, type) => ({ binding, visibility: compute, buffer: { type } });
    const read = "read-only-storage";
    const types = ["uniform", read, read, read, read, "storage", read, read, "storage"];
    const layout = device.createBindGroupLayout({ entries: types.map((type, k) => entry(k, type)) });
    const pipelines = device.createPipelineLayout({ bindGroupLayouts: [layout] });
    this.species = rules.map((rule) => {
      const { outputs } = rule, module = device.createShaderModule({ code: shaders({ ...rule, width }) });
      const pipeline = (entryPoint) => device.createComputePipeline({ layout: pipelines, compute: { module, entryPoint } });
      const matrices = [rule.weights["hidden.weight"], rule.weights["hidden.bias"], rule.weights["output.weight"]];
      const weights = buffer(matrices.reduce((size, matrix) => size + matrix.byteLength, 0), input);
      matrices.reduce((at, matrix) => (device.queue.writeBuffer(weights, at, matrix), at + matrix.byteLength), 0);
      const world = buffer(UNIFORM_BYTES, UNIFORM | COPY_DST);
      const active = buffer(4 * capacity, input);
      const updates = buffer(4 * outputs * capacity, STORAGE | COPY_SRC);
      const mapped = buffer(4 * outputs * capacity, MAP_READ | COPY_DST);
      const buffers = [world, this.points, this.home, this.starts, this.states, this.fields, active, weights, updates];
      const entries = buffers.map((each, binding) => ({ binding, resource: { buffer: each } }));
      const group = device.createBindGroup({ layout, entries });
      return { rule, world, active, updates, mapped, weights, group, density: pipeline("density"), advance: pipeline("advance") };
    });
    this.packedPoints = new Float32Array(4 * capacity);
    this.packedHome = new Uint32Array(capacity);
  }

  async step(world, { eps, box = null, mask = null, noise = null, densityCounts = null }) {
    const { physics, device, packedPoints, packedHome } = this, { count } = world;
    physics.sort(world, eps, box);
    const { points, order, starts, cells, dimension, width } = physics;
    const total = cells[0] * cells[1] * cells[2];
    for (let i = 0; i < count; i++) {
      packedPoints[4 * i] = points.x[i];
      packedPoints[4 * i + 1] = points.y[i];
      packedPoints[4 * i + 2] = points.z[i];
    }
    for (let cell = 0; cell < total; cell++) packedHome.fill(cell, starts[cell], starts[cell + 1]);
    const write = (buffer, array, length) => device.queue.writeBuffer(buffer, 0, array, 0, length);
    write(this.points, packedPoints, 4 * count);
    write(this.home, packedHome, count);
    write(this.starts, starts, total + 1);
    write(this.states, physics.states, width * count);
    const encoder = device.createCommandEncoder();
    const pass = encoder.beginComputePass();
    const running = [];
    this.species.forEach((entry, number) => {
      const active = [];
      for (let k = 0; k < count; k++) {
        if (world.species[order[k]] === number && (mask === null || mask[order[k]] !== 0)) active.push(k);
      }
      write(entry.world, uniforms(physics, entry.rule, count, active.length, densityCounts?.[number] ?? count));
      write(entry.active, Uint32Array.from(active));
      pass.setBindGroup(0, entry.group);
      if (number === 0) {
        pass.setPipeline(entry.density);
        pass.dispatchWorkgroups(Math.ceil(count / GROUP));
      }
      if (active.length === 0) return;
      pass.setPipeline(entry.advance);
      pass.dispatchWorkgroups(Math.ceil(active.length / GROUP));
      running.push({ entry, active });
    });
    pass.end();
    for (const { entry, active } of running) {
      encoder.copyBufferToBuffer(entry.updates, 0, entry.mapped, 0, 4 * entry.rule.outputs * active.length);
    }
    device.queue.submit([encoder.finish()]);
    await Promise.all(running.map(async ({ entry, active }) => {
      const { rule, mapped } = entry;
      const size = 4 * rule.outputs * active.length;
      await mapped.mapAsync(GPUMapMode.READ, 0, size);
      const updates = new Float32Array(mapped.getMappedRange(0, size));
      active.forEach((k, row) => physics.update(world, rule, order[k], updates, row * rule.outputs));
      mapped.unmap();
    }));
    physics.finish(world, noise, box);
  }

  close() {
    for (const buffer of this.buffers) buffer.destroy();
  }
}

function uniforms({ sides, perSide, cells, dimension, eps, weight, slope }, rule, count, rows, densityCount) {
  const bytes = new ArrayBuffer(UNIFORM_BYTES);
  const floats = new Float32Array(bytes), integers = new Uint32Array(bytes);
  floats.set(sides);
  floats.set(perSide, 4);
  integers.set(cells, 8);
  const scale = eps / rule.eps0;
  floats.set([eps, weight, slope, scale, scale ** (1 + dimension) / densityCount], 12);
  integers.set([count, rows], 18);
  return floats;
}
