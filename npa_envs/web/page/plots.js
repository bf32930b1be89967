// Small line plots to which points are added.

const KEPT = 2000; // points of a plot; older ones are thinned out

export class Plot {
  // A line with a title in `parent`; `unit` follows the last number.
  constructor(parent, title, unit = "", { log = false } = {}) {
    this.unit = unit;
    this.log = log;
    this.points = [];
    this.figure = make("figure", {
      className: "plot", innerHTML: '<figcaption><span></span><output></output></figcaption>' +
        '<svg viewBox="0 0 1 1" preserveAspectRatio="none" aria-hidden="true"><polyline/></svg>',
    });
    this.figure.querySelector("span").textContent = title;
    this.value = this.figure.querySelector("output");
    this.line = this.figure.querySelector("polyline");
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
    const { points } = this;
    this.value.textContent = points.length ? `${short(points.at(-1)[1])} ${this.unit}` : "–";
    const levels = points.map(([, y]) => (this.log ? Math.log10(Math.max(y, 1e-12)) : y));
    const low = this.log ? Math.min(...levels) : Math.min(0, ...levels);
    const span = Math.max(...levels) - low || 1, first = points[0]?.[0], range = points.at(-1)?.[0] - first || 1;
    const places = points.map(([x], k) => `${(x - first) / range},${1 - (levels[k] - low) / span}`);
    this.line.setAttribute("points", places.join(" "));
  }
}

// Returns a new element of the page with some properties.
export function make(tag, properties = {}) {
  return Object.assign(document.createElement(tag), properties);
}

export function short(number) {
  const size = Math.abs(number);
  if (Number.isInteger(number) && size < 1e6) return String(number);
  if (size >= 1e5 || (size > 0 && size < 0.001)) return number.toExponential(1);
  return String(+number.toPrecision(3));
}
