// Brushes, by the formulas of npa_envs/world/brushes.py, in place.
//
// x: positions [length units], s: states, one particle after the other; box: sides [length units] of
// the periodic box, across whose edges a brush reaches, or null.

// Calls visit(i, offset, square) for each particle: its offset from a place, to its nearest image in a
// box, which `visit` may change but not keep, and the square of its length.
function forEach(x, dimension, centre, box, visit) {
  const offset = new Float64Array(dimension);
  const count = x.length / dimension;
  for (let i = 0; i < count; i++) {
    let square = 0;
    for (let d = 0; d < dimension; d++) {
      let part = x[i * dimension + d] - centre[d];
      if (box !== null) part -= box[d] * Math.round(part / box[d]);
      offset[d] = part;
      square += part * part;
    }
    visit(i, offset, square);
  }
}

// Which particles lie in a ball, as an array of their numbers.
export function insideBall(x, dimension, centre, radius, box) {
  const found = [];
  forEach(x, dimension, centre, box, (i, _, square) => {
    if (Math.sqrt(square) <= radius) found.push(i);
  });
  return found;
}

export function wipeState(x, s, dimension, centre, radius, box) {
  const channels = (s.length / x.length) * dimension;
  for (const i of insideBall(x, dimension, centre, radius, box)) s.fill(0, i * channels, (i + 1) * channels);
}

// Carries particles along with a movement, those in the middle by `strength` of it.
export function push(x, dimension, centre, move, radius, strength, box) {
  forEach(x, dimension, centre, box, (i, _, square) => {
    const share = strength * softness(square, radius);
    for (let d = 0; d < dimension; d++) x[i * dimension + d] += share * move[d];
  });
}

// The mean state under a soft brush, or null where it holds no particle.
export function stateAround(x, s, dimension, centre, radius, box) {
  const channels = (s.length / x.length) * dimension, mean = new Float64Array(channels);
  let total = 0;
  forEach(x, dimension, centre, box, (i, _, square) => {
    const share = softness(square, radius);
    total += share;
    for (let c = 0; c < channels; c++) mean[c] += share * s[i * channels + c];
  });
  return total > 0 ? mean.map((sum) => sum / total) : null;
}

// Draws states towards a given one, those in the middle by `strength` of the way.
export function inject(x, s, dimension, centre, radius, state, strength, box) {
  const channels = state.length;
  forEach(x, dimension, centre, box, (i, _, square) => {
    const share = strength * softness(square, radius);
    for (let c = 0; c < channels; c++) s[i * channels + c] += share * (state[c] - s[i * channels + c]);
  });
}

// The weight of a soft brush at a distance whose square is given.
function softness(square, radius) {
  return radius > 0 ? Math.max(0, 1 - square / (radius * radius)) ** 2 : 0;
}

// Takes particles nearer to the centre by a share `factor` of their distance.
export function clump(x, dimension, centre, radius, factor, box) {
  forEach(x, dimension, centre, box, (i, offset, square) => {
    if (Math.sqrt(square) > radius) return;
    for (let d = 0; d < dimension; d++) x[i * dimension + d] -= factor * offset[d];
  });
}

// Opens a slit along a line (a plane in 3D) with a `normal`; `along` leads from its centre to an end,
// or is null where it has none.
export function cut(x, dimension, centre, normal, gap, along, box) {
  const length = Math.hypot(...normal) || 1;
  const direction = normal.map((part) => part / length);
  const half = along === null ? Infinity : inner(along, along);
  forEach(x, dimension, centre, box, (i, offset) => {
    const height = inner(offset, direction);
    const shift = (height >= 0 ? 0.5 : -0.5) * Math.max(0, gap - Math.abs(height));
    if (along !== null && Math.abs(inner(offset, along)) > half) return;
    for (let d = 0; d < dimension; d++) x[i * dimension + d] += shift * direction[d];
  });
}

export function inner(a, b) {
  let sum = 0;
  for (let d = 0; d < b.length; d++) sum += a[d] * b[d];
  return sum;
}
