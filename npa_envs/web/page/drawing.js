// Particles on a canvas: the camera, and painters with and without WebGL2.

// The camera moves and zooms over 2D worlds, and goes round 3D worlds in perspective: y is up, angles are
// in degrees.
export class Camera {
  constructor(dimension, halfWidth, centre = [0, 0, 0]) {
    this.dimension = dimension;
    this.halfWidth = halfWidth;
    this.centre = [0, 1, 2].map((k) => centre[k] ?? 0);
    this.zoom = 1;
    this.covered = [0, 0]; // fractions of the canvas that controls cover, at its right and lower edges
    this.azimuth = 0;
    this.elevation = dimension === 3 ? 15 : 0;
  }

  // The unit vectors to the right, up and towards the viewer.
  get axes() {
    if (this.dimension === 2) return [[1, 0, 0], [0, 1, 0], [0, 0, 1]];
    const turn = (this.azimuth * Math.PI) / 180, tilt = (this.elevation * Math.PI) / 180;
    const outward = [Math.sin(turn), 0, Math.cos(turn)];
    return [
      [Math.cos(turn), 0, -Math.sin(turn)],
      [-Math.sin(tilt) * outward[0], Math.cos(tilt), -Math.sin(tilt) * outward[2]],
      [Math.cos(tilt) * outward[0], Math.sin(tilt), Math.cos(tilt) * outward[2]],
    ];
  }

  // Distance from the camera to the centre [length units]; 0: no perspective.
  get distance() {
    return this.dimension === 2 ? 0 : 5 * this.halfWidth;
  }

  // Length units of a pixel on the canvas, at the depth of the centre.
  unit(width, height) {
    return (2 * this.halfWidth) / (this.zoom * Math.min(...this.open(width, height)));
  }

  // Columns and rows of the canvas that no controls cover; the centre lies in their middle.
  open(width, height) {
    return [width * (1 - this.covered[0]), height * (1 - this.covered[1])];
  }

  // Projects a position to [column, row, nearness, scale]; pixels from the upper left corner.
  project(position, width, height) {
    const offset = this.centre.map((middle, k) => (position[k] ?? 0) - middle);
    const [across, up, near] = this.axes.map((axis) => dot(axis, offset));
    const scale = this.distance ? this.distance / (this.distance - near) : 1;
    const unit = this.unit(width, height), [columns, rows] = this.open(width, height);
    return [columns / 2 + (across * scale) / unit, rows / 2 - (up * scale) / unit, near, scale];
  }

  // The position under a pixel of the canvas, at a nearness: the distance from the centre towards the viewer.
  position(column, row, width, height, near = 0) {
    const [columns, rows] = this.open(width, height);
    const move = this.movement(column - columns / 2, row - rows / 2, width, height, near);
    return this.centre.map((middle, k) => middle + move[k] + near * this.axes[2][k]);
  }

  // The movement in space [length units] of a movement on the canvas [pixels], at a nearness.
  movement(columns, rows, width, height, near = 0) {
    const unit = this.unit(width, height);
    const fraction = this.distance ? 1 - near / this.distance : 1;
    const [right, up] = this.axes;
    return [0, 1, 2].map((k) => fraction * unit * (columns * right[k] - rows * up[k]));
  }

  // Moves or turns the camera by a drag [pixels].
  drag(columns, rows, width, height) {
    if (this.dimension === 2) {
      const move = this.movement(columns, rows, width, height);
      this.centre = this.centre.map((middle, k) => middle - move[k]);
    } else {
      this.azimuth -= columns * 0.4;
      this.elevation = Math.min(89, Math.max(-89, this.elevation + rows * 0.4));
    }
  }

  // Shows all positions except a few outliers.
  fit(positions) {
    const { dimension } = this, count = positions.length / dimension;
    if (!count) return;
    let far = 0;
    for (let d = 0; d < dimension; d++) {
      const along = Float32Array.from({ length: count }, (_, k) => positions[dimension * k + d]).sort();
      const low = along[Math.floor(0.01 * count)], high = along[Math.ceil(0.99 * count) - 1];
      this.centre[d] = (low + high) / 2;
      far = Math.max(far, (high - low) / 2);
    }
    this.zoom = 1;
    this.magnify(this.halfWidth / (1.15 * far || 1));
  }

  magnify(factor) {
    this.zoom = Math.min(20, Math.max(0.3, this.zoom * factor));
  }
}

function dot(a, b) {
  return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}

// What a painter draws:
//   {positions, colours, dimension, box, spot, camera, background: [r, g, b] in [0, 1],
//    look: "soft" | "points", still: nothing moves, which allows slow drawing,
//    trails: {positions: Float32Array of pairs of points [x, y, z], fades: Float32Array},
//    ink: [r, g, b] of trails}
// `kind`: "webgl2", "canvas", or "auto": WebGL2 unless it runs on the CPU, which is faster without it.
export function makePainter(canvas, kind = "auto") {
  const chosen = kind === "auto" ? quickest() : kind;
  const gl = chosen === "canvas" ? null : canvas.getContext("webgl2", { antialias: false, alpha: false });
  return gl ? new GlPainter(gl) : new PlainPainter(canvas.getContext("2d", { alpha: false }));
}

function quickest() {
  // On another canvas, because a canvas has only one kind of context.
  const gl = document.createElement("canvas").getContext("webgl2", { failIfMajorPerformanceCaveat: true });
  const names = gl?.getExtension("WEBGL_debug_renderer_info");
  const name = names ? gl.getParameter(names.UNMASKED_RENDERER_WEBGL) : "";
  gl?.getExtension("WEBGL_lose_context")?.loseContext();
  return gl && !/swiftshader|llvmpipe|software|basic render/i.test(name) ? "webgl2" : "canvas";
}

// Offsets of the images of a periodic world in the camera's view [length units].
function tiles(scene, width, height) {
  const { box, camera, dimension } = scene;
  if (!box || dimension !== 2) return [[0, 0, 0]];
  const unit = camera.unit(width, height);
  const range = (size, side, middle) => {
    const half = (size * unit) / 2 + SOFT_REACH * scene.spot;
    const first = Math.round((middle - half) / side), last = Math.round((middle + half) / side);
    return Array.from({ length: Math.min(last - first + 1, 16) }, (_, k) => (first + k) * side);
  };
  const rows = range(height, box[1], camera.centre[1]);
  return range(width, box[0], camera.centre[0]).flatMap((x) => rows.map((y) => [x, y, 0]));
}

// Particles, and the ends of trails, whose only colour is how opaque they are.
const SPOT_VERTEX = `#version 300 es
layout(location=0) in vec3 position;
layout(location=1) in vec3 colour;
uniform vec3 right, up, toward, centre, offset;
uniform vec2 unit;        // device units a length unit
uniform float distance_;  // of the camera; 0: no perspective
uniform float nearest;    // nearness that counts as the front
uniform vec2 covered;     // fractions of width and height that controls cover
uniform float size;       // pixels at the depth of the centre
out vec3 tint; out float light;
void main() {
  vec3 p = position + offset - centre;
  float near = dot(p, toward);
  float scale = distance_ > 0.0 ? distance_ / max(distance_ - near, 1e-3) : 1.0;
  vec2 at = vec2(dot(p, right), dot(p, up)) * scale * unit + vec2(-covered.x, covered.y);
  gl_Position = vec4(at, -near / nearest, 1.0);
  gl_PointSize = size * scale;
  tint = colour;
  light = distance_ > 0.0 ? clamp(0.95 + 0.5 * near / nearest, 0.45, 1.15) : 1.0;
}`;

// Soft spots: sums of colours and of densities, which the second pass shows over the background.
const SOFT_FRAGMENT = `#version 300 es
precision mediump float;
in vec3 tint; in float light; out vec4 sum;
void main() {
  vec2 r = 2.0 * gl_PointCoord - 1.0;
  float weight = exp(-5.12 * dot(r, r)) - 0.006;
  sum = weight > 0.0 ? vec4(tint, 1.0) * weight : vec4(0.0);
}`;

const SHOW_VERTEX = `#version 300 es
out vec2 at;
void main() {
  at = vec2(gl_VertexID & 1, gl_VertexID >> 1) * 2.0;
  gl_Position = vec4(2.0 * at - 1.0, 0.0, 1.0);
}`;

const SHOW_FRAGMENT = `#version 300 es
precision mediump float;
in vec2 at; uniform sampler2D sums; uniform vec3 background; out vec4 shown;
void main() {
  vec4 sum = texture(sums, at);
  float cover = smoothstep(0.35, 1.25, sum.a);
  shown = vec4(mix(background, sum.rgb / max(sum.a, 1e-3), cover), 1.0);
}`;

// Crisp spots: discs in 2D, opaque balls in 3D.
const BALL_FRAGMENT = `#version 300 es
precision mediump float;
in vec3 tint; in float light; uniform bool ball; uniform float edge; out vec4 shown;
void main() {
  vec2 r = 2.0 * gl_PointCoord - 1.0;
  float square = dot(r, r);
  if (square > 1.0) discard;
  if (ball) {
    vec3 normal = vec3(r.x, -r.y, sqrt(1.0 - square));
    float shade = 0.74 + 0.34 * dot(normal, vec3(-0.35, 0.6, 0.72));
    shown = vec4(tint * shade * light, 1.0);
  } else {
    float cover = clamp((1.0 - sqrt(square)) * edge, 0.0, 1.0);
    shown = vec4(tint * cover, cover);
  }
}`;

const TRAIL_FRAGMENT = `#version 300 es
precision mediump float;
in vec3 tint; uniform vec3 ink; out vec4 shown;
void main() { shown = vec4(ink, 1.0) * tint.r; }`;

// Sums of soft spots cover the background by the thresholds of SHOW_FRAGMENT: outlines are smooth, bodies have no gaps, and
// lone particles are small and faint.
const SOFT_WIDTH = 0.88; // standard deviation of a soft spot, in those of the scene's spots
const SOFT_REACH = 3.2; // standard deviations of a soft spot that are drawn
const BUFFER_SPOT = 1.6; // standard deviation of a soft spot in the buffer of sums [pixels], at most

class GlPainter {
  constructor(gl) {
    this.gl = gl;
    this.kind = "webgl2";
    this.sums = gl.getExtension("EXT_color_buffer_float")
      ? { texture: gl.createTexture(), frame: gl.createFramebuffer(), width: 0, height: 0 } : null;
    this.programs = {
      soft: linked(gl, SPOT_VERTEX, SOFT_FRAGMENT),
      ball: linked(gl, SPOT_VERTEX, BALL_FRAGMENT),
      show: linked(gl, SHOW_VERTEX, SHOW_FRAGMENT),
      trail: linked(gl, SPOT_VERTEX, TRAIL_FRAGMENT),
    };
    this.positions = gl.createBuffer();
    this.tints = gl.createBuffer();
  }

  draw(scene) {
    const gl = this.gl, width = gl.drawingBufferWidth, height = gl.drawingBufferHeight;
    const { dimension, positions, colours, background, camera } = scene;
    const soft = this.sums && dimension === 2 && scene.look === "soft";
    const pixels = (scene.spot * (soft ? SOFT_WIDTH : 1)) / camera.unit(width, height);
    const shrink = soft ? Math.min(1, BUFFER_SPOT / pixels) : 1;
    gl.disable(gl.DEPTH_TEST);
    gl.enable(gl.BLEND);
    if (soft) this.sizeSums(Math.ceil(width * shrink), Math.ceil(height * shrink));
    gl.bindFramebuffer(gl.FRAMEBUFFER, soft ? this.sums.frame : null);
    const [across, down] = soft ? [this.sums.width, this.sums.height] : [width, height];
    gl.viewport(0, 0, across, down);
    gl.clearColor(...(soft ? [0, 0, 0, 0] : [...background, 1]));
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    const program = soft ? this.programs.soft : this.programs.ball;
    gl.useProgram(program.program);
    this.setCamera(program, scene, width, height);
    attribute(gl, 0, this.positions, positions, dimension);
    attribute(gl, 1, this.tints, colours, 3);
    if (soft) {
      gl.blendFunc(gl.ONE, gl.ONE);
      gl.uniform1f(program.size, Math.max(2 * SOFT_REACH * pixels * shrink, 2));
    } else {
      const size = Math.max((dimension === 3 ? 3.2 : 1.4) * pixels, 2);
      gl.uniform1f(program.size, size);
      gl.uniform1i(program.ball, dimension === 3);
      gl.uniform1f(program.edge, size / 2);
      if (dimension === 3) {
        gl.enable(gl.DEPTH_TEST);
        gl.disable(gl.BLEND);
      } else gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    }
    for (const offset of tiles(scene, width, height)) {
      gl.uniform3fv(program.offset, offset);
      gl.drawArrays(gl.POINTS, 0, positions.length / dimension);
    }
    if (soft) {
      const show = this.programs.show;
      gl.bindFramebuffer(gl.FRAMEBUFFER, null);
      gl.viewport(0, 0, width, height);
      gl.useProgram(show.program);
      gl.disable(gl.BLEND);
      gl.bindTexture(gl.TEXTURE_2D, this.sums.texture);
      gl.uniform3fv(show.background, background);
      gl.drawArrays(gl.TRIANGLES, 0, 3);
    }
    this.drawTrails(scene, width, height);
  }

  setCamera(program, { camera }, width, height) {
    const gl = this.gl, unit = camera.unit(width, height);
    const [right, up, toward] = camera.axes;
    gl.uniform3fv(program.right, right);
    gl.uniform3fv(program.up, up);
    gl.uniform3fv(program.toward, toward);
    gl.uniform3fv(program.centre, camera.centre);
    gl.uniform3fv(program.offset, [0, 0, 0]);
    gl.uniform2f(program.unit, 2 / (unit * width), 2 / (unit * height));
    gl.uniform1f(program.distance_, camera.distance);
    gl.uniform1f(program.nearest, 2 * camera.halfWidth);
    gl.uniform2f(program.covered, ...camera.covered);
  }

  drawTrails(scene, width, height) {
    const gl = this.gl, program = this.programs.trail;
    gl.useProgram(program.program);
    this.setCamera(program, scene, width, height);
    gl.disable(gl.DEPTH_TEST);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    gl.uniform3fv(program.ink, scene.ink);
    attribute(gl, 0, this.positions, scene.trails.positions, 3);
    attribute(gl, 1, this.tints, scene.trails.fades, 1);
    gl.drawArrays(gl.LINES, 0, scene.trails.fades.length);
  }

  sizeSums(width, height) {
    const gl = this.gl, sums = this.sums;
    if (sums.width === width && sums.height === height) return;
    Object.assign(sums, { width, height });
    gl.bindTexture(gl.TEXTURE_2D, sums.texture);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA16F, width, height, 0, gl.RGBA, gl.HALF_FLOAT, null);
    for (const [name, value] of [
      [gl.TEXTURE_MIN_FILTER, gl.LINEAR], [gl.TEXTURE_MAG_FILTER, gl.LINEAR],
      [gl.TEXTURE_WRAP_S, gl.CLAMP_TO_EDGE], [gl.TEXTURE_WRAP_T, gl.CLAMP_TO_EDGE],
    ]) gl.texParameteri(gl.TEXTURE_2D, name, value);
    gl.bindFramebuffer(gl.FRAMEBUFFER, sums.frame);
    gl.framebufferTexture2D(
      gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, sums.texture, 0);
  }
}

// Reads an input of shaders from an array of float32, or of bytes from 0 to 1; missing coordinates are 0.
function attribute(gl, location, buffer, data, size) {
  const bytes = data instanceof Uint8Array;
  gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
  gl.bufferData(gl.ARRAY_BUFFER, data, gl.DYNAMIC_DRAW);
  gl.enableVertexAttribArray(location);
  gl.vertexAttribPointer(location, size, bytes ? gl.UNSIGNED_BYTE : gl.FLOAT, bytes, 0, 0);
}

// A program with the locations of its uniforms by name.
function linked(gl, vertex, fragment) {
  const program = gl.createProgram();
  for (const [type, source] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
    const shader = gl.createShader(type);
    gl.shaderSource(shader, source);
    gl.compileShader(shader);
    if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw Error(gl.getShaderInfoLog(shader));
    gl.attachShader(program, shader);
  }
  gl.linkProgram(program);
  const linkedProgram = { program };
  for (let k = 0; k < gl.getProgramParameter(program, gl.ACTIVE_UNIFORMS); k++) {
    const { name } = gl.getActiveUniform(program, k);
    linkedProgram[name] = gl.getUniformLocation(program, name);
  }
  return linkedProgram;
}

const PLAIN_PIXELS = [640, 1200]; // on the longer side of the small picture, least and most
const PLAIN_TIME = 16; // milliseconds that a picture may take
const COVERS = Float32Array.from({ length: 1024 }, (_, k) => {
  const rise = Math.min(1, Math.max(0, (k / 512 - 0.35) / 0.9));
  return rise * rise * (3 - 2 * rise);
});

// Without WebGL: spots are written into a picture, as large as time allows, and stretched to the canvas.
class PlainPainter {
  constructor(context) {
    this.context = context;
    this.kind = "canvas";
    this.small = document.createElement("canvas");
    this.pixels = PLAIN_PIXELS[0];
  }

  draw(scene) {
    const started = performance.now(), { context, small } = this;
    const { width, height } = context.canvas;
    const shrink = Math.min(1, (scene.still ? PLAIN_PIXELS[1] : this.pixels) / Math.max(width, height));
    const across = Math.ceil(width * shrink), down = Math.ceil(height * shrink);
    if (small.width !== across || small.height !== down) {
      Object.assign(small, { width: across, height: down });
      this.picture = small.getContext("2d").createImageData(across, down);
    }
    const soft = scene.dimension === 2 && scene.look === "soft";
    const spot = (scene.spot * (soft ? SOFT_WIDTH : 1)) / scene.camera.unit(across, down);
    const coarse = soft ? Math.min(1, BUFFER_SPOT / spot) : 1;
    const columns = Math.ceil(across * coarse), rows = Math.ceil(down * coarse);
    if (this.sums?.length !== 4 * columns * rows) this.sums = new Float32Array(4 * columns * rows);
    this.sums.fill(0);
    for (const offset of tiles(scene, columns, rows)) {
      const spots = projected(scene, offset, columns, rows);
      if (soft) addSpots(this.sums, columns, rows, spots, scene.colours, Math.max(coarse * spot, 0.6));
      else addBalls(this.sums, columns, rows, spots, scene, Math.max(spot, 0.5));
    }
    if (soft) showSoft(this.picture, this.sums, columns, rows, scene.background);
    else showBalls(this.picture.data, this.sums, scene.background);
    small.getContext("2d").putImageData(this.picture, 0, 0);
    context.imageSmoothingEnabled = true;
    context.imageSmoothingQuality = "low";
    context.drawImage(small, 0, 0, width, height);
    this.drawTrails(scene, width, height);
    if (scene.still) return;
    const taken = performance.now() - started, [least, most] = PLAIN_PIXELS;
    // In steps, so that the picture is not allocated again in every frame.
    if (taken > 1.5 * PLAIN_TIME) this.pixels = Math.max(least, this.pixels - 80);
    else if (taken < 0.4 * PLAIN_TIME) this.pixels = Math.min(most, this.pixels + 80);
  }

  drawTrails({ trails, ink, camera }, width, height) {
    const { context } = this;
    context.lineWidth = 1.5;
    context.strokeStyle = `rgba(${ink.map((v) => Math.round(255 * v)).join(",")},0.65)`;
    context.beginPath();
    for (let k = 0; k < trails.positions.length; k += 6) {
      const [from, to] = [k, k + 3].map((at) =>
        camera.project(trails.positions.subarray(at, at + 3), width, height));
      context.moveTo(from[0], from[1]);
      context.lineTo(to[0], to[1]);
    }
    context.stroke();
  }
}

// Column, row, nearness and scale of all particles, as by `Camera.project`.
function projected({ positions, dimension, camera }, offset, width, height) {
  const count = positions.length / dimension, spots = new Float32Array(4 * count);
  const [right, up, toward] = camera.axes, unit = camera.unit(width, height), { distance, centre } = camera;
  const [columns, rows] = camera.open(width, height);
  for (let k = 0; k < count; k++) {
    const x = positions[dimension * k] + offset[0] - centre[0];
    const y = positions[dimension * k + 1] + offset[1] - centre[1];
    const z = (dimension === 3 ? positions[3 * k + 2] : 0) + offset[2] - centre[2];
    const near = x * toward[0] + y * toward[1] + z * toward[2];
    const scale = distance ? distance / Math.max(distance - near, 1e-3) : 1;
    spots[4 * k] = columns / 2 + ((x * right[0] + y * right[1] + z * right[2]) * scale) / unit;
    spots[4 * k + 1] = rows / 2 - ((x * up[0] + y * up[1] + z * up[2]) * scale) / unit;
    spots[4 * k + 2] = near / unit;
    spots[4 * k + 3] = scale;
  }
  return spots;
}

// Adds soft spots: sums of colours and of weights. They end round, where they are faint.
function addSpots(sums, width, height, spots, colours, spot) {
  const extent = SOFT_REACH * spot, fall = -0.5 / (spot * spot), faint = Math.exp(-0.5 * SOFT_REACH ** 2);
  const weights = new Float32Array(2 * Math.ceil(extent) + 2);
  for (let k = 0; k < spots.length / 4; k++) {
    const column = spots[4 * k], row = spots[4 * k + 1];
    const left = Math.max(0, Math.ceil(column - extent)), last = Math.min(width - 1, Math.floor(column + extent));
    const top = Math.max(0, Math.ceil(row - extent)), end = Math.min(height - 1, Math.floor(row + extent));
    for (let x = left; x <= last; x++) weights[x - left] = Math.exp(fall * (x - column) ** 2);
    const red = colours[3 * k], green = colours[3 * k + 1], blue = colours[3 * k + 2];
    for (let y = top; y <= end; y++) {
      const factor = Math.exp(fall * (y - row) ** 2);
      for (let x = left, p = 4 * (y * width + left); x <= last; x++, p += 4) {
        const weight = factor * weights[x - left] - faint;
        if (weight <= 0) continue;
        sums[p] += weight * red;
        sums[p + 1] += weight * green;
        sums[p + 2] += weight * blue;
        sums[p + 3] += weight;
      }
    }
  }
}

// Writes opaque balls or flat discs; the fourth sum is their nearness.
function addBalls(sums, width, height, spots, { colours, dimension, camera }, spot) {
  const solid = dimension === 3, span = 2 * camera.halfWidth;
  for (let k = 0; k < spots.length / 4; k++) {
    const column = spots[4 * k], row = spots[4 * k + 1], near = spots[4 * k + 2];
    const radius = (solid ? 1.6 : 0.7) * spot * spots[4 * k + 3];
    const depth = near * camera.unit(width, height);
    const light = solid ? Math.min(1.15, Math.max(0.45, 0.95 + (0.5 * depth) / span)) : 1;
    const left = Math.max(0, Math.ceil(column - radius)), last = Math.min(width - 1, column + radius);
    const top = Math.max(0, Math.ceil(row - radius)), end = Math.min(height - 1, row + radius);
    for (let y = top; y <= end; y++) {
      for (let x = left; x <= last; x++) {
        const across = (x - column) / radius, down = (y - row) / radius;
        const square = across * across + down * down, p = 4 * (y * width + x);
        if (square > 1) continue;
        const front = Math.sqrt(1 - square), nearness = 1e6 + near + (solid ? front * radius : k * 1e-3);
        if (nearness < sums[p + 3]) continue;
        const shade = solid ? light * (0.74 + 0.34 * (0.72 * front - 0.35 * across - 0.6 * down)) : 1;
        sums[p] = shade * colours[3 * k];
        sums[p + 1] = shade * colours[3 * k + 1];
        sums[p + 2] = shade * colours[3 * k + 2];
        sums[p + 3] = nearness;
      }
    }
  }
}

// Stretches sums to the picture, by linear interpolation.
function showSoft({ data, width, height }, sums, columns, rows, background) {
  const pixels = new Uint32Array(data.buffer), line = new Float32Array(4 * (columns + 1));
  const [red, green, blue] = background.map((v) => 255 * v), full = COVERS.length - 1;
  const colour = (r, g, b) => (255 << 24) | (b << 16) | (g << 8) | r, bare = colour(red, green, blue);
  const place = (pixel, size, count) => Math.min(count - 1, Math.max(0, ((pixel + 0.5) * count) / size - 0.5));
  const places = Float32Array.from({ length: width }, (_, x) => place(x, width, columns));
  for (let y = 0, p = 0; y < height; y++) {
    const at = place(y, height, rows), down = at % 1;
    const above = 4 * columns * Math.floor(at), below = 4 * columns * Math.min(rows - 1, Math.floor(at) + 1);
    for (let k = 0; k < 4 * columns; k++) line[k] = sums[above + k] + down * (sums[below + k] - sums[above + k]);
    for (let x = 0; x < width; x++, p++) {
      const column = places[x] | 0, next = places[x] - column, rest = 1 - next, l = 4 * column;
      const weight = rest * line[l + 3] + next * line[l + 7], cover = COVERS[Math.min(full, (weight * 512) | 0)];
      if (cover === 0) pixels[p] = bare;
      else {
        const part = 1 - cover, near = (rest * cover) / weight, far = (next * cover) / weight;
        pixels[p] = colour(
          part * red + near * line[l] + far * line[l + 4], part * green + near * line[l + 1] + far * line[l + 5],
          part * blue + near * line[l + 2] + far * line[l + 6]);
      }
    }
  }
}

function showBalls(data, sums, background) {
  const ground = background.map((v) => 255 * v);
  for (let p = 0; p < sums.length; p += 4) {
    for (let c = 0; c < 3; c++) data[p + c] = sums[p + 3] > 0 ? sums[p + c] : ground[c];
    data[p + 3] = 255;
  }
}

const TRACED = 300; // particles with a trail
const TRAIL_LENGTH = 48; // frames of a trail

// Positions of some particles in the last frames.
export class Tracers {
  constructor() {
    this.clear();
  }

  clear() {
    this.frames = [];
    this.count = 0;
  }

  add(positions, dimension) {
    const count = positions.length / dimension;
    if (count !== this.count) this.clear();
    this.count = count;
    const traced = Math.min(TRACED, count), points = new Float32Array(3 * traced);
    for (let k = 0; k < traced; k++) {
      const particle = Math.floor(((k + 0.5) * count) / traced);
      for (let d = 0; d < dimension; d++) points[3 * k + d] = positions[dimension * particle + d];
    }
    this.frames.push(points);
    if (this.frames.length > TRAIL_LENGTH) this.frames.shift();
  }

  // The lines of `marksOf`, and from frame to frame, older ones fainter; none across a box's edge.
  lines(box, marks = []) {
    const points = marks.flatMap(([x, y, across, up]) => [x, y, 0, x + across, y + up, 0]);
    const fades = marks.flatMap(([, , , , fade]) => [fade, fade]), longest = box ? Math.min(...box) / 2 : Infinity;
    for (let f = 1; f < this.frames.length; f++) {
      const from = this.frames[f - 1], to = this.frames[f];
      const fade = 0.75 * (f / this.frames.length) ** 1.5;
      for (let k = 0; k < to.length; k += 3) {
        if (Math.hypot(to[k] - from[k], to[k + 1] - from[k + 1]) > longest) continue;
        points.push(from[k], from[k + 1], from[k + 2], to[k], to[k + 1], to[k + 2]);
        fades.push(fade, fade);
      }
    }
    return { positions: new Float32Array(points), fades: new Float32Array(fades) };
  }
}

// Lines [x, y, across, up, fade] that show a step of an environment: its target's outline, pushes as arrows twice as long.
export function marksOf(outline, { middle, pushes }) {
  const arrows = pushes.flatMap(([x, y, u, v]) => [[x, y, 2 * u, 2 * v, 1], ...[0.36, -0.36].map((side) =>
    [x + 2 * u, y + 2 * v, -0.6 * u - side * v, -0.6 * v + side * u, 1])]);
  return [...arrows, ...outline.map(([x, y, u, v]) => [middle[0] + x, middle[1] + y, u, v, 0.6])];
}
