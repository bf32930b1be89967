// Brushes, by the formulas of npa_envs/world/brushes.py, in place; a test that rule_world.js names compares both.
//
// world: {x, s, dimension, channels, box}. x: positions [length units], s: states, particle by particle;
// box: sides of the periodic box [length units], in which distances are those to the nearest image, or null.

// Calls visit(i, offset, square) for each particle: its offset from `centre`, which is valid only during
// the call, and the square of the offset's length.
function forEach({ x, dimension, box }, centre, visit) {
  const offset = new Float64Array(dimension);
  const count = x.length / dimension;
  for (let i = 0; i < count; i++) {
    let square = 0;
    for (let d = 0; d < dimension; d++) {
      let difference = x[i * dimension + d] - centre[d];
      if (box !== null) difference -= box[d] * Math.round(difference / box[d]);
      offset[d] = difference;
      square += difference * difference;
    }
    visit(i, offset, square);
  }
}

// Returns the indices of particles in a ball.
export function insideBall(world, centre, radius) {
  const indices = [];
  forEach(world, centre, (i, _, square) => {
    if (Math.sqrt(square) <= radius) indices.push(i);
  });
  return indices;
}

// Sets the states of particles in a ball to 0.
export function wipeState(world, centre, radius) {
  const { s, channels } = world;
  for (const i of insideBall(world, centre, radius)) s.fill(0, i * channels, (i + 1) * channels);
}

// Moves particles by a fraction of `move`: `strength` at the centre, less towards the rim.
export function push(world, centre, move, radius, strength) {
  const { x, dimension } = world;
  forEach(world, centre, (i, _, square) => {
    const weight = strength * softness(square, radius);
    for (let d = 0; d < dimension; d++) x[i * dimension + d] += weight * move[d];
  });
}

// Moves particles by their offsets at the centre, less towards the rim.
export function scatter(world, centre, radius, offsets) {
  const { x, dimension } = world;
  forEach(world, centre, (i, _, square) => {
    const weight = softness(square, radius);
    for (let k = i * dimension; k < (i + 1) * dimension; k++) x[k] += weight * offsets[k];
  });
}

// Returns the weighted mean state of particles in a ball, heavier towards the centre; null without any.
export function stateAround(world, centre, radius) {
  const { s, channels } = world, mean = new Float64Array(channels);
  let total = 0;
  forEach(world, centre, (i, _, square) => {
    const weight = softness(square, radius);
    total += weight;
    for (let c = 0; c < channels; c++) mean[c] += weight * s[i * channels + c];
  });
  return total > 0 ? mean.map((sum) => sum / total) : null;
}

// Mixes a state into those of particles, by the fraction `strength` at the centre, less towards the rim.
export function inject(world, centre, radius, state, strength) {
  const { s, channels } = world;
  forEach(world, centre, (i, _, square) => {
    const weight = strength * softness(square, radius);
    for (let c = 0; c < channels; c++) s[i * channels + c] += weight * (state[c] - s[i * channels + c]);
  });
}

// Returns a brush's weight at a squared distance from its centre: 1 there, 0 from the rim on.
function softness(square, radius) {
  return radius > 0 ? Math.max(0, 1 - square / (radius * radius)) ** 2 : 0;
}

// Moves particles towards the centre by the fraction `factor` of their distance.
export function clump(world, centre, radius, factor) {
  const { x, dimension } = world;
  forEach(world, centre, (i, offset, square) => {
    if (Math.sqrt(square) > radius) return;
    for (let d = 0; d < dimension; d++) x[i * dimension + d] -= factor * offset[d];
  });
}

// Opens a gap along a line (a plane in 3D) with a `normal`; `along` is the vector from its centre to an
// end, or null for an endless one.
export function cut(world, centre, normal, gap, along = null) {
  const { x, dimension } = world;
  const length = Math.hypot(...normal) || 1;
  const direction = normal.map((component) => component / length);
  const half = along === null ? Infinity : inner(along, along);
  forEach(world, centre, (i, offset) => {
    const height = inner(offset, direction);
    const shift = (height >= 0 ? 0.5 : -0.5) * Math.max(0, gap - Math.abs(height));
    if (along !== null && Math.abs(inner(offset, along)) > half) return;
    for (let d = 0; d < dimension; d++) x[i * dimension + d] += shift * direction[d];
  });
}

// Opens a gap along the movement `move` from `start`, as seen from direction `view`.
export function cutAlong(world, start, move, gap, view) {
  const half = move.map((component) => component / 2);
  const [x, y, z = 0] = move, [a, b, c] = view;
  const normal = [b * z - c * y, c * x - a * z, a * y - b * x].slice(0, world.dimension);
  cut(world, start.map((coordinate, d) => coordinate + half[d]), normal, gap, half);
}

// Returns the scalar product.
export function inner(a, b) {
  let sum = 0;
  for (let d = 0; d < b.length; d++) sum += a[d] * b[d];
  return sum;
}
