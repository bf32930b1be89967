// Small line plots to which points are added.

const KEPT = 2000; // points of a plot; older ones are thinned out

export class Plot {
  // A canvas with a title in `parent`; `unit` follows the last number.
  constructor(parent, title, unit = "", { log = false } = {}) {
    this.unit = unit;
    this.log = log;
    this.points = [];
    this.figure = make("figure", { className: "plot" });
    const caption = make("figcaption");
    this.value = make("output");
    caption.append(make("span", { textContent: title }), this.value);
    this.canvas = make("canvas");
    this.canvas.setAttribute("role", "img");
    this.canvas.setAttribute("aria-label", title);
    this.figure.append(caption, this.canvas);
    parent.append(this.figure);
  }

  add(x, y) {
    if (!Number.isFinite(y)) return;
    const last = this.points.at(-1);
    if (last && x < last[0]) this.points = [];
    if (last && x === last[0]) this.points.pop(); // Replaces the last point while the world is paused.
    this.points.push([x, y]);
    if (this.points.length > KEPT) this.points = this.points.filter((_, k) => k % 2 || k > KEPT / 2);
  }

  clear() {
    this.points = [];
    this.draw();
  }

  draw() {
    const { canvas, points } = this;
    this.value.textContent = points.length ? `${short(points.at(-1)[1])} ${this.unit}` : "–";
    const ratio = window.devicePixelRatio || 1;
    const width = Math.round(canvas.clientWidth * ratio), height = Math.round(canvas.clientHeight * ratio);
    if (!width || !height) return;
    if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
    const context = canvas.getContext("2d");
    context.clearRect(0, 0, width, height);
    if (points.length < 2) return;
    const level = (y) => (this.log ? Math.log10(Math.max(y, 1e-12)) : y);
    const levels = points.map(([, y]) => level(y));
    const low = this.log ? Math.min(...levels) : Math.min(0, ...levels);
    const high = Math.max(...levels), span = high - low || 1;
    const first = points[0][0], range = points.at(-1)[0] - first || 1;
    context.beginPath();
    points.forEach(([x], k) => context.lineTo(
      ((x - first) / range) * (width - 2) + 1,
      height - 2 - ((levels[k] - low) / span) * (height - 4)));
    context.lineJoin = "round";
    context.lineWidth = 1.5 * ratio;
    context.strokeStyle = getComputedStyle(canvas).color;
    context.stroke();
  }
}

// Returns a new element of the page with some properties.
export function make(tag, properties = {}) {
  return Object.assign(document.createElement(tag), properties);
}

export function short(number) {
  const size = Math.abs(number);
  if (Number.isInteger(number) && size < 1e6) return String(number);
  if (size >= 1000 || (size > 0 && size < 0.001)) return number.toExponential(1);
  return String(+number.toPrecision(3));
}
