// The step of Neural Particle Automata in plain JavaScript: the same formulas, in the same order, as
// npa_envs/reference.py and docs/mathematics.md. A change of a formula is made in its whole row:
//
//                          this file            kernels_simd.js       shaders of physics_gpu.js
//   density                sumDensities         sumDensitiesCode      density
//   list of neighbours     listNeighbours       listNeighboursCode    visitNeighbours
//   sums over neighbours   sumNeighbours        sumNeighboursCode     advance
//   perception             perceive, logScaled  sumNeighboursCode     advance
//   network                applyLayer           applyLayerCode        advance
//   new positions, states  update                                     advance
//
// test_a_step_of_each_engine_is_that_of_python of tests/web/test_export_browser.py compares all three in random worlds.
// Here particles are sorted by cell, and only active particles perceive.

export const MOMENT_THRESHOLD = 1e-3;
export const SQUARED_MOMENT_SOFTENING = 1e-2 ** 2;

// Perception vectors to which the network is applied at a time.
const BLOCK_ROWS = 64;

// States, and a layer's outputs, are padded to multiples of these.
const LANES = 4;
export const TILE_OUTPUTS = 8;

// Maximum number of cells on each side of the grid. Beyond it cells are reused; distances are checked in any case.
export const MAX_CELLS = { 2: 256, 3: 64 };

export const CELLS_PER_RADIUS = 2;

export function padded(channels) {
  return LANES * Math.ceil(channels / LANES);
}

export function numbersBelow(count) {
  return [...new Array(count).keys()];
}

// A rule ready to run: hyper-parameters by NPARule's names, weights by those of its file.
export function prepareRule(description, kernels) {
  const rule = { ...description };
  const { weights, hidden_dim: hidden, state_dim: channels, space_dim: dimension } = rule;
  // Perception vectors are rows of padded parts: the state, the smoothed state, its slopes along each axis; then the
  // density's slopes and, as the last number, 1. `columns` are their places in the order of NPARule's perception.
  const width = padded(channels), matrix = weights["hidden.weight"];
  rule.inputs = (2 + dimension) * width + LANES;
  const columns = [0, 1].flatMap((part) => numbersBelow(channels).map((c) => part * width + c));
  const slopeAt = (p) => (2 + p % dimension) * width + Math.floor(p / dimension);
  if (rule.state_gradient) columns.push(...numbersBelow(channels * dimension).map(slopeAt));
  if (rule.density_gradient) columns.push(...numbersBelow(dimension).map((d) => rule.inputs - LANES + d));
  // W with these columns, and b as the last one: [hidden, inputs].
  rule.matrix = new Float32Array(hidden * rule.inputs);
  for (let h = 0; h < hidden; h++) {
    columns.forEach((column, p) => (rule.matrix[h * rule.inputs + column] = matrix[h * columns.length + p]));
    rule.matrix[(h + 1) * rule.inputs - 1] = weights["hidden.bias"][h];
  }
  rule.outputs = channels + (rule.static ? 0 : rule.space_dim);
  rule.hidden = kernels.makeLayer(rule.matrix, null, rule.inputs, hidden);
  rule.output = kernels.makeLayer(weights["output.weight"], null, hidden, rule.outputs);
  return rule;
}

// The kernels in plain JavaScript. `floats` and `integers` return zeroed arrays for them.
export function plainKernels() {
  const floats = (length) => new Float32Array(length);
  return {
    name: "JavaScript", floats, integers: (length) => new Int32Array(length),
    sumDensities, listNeighbours, sumNeighbours,
    makeLayer: (...matrix) => tiledLayer(floats, ...matrix), applyLayer,
  };
}

// Adds to the densities and their gradients what pairs of sorted particles add, of which one is in [first, end) and
// the other one, behind it, in the `ranges` of a Physics.
function sumDensities(physics, first, end) {
  const { density, gradient: [gradientX, gradientY, gradientZ], ranges, rangesEnd, eps, weight, slope } = physics;
  const { x: px, y: py, z: pz } = physics.points;
  const [sideX, sideY, sideZ] = physics.sides;
  const [halfX, halfY, halfZ] = physics.halfSides;
  const squaredRadius = eps * eps;
  for (let i = first; i < end; i++) {
    const x = px[i], y = py[i], z = pz[i];
    let sum = 0, sumX = 0, sumY = 0, sumZ = 0;
    for (let r = 0; r < rangesEnd; r += 2) {
      const last = ranges[r + 1];
      // Each pair once: i and j add the same to each other, the gradient with opposite sign.
      for (let j = Math.max(ranges[r], i + 1); j < last; j++) {
        const dx = toNearest(px[j] - x, sideX, halfX);
        const dy = toNearest(py[j] - y, sideY, halfY);
        const dz = toNearest(pz[j] - z, sideZ, halfZ);
        const squared = dx * dx + dy * dy + dz * dz;
        if (!(squared < squaredRadius)) continue;
        const left = squaredRadius - squared;
        const w = weight * left * left * left;
        sum += w;
        density[j] += w;
        if (squared === 0) continue;
        const distance = Math.sqrt(squared);
        const k = (slope * (eps - distance) * (eps - distance)) / distance;
        sumX += k * dx; sumY += k * dy; sumZ += k * dz;
        gradientX[j] -= k * dx; gradientY[j] -= k * dy; gradientZ[j] -= k * dz;
      }
    }
    density[i] += sum;
    gradientX[i] += sumX; gradientY[i] += sumY; gradientZ[i] += sumZ;
  }
}

// Writes the state of sorted particle i, and sums over its neighbours, which `listNeighbours` has listed, into `rows`
// of a Physics at `at`: s_i, Σ smoothing s_j, and L(inverse Σ slope (s_j - s_i)) for each axis.
function sumNeighbours(physics, i, at) {
  const { states, width, rows, dimension, list, inverse: m } = physics;
  const { count, stateAt, smoothing, slopes: [slopeX, slopeY, slopeZ] } = list;
  for (let c = 0; c < width; c++) {
    const mine = states[i * width + c];
    let smoothed = 0, x = 0, y = 0, z = 0;
    for (let n = 0; n < count; n++) {
      const other = states[stateAt[n] + c], offset = other - mine;
      smoothed += smoothing[n] * other;
      x += slopeX[n] * offset;
      y += slopeY[n] * offset;
      if (dimension === 3) z += slopeZ[n] * offset;
    }
    rows[at + c] = mine;
    rows[at + width + c] = smoothed;
    logScaled(
      rows, at + 2 * width + c, width, dimension,
      x * m[0] + y * m[1] + z * m[2], x * m[1] + y * m[3] + z * m[4], x * m[2] + y * m[4] + z * m[5],
    );
  }
}

// Fills `list` of a Physics with the neighbours of sorted particle i among the particles of `ranges`.
function listNeighbours(physics, i) {
  const { ranges, rangesEnd, eps, weight, slope, width, list } = physics;
  const { x, y, z, volume } = physics.points;
  const { stateAt, smoothing, slopes: [slopeX, slopeY, slopeZ] } = list;
  const [sideX, sideY, sideZ] = physics.sides;
  const [halfX, halfY, halfZ] = physics.halfSides;
  const squaredRadius = eps * eps;
  const ownX = x[i], ownY = y[i], ownZ = z[i];
  let xx = 0, xy = 0, xz = 0, yy = 0, yz = 0, zz = 0;
  let count = 0;
  for (let r = 0; r < rangesEnd; r += 2) {
    const last = ranges[r + 1];
    for (let j = ranges[r]; j < last; j++) {
      const dx = toNearest(x[j] - ownX, sideX, halfX);
      const dy = toNearest(y[j] - ownY, sideY, halfY);
      const dz = toNearest(z[j] - ownZ, sideZ, halfZ);
      const squared = dx * dx + dy * dy + dz * dz;
      if (!(squared < squaredRadius)) continue;
      const left = squaredRadius - squared;
      const distance = Math.sqrt(squared);
      const k = squared > 0 ? (slope * (eps - distance) * (eps - distance)) / distance : 0;
      const factor = k * volume[j];
      stateAt[count] = j * width;
      smoothing[count] = weight * left * left * left * volume[j];
      slopeX[count] = factor * dx; slopeY[count] = factor * dy; slopeZ[count] = factor * dz;
      count++;
      xx += factor * dx * dx; xy += factor * dx * dy; xz += factor * dx * dz;
      yy += factor * dy * dy; yz += factor * dy * dz; zz += factor * dz * dz;
    }
  }
  list.count = count;
  list.moment.set([xx, xy, xz, yy, yz, zz]);
}

// Writes W row + b of a layer for `count` rows to `out`; max(., 0) of it where `rectified`.
function applyLayer({ inputs, width, weights, offset }, count, rows, rowWidth, out, rectified) {
  for (let tile = 0; tile < width; tile += TILE_OUTPUTS) {
    for (let row = 0; row < count; row++) {
      const from = row * rowWidth;
      let s0 = offset[tile], s1 = offset[tile + 1], s2 = offset[tile + 2], s3 = offset[tile + 3];
      let s4 = offset[tile + 4], s5 = offset[tile + 5], s6 = offset[tile + 6], s7 = offset[tile + 7];
      for (let p = 0, at = tile * padded(inputs); p < inputs; p++, at += TILE_OUTPUTS) {
        const value = rows[from + p];
        s0 += value * weights[at]; s1 += value * weights[at + 1];
        s2 += value * weights[at + 2]; s3 += value * weights[at + 3];
        s4 += value * weights[at + 4]; s5 += value * weights[at + 5];
        s6 += value * weights[at + 6]; s7 += value * weights[at + 7];
      }
      const to = row * width + tile;
      out[to] = s0; out[to + 1] = s1; out[to + 2] = s2; out[to + 3] = s3;
      out[to + 4] = s4; out[to + 5] = s5; out[to + 6] = s6; out[to + 7] = s7;
    }
  }
  if (rectified) {
    for (let k = 0; k < count * width; k++) if (out[k] < 0) out[k] = 0;
  }
}

// A layer of a matrix [outputs, inputs], row by row, and a bias or null, as `applyLayer` reads it: eight outputs at
// a time are contiguous, [tiles, inputs, 8], with inputs padded by zeros.
export function tiledLayer(floats, weight, bias, inputs, outputs) {
  const width = TILE_OUTPUTS * Math.ceil(outputs / TILE_OUTPUTS);
  const weights = floats(width * padded(inputs)), offset = floats(width);
  if (bias !== null) offset.set(bias);
  for (let a = 0; a < outputs; a++) {
    const tile = Math.floor(a / TILE_OUTPUTS) * padded(inputs);
    for (let p = 0; p < inputs; p++) {
      weights[(tile + p) * TILE_OUTPUTS + (a % TILE_OUTPUTS)] = weight[a * inputs + p];
    }
  }
  return { inputs, width, weights, offset };
}

// Memory and methods of a step: sorted copies, densities, lists. Made once for each size.
export class Physics {
  // rules: prepared, all of one dimension and number of channels. capacity: maximum number of particles.
  constructor(rules, capacity, kernels) {
    this.rules = rules;
    this.kernels = kernels;
    this.dimension = rules[0].space_dim;
    this.channels = rules[0].state_dim;
    this.width = padded(this.channels);
    this.capacity = capacity;

    // Kernels look at four particles at a time, and write four.
    const room = capacity + LANES;
    const floats = () => kernels.floats(room);
    // What kernels read of a step: eps, eps², weight, slope, sides (3), inverse sides (3).
    this.constants = kernels.floats(10);
    this.points = { x: floats(), y: floats(), z: floats(), volume: floats() };
    this.density = floats();
    this.gradient = [floats(), floats(), floats()];
    this.order = new Int32Array(capacity);
    this.cellOf = new Int32Array(capacity);
    this.starts = new Int32Array(1);
    this.states = kernels.floats(capacity * this.width);
    // The neighbours of one particle: indices of their first channels, their factors in the sums of `sumNeighbours`,
    // and their moment matrix: xx, xy, xz, yy, yz, zz.
    this.list = {
      count: 0,
      stateAt: kernels.integers(room),
      smoothing: floats(),
      slopes: [floats(), floats(), floats()],
      moment: new Float64Array(6),
    };
    // The inverse of a moment matrix times the scale of slopes: xx, xy, xz, yy, yz, zz.
    this.inverse = kernels.floats(6);
    const widest = (width) => kernels.floats(BLOCK_ROWS * Math.max(...rules.map(width)));
    this.rowWidth = rules[0].inputs;
    this.rows = widest(() => this.rowWidth);
    this.hidden = widest((rule) => rule.hidden.width);
    this.updates = widest((rule) => rule.output.width);
    this.blockRows = new Int32Array(BLOCK_ROWS);
    // Runs of sorted particles, each as its first index and the one after its last, and where the runs end.
    this.ranges = kernels.integers(4 * 25);
    this.rangesEnd = 0;
  }

  // Advances a world {count, x, s, species} by one step, in place.
  //
  // eps: perception radius [length units]; box: sides, or null; mask: Uint8Array, 1 where a particle
  // is updated, or null for all; noise: offsets of positions, or null; densityCounts: numbers by which
  // each rule's densities are divided, by default the particles of the world.
  step(world, { eps, box = null, noise = null, ...options }) {
    this.sort(world, eps, box);
    this.advancePart(world, options, 0, 1);
    this.finish(world, noise, box);
  }

  // Advances the particles of one of several parts of a sorted world, without noise: the other ones stay as they are.
  advancePart(world, { mask = null, densityCounts = null }, part, parts) {
    const [first, end] = this.cellsOf(world.count, part, parts);
    const total = this.cellCount, reach = 3 * (total / this.cells[this.dimension - 1]);
    const some = end - first + 2 * reach < total;
    this.computeDensities(world.count, some ? first - reach + total : 0, some ? end - first + 2 * reach : total);
    for (let number = 0; number < this.rules.length; number++) {
      this.advance(world, number, densityCounts?.[number] ?? world.count, mask, first, end);
    }
  }

  // The first cell of a part, and the one after its last: parts have about as many particles.
  cellsOf(count, part, parts) {
    return [part, part + 1].map((number) => {
      let low = 0, high = this.cellCount;
      while (low < high) {
        const middle = (low + high) >> 1;
        if (this.starts[middle] * parts < count * number) low = middle + 1;
        else high = middle;
      }
      return low;
    });
  }

  // Returns x and s of the particles of a part, one after the other; or writes those that are given to the world.
  exchange({ count, x, s }, part, parts, given = null) {
    const { dimension, channels, order } = this;
    const [from, to] = this.cellsOf(count, part, parts).map((cell) => this.starts[cell]);
    const values = given ?? new Float32Array((to - from) * (dimension + channels));
    let at = 0;
    const copy = (array, first, end) => {
      for (let k = first; k < end; k++, at++) {
        if (given === null) values[at] = array[k];
        else array[k] = values[at];
      }
    };
    for (let k = from; k < to; k++) {
      copy(x, order[k] * dimension, (order[k] + 1) * dimension);
      copy(s, order[k] * channels, (order[k] + 1) * channels);
    }
    return values;
  }

  // Adds noise and moves particles back into the box.
  finish(world, noise, box) {
    if (noise !== null) {
      for (let n = 0; n < noise.length; n++) world.x[n] += noise[n];
    }
    if (box !== null) wrap(world.x, world.count, box);
  }

  // Sorts a world's particles by cell, and sets what a step with a perception radius in a box needs.
  sort({ count, x, s }, eps, box) {
    const inverse = this.setGrid(x, count, eps, box);
    this.orderByCell(x, count, inverse);
    const { dimension, channels, width, order, points } = this;
    // Integers of the same bits are copied without conversions.
    const bitsOf = ({ buffer, byteOffset, length }) => new Int32Array(buffer, byteOffset, length);
    const to = bitsOf(this.states), from = bitsOf(s);
    const [sideX, sideY, sideZ] = this.sides;
    const inBox = (position, side) => (side > 0 ? position - side * Math.floor(position / side + 0.5) : position);
    for (let k = 0; k < count; k++) {
      const i = order[k];
      points.x[k] = inBox(x[i * dimension], sideX);
      points.y[k] = inBox(x[i * dimension + 1], sideY);
      points.z[k] = dimension === 3 ? inBox(x[i * dimension + 2], sideZ) : 0;
      for (let c = 0; c < channels; c++) to[k * width + c] = from[i * channels + c];
    }
  }

  // Sets the constants of a step and the numbers of cells along the axes; returns cells in a length unit of each.
  setGrid(x, count, eps, box) {
    const { dimension } = this;
    const cells = [1, 1, 1], inverse = [0, 0, 0];
    this.eps = eps;
    // The norms of the smoothing and of the spiky kernel.
    this.weight = dimension === 2 ? 4 / (Math.PI * eps ** 8) : 315 / (64 * Math.PI * eps ** 9);
    this.slope = dimension === 2 ? 30 / (Math.PI * eps ** 5) : 45 / (Math.PI * eps ** 6);
    // In open space both are 0: there are no images.
    this.sides = new Float64Array(3);
    this.perSide = new Float64Array(3);
    for (let d = 0; d < dimension; d++) {
      if (box !== null) {
        this.sides[d] = box[d];
        this.perSide[d] = 1 / box[d];
        const fitting = Math.floor((box[d] / eps) * CELLS_PER_RADIUS * (1 + 1e-12));
        cells[d] = Math.max(1, Math.min(MAX_CELLS[dimension], fitting));
        inverse[d] = cells[d] / box[d];
      } else {
        let low = Infinity, high = -Infinity;
        for (let i = d; i < count * dimension; i += dimension) {
          if (x[i] < low) low = x[i];
          if (x[i] > high) high = x[i];
        }
        inverse[d] = CELLS_PER_RADIUS / eps;
        const fitting = Math.ceil((high - low) * inverse[d]) + 2 * CELLS_PER_RADIUS + 1;
        cells[d] = Math.min(MAX_CELLS[dimension], Number.isFinite(fitting) ? fitting : MAX_CELLS[dimension]);
      }
    }
    this.halfSides = this.perSide.map((per) => 0.5 / per);
    this.constants.set([eps, eps * eps, this.weight, this.slope, ...this.sides, ...this.perSide]);
    this.cells = cells;
    this.cellCount = cells[0] * cells[1] * cells[2];
    return inverse;
  }

  // Writes particles' indices, sorted by cell, to `order`, and where each cell's particles begin to `starts`.
  orderByCell(x, count, inverse) {
    const { dimension, order, cellOf, cells, cellCount: total } = this;
    const three = dimension === 3;
    const [nx, ny] = cells;
    if (this.starts.length < total + 1) this.starts = new Int32Array(total + 1);
    const starts = this.starts.fill(0, 0, total + 1);
    const cellAlong = (position, d) => {
      const along = cells[d];
      let cell = Math.floor(position * inverse[d]);
      if (cell < 0) cell += along;
      // Remainders are slow, and needed by far particles only.
      if (!(cell >= 0 && cell < along)) cell = ((cell % along) + along) % along;
      return cell | 0;
    };
    for (let i = 0; i < count; i++) {
      const at = i * dimension;
      const cz = three ? cellAlong(x[at + 2], 2) : 0;
      const cell = (cz * ny + cellAlong(x[at + 1], 1)) * nx + cellAlong(x[at], 0);
      cellOf[i] = cell;
      starts[cell + 1]++;
    }
    for (let cell = 0; cell < total; cell++) starts[cell + 1] += starts[cell];
    // Backwards, so that `starts` itself is the cursor of each cell.
    for (let i = count - 1; i >= 0; i--) order[--starts[cellOf[i] + 1]] = i;
    for (let cell = 0; cell < total; cell++) starts[cell] = starts[cell + 1];
    starts[total] = count;
  }

  // Fills `ranges` with the runs of sorted particles that may be neighbours of those of a cell.
  rangesAround(cell) {
    const [nx, ny, nz] = this.cells;
    const { starts, ranges } = this;
    const span = CELLS_PER_RADIUS;
    const cx = cell % nx, cy = Math.floor(cell / nx) % ny, cz = Math.floor(cell / (nx * ny));
    // In a small box each cell is visited only once.
    const around = 2 * span + 1;
    const countX = Math.min(nx, around), countY = Math.min(ny, around), countZ = Math.min(nz, around);
    const firstX = countX < around ? 0 : (cx - span + nx) % nx;
    const firstY = countY < around ? 0 : cy - span + ny;
    const firstZ = countZ < around ? 0 : cz - span + nz;
    let used = 0;
    const add = (from, to) => {
      if (from < to) {
        ranges[used++] = from;
        ranges[used++] = to;
      }
    };
    for (let z = 0; z < countZ; z++) {
      for (let y = 0; y < countY; y++) {
        const row = (((firstZ + z) % nz) * ny + ((firstY + y) % ny)) * nx;
        const before = Math.min(countX, nx - firstX);
        add(starts[row + firstX], starts[row + firstX + before]);
        if (before < countX) add(starts[row], starts[row + countX - before]);
      }
    }
    this.rangesEnd = used;
  }

  // Computes the densities in some cells, in all by default: `cells` from `first` on, after the last one the first one.
  computeDensities(count, first = 0, cells = this.cellCount) {
    const { density, gradient, starts, points: { volume } } = this;
    for (const axis of gradient) axis.fill(0, 0, count);
    // The particle itself.
    density.fill(this.weight * this.eps ** 6, 0, count);
    for (let n = 0; n < cells; n++) {
      const cell = (first + n) % this.cellCount;
      if (starts[cell] === starts[cell + 1]) continue;
      this.rangesAround(cell);
      this.kernels.sumDensities(this, starts[cell], starts[cell + 1]);
    }
    for (let i = 0; i < count; i++) volume[i] = 1 / density[i];
  }

  // Perceives the active particles of one rule in the cells [first, end), runs its network, and updates them.
  advance(world, number, densityCount, mask, first, end) {
    const { order, starts, blockRows, kernels, rows, rowWidth, hidden, updates } = this;
    const rule = this.rules[number];
    let filled = 0;
    const flush = () => {
      if (filled === 0) return;
      kernels.applyLayer(rule.hidden, filled, rows, rowWidth, hidden, true);
      kernels.applyLayer(rule.output, filled, hidden, rule.hidden.width, updates, false);
      for (let row = 0; row < filled; row++) {
        this.update(world, rule, order[blockRows[row]], updates, row * rule.output.width);
      }
      filled = 0;
    };
    for (let cell = first; cell < end; cell++) {
      let found = false;
      for (let i = starts[cell]; i < starts[cell + 1]; i++) {
        const particle = order[i];
        if (world.species[particle] !== number || (mask !== null && mask[particle] === 0)) continue;
        if (!found) this.rangesAround(cell);
        found = true;
        this.perceive(rule, i, filled * rowWidth, densityCount);
        blockRows[filled++] = i;
        if (filled === BLOCK_ROWS) flush();
      }
    }
    flush();
  }

  // Writes the perception vector of sorted particle i into `rows` at `at`.
  perceive(rule, i, at, densityCount) {
    const { width, dimension, rows, kernels, inverse, gradient: [x, y, z] } = this;
    kernels.listNeighbours(this, i);
    const scale = this.eps / rule.eps0;
    invertMoment(rule, this.list.moment, scale, inverse);
    kernels.sumNeighbours(this, i, at);
    const end = at + rule.inputs, densityScale = scale ** (1 + dimension) / densityCount;
    logScaled(rows, end - LANES, 1, dimension, densityScale * x[i], densityScale * y[i], densityScale * z[i]);
    rows[end - 1] = 1;
  }

  // x ← x + α ε δ / (1 + |δ|), s ← s + Δs for one particle, whose δ and Δs begin at `from`; numbers
  // in the rule's dead zone count as 0.
  update({ x, s }, rule, particle, updates, from) {
    const { dimension, channels } = this;
    if (rule.dead_zone > 0) {
      for (let a = from; a < from + rule.outputs; a++) {
        if (Math.abs(updates[a]) <= rule.dead_zone) updates[a] = 0;
      }
    }
    if (!rule.static) {
      let squared = 0;
      for (let d = 0; d < dimension; d++) squared += updates[from + d] ** 2;
      const scale = (rule.alpha * this.eps) / (1 + Math.sqrt(squared));
      for (let d = 0; d < dimension; d++) x[particle * dimension + d] += scale * updates[from + d];
      from += dimension;
    }
    for (let c = 0; c < channels; c++) s[particle * channels + c] += updates[from + c];
  }
}

// Returns a difference of coordinates to the nearest image.
function toNearest(difference, side, half) {
  return difference > half ? difference - side : difference < -half ? difference + side : difference;
}

// Moves positions into a periodic box around the origin.
export function wrap(x, count, box) {
  const dimension = box.length;
  for (let i = 0; i < count * dimension; i++) {
    const side = box[i % dimension];
    x[i] -= side * Math.floor(x[i] / side + 0.5);
  }
}

// Writes L(v) = log(1 + |v|) v / |v|, its components `stride` apart.
function logScaled(rows, at, stride, dimension, x, y, z) {
  if (dimension === 2) z = 0;
  const length = Math.sqrt(x * x + y * y + z * z);
  const factor = length > 0 ? Math.log1p(length) / length : 1;
  rows[at] = factor * x;
  rows[at + stride] = factor * y;
  if (dimension === 3) rows[at + 2 * stride] = factor * z;
}

// Writes `scale` times the upper triangle of the inverse of M, or of its replacement, to `out`.
function invertMoment({ space_dim: dimension, moment_correction: corrects, moment_inverse: kind }, moment, scale, out) {
  const xx = moment[0], xy = moment[1], xz = moment[2], yy = moment[3], yz = moment[4], zz = moment[5];
  // The adjugate.
  let a = yy, b = -xy, c = 0, d = xx, e = 0, f = 0;
  if (dimension === 3) {
    a = yy * zz - yz * yz; b = xz * yz - xy * zz; c = xy * yz - xz * yy;
    d = xx * zz - xz * xz; e = xy * xz - xx * yz; f = xx * yy - xy * xy;
  }
  const determinant = xx * a + xy * b + xz * c;
  let factor = 0, unit = scale;
  if (corrects && kind === "smooth") {
    const divisor = determinant * determinant + SQUARED_MOMENT_SOFTENING;
    factor = (scale * determinant) / divisor;
    unit = (scale * SQUARED_MOMENT_SOFTENING) / divisor;
  } else if (corrects && Math.abs(determinant) >= MOMENT_THRESHOLD) {
    factor = scale / determinant;
    unit = 0;
  }
  out[0] = factor * a + unit; out[1] = factor * b; out[2] = factor * c;
  out[3] = factor * d + unit; out[4] = factor * e; out[5] = factor * f + unit;
}
