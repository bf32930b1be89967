// Reproducible random numbers: the same seed gives the same world on every machine. Python draws
// others from the same seed.

// The generator sfc32 of Chris Doty-Humphrey (PractRand), 128 bits of state.
export class Random {
  constructor(seed) {
    this.a = seed >>> 0;
    this.b = Math.floor(seed / 2 ** 32) >>> 0;
    this.c = 0x9e3779b9;
    this.counter = 1;
    for (let k = 0; k < 16; k++) this.bits();
  }

  bits() {
    const sum = (this.a + this.b + this.counter) >>> 0;
    this.counter = (this.counter + 1) >>> 0;
    this.a = this.b ^ (this.b >>> 9);
    this.b = (this.c + (this.c << 3)) >>> 0;
    this.c = ((this.c << 21) | (this.c >>> 11)) >>> 0;
    this.c = (this.c + sum) >>> 0;
    return sum;
  }

  // In [0, 1).
  uniform() {
    return this.bits() / 2 ** 32;
  }

  below(count) {
    return Math.floor(this.uniform() * count);
  }

  normal() {
    const radius = Math.sqrt(-2 * Math.log(1 - this.uniform()));
    return radius * Math.cos(2 * Math.PI * this.uniform());
  }

  normals(length, deviation) {
    return Float32Array.from({ length }, () => deviation * this.normal());
  }

  // A vector of length 1.
  direction(dimension) {
    const found = Array.from({ length: dimension }, () => this.normal());
    const length = Math.hypot(...found) || 1;
    return found.map((part) => part / length);
  }

  // Points uniform in a ball around the origin [length units], one after the other.
  ball(count, dimension, radius) {
    const points = new Float32Array(count * dimension);
    for (let i = 0; i < count; i++) {
      const distance = radius * this.uniform() ** (1 / dimension);
      points.set(this.direction(dimension).map((part) => distance * part), i * dimension);
    }
    return points;
  }

  // Points uniform in a box around the origin with these sides [length units].
  box(count, sides) {
    return Float32Array.from({ length: count * sides.length }, (_, k) => sides[k % sides.length] * (this.uniform() - 0.5));
  }
}
