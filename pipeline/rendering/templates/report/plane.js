"use strict";
// The plane of stiffness and damping: one mark a trial, drawn on a canvas in the colours of the page.

const NEAR = 14; // largest distance [px] of the pointer from a trial that it means
const SHADES = 6;
const RATIOS = [1.1, 1.25, 1.5, 2, 4]; // cost over the least cost, upper ends of the shades
const PERCENTS = [1, 10, 25, 50, 75]; // the same for overshoot, whose least value is 0

/** Colour of the page's style sheet. */
const colour = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();

/** Round step that divides a range into about so many parts. */
function niceStep(range, parts) {
  const rough = range / parts;
  const power = 10 ** Math.floor(Math.log10(rough));
  return [1, 2, 2.5, 5, 10].map((m) => m * power).find((step) => step >= rough * 0.999);
}

const plain = (value) => String(Number(value.toPrecision(6))).replace("-", "−");

class Plane {
  /** `onMove` and `onPick` get the row of the trial under the pointer or cursor. */
  constructor(canvas, onMove, onPick) {
    this.canvas = canvas;
    this.trials = null;
    this.cursor = -1;
    this.picked = -1;
    this.onMove = onMove;
    this.onPick = onPick;
    canvas.addEventListener("pointermove", (event) => this.move(this.nearest(event)));
    canvas.addEventListener("click", (event) => this.pick(this.nearest(event)));
    canvas.addEventListener("keydown", (event) => this.key(event));
    canvas.addEventListener("focus", () => { if (this.trials && this.cursor < 0) this.move(this.picked >= 0 ? this.picked : 0); });
    new ResizeObserver(() => this.draw()).observe(canvas);
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.draw());
  }

  /** Show trials: columns `k`, `b`, `v` (verdict), set of rows `rims`, lines `measured` and `theory`, and unit texts. */
  show(trials) {
    this.trials = trials;
    this.cursor = -1;
    this.picked = -1;
    const ends = (values) => [Math.min(0, ...values), Math.max(0, ...values) * 1.04 || 1];
    this.kEnds = ends([...trials.k, ...(trials.theory?.[0] ?? [])].filter((x) => x !== null));
    this.bEnds = ends([...trials.b, ...(trials.theory?.[1] ?? [])].filter((x) => x !== null));
    this.order = [...trials.k.keys()].sort((i, j) => trials.b[i] - trials.b[j] || trials.k[i] - trials.k[j]);
  }

  /** Colour by costs (null where there is none), or by the verdict where `costs` is null. */
  paint(costs, overshoot) {
    this.shades = null;
    this.limits = null;
    if (costs) {
      const known = costs.filter((cost) => cost !== null);
      const least = known.length ? Math.min(...known) : 0;
      this.limits = overshoot ? PERCENTS : RATIOS.map((ratio) => ratio * least);
      this.shades = costs.map((cost) => cost === null ? -1 : this.limits.filter((limit) => cost > limit).length);
    }
    this.draw();
  }

  x(k) { return this.left + (k - this.kEnds[0]) / (this.kEnds[1] - this.kEnds[0]) * this.width; }

  y(b) { return this.top + (this.bEnds[1] - b) / (this.bEnds[1] - this.bEnds[0]) * this.height; }

  nearest(event) {
    if (!this.trials) return -1;
    const box = this.canvas.getBoundingClientRect();
    const [px, py] = [event.clientX - box.left, event.clientY - box.top];
    let [best, least] = [-1, NEAR ** 2];
    this.trials.k.forEach((k, row) => {
      const distance = (this.x(k) - px) ** 2 + (this.y(this.trials.b[row]) - py) ** 2;
      if (distance < least) [best, least] = [row, distance];
    });
    return best;
  }

  move(row) {
    if (row === this.cursor || row < 0) return;
    this.cursor = row;
    this.draw();
    this.onMove(row);
  }

  pick(row) {
    if (row < 0) return;
    this.cursor = row;
    this.picked = row;
    this.draw();
    this.onPick(row);
  }

  key(event) {
    if (!this.trials || event.ctrlKey || event.metaKey || event.altKey) return;
    const place = this.order.indexOf(this.cursor);
    const steps = {
      ArrowLeft: () => this.order[Math.max(place - 1, 0)],
      ArrowRight: () => this.order[Math.min(place + 1, this.order.length - 1)],
      ArrowUp: () => this.beside(1),
      ArrowDown: () => this.beside(-1),
      Home: () => this.order[0],
      End: () => this.order[this.order.length - 1],
    };
    if (event.key === "Enter" || event.key === " ") this.pick(this.cursor);
    else if (steps[event.key]) this.move(steps[event.key]());
    else return;
    event.preventDefault();
  }

  /** Trial of the next damping above (1) or below (-1) whose stiffness is nearest. */
  beside(direction) {
    const { k, b } = this.trials;
    const here = this.cursor;
    let best = here;
    for (const row of this.order) {
      if ((b[row] - b[here]) * direction <= 0) continue;
      const [gap, least] = [Math.abs(b[row] - b[here]), best === here ? Infinity : Math.abs(b[best] - b[here])];
      if (gap < least || (gap === least && Math.abs(k[row] - k[here]) < Math.abs(k[best] - k[here]))) best = row;
    }
    return best;
  }

  draw() {
    const { canvas } = this;
    if (!this.trials || !canvas.clientWidth) return;
    const ratio = devicePixelRatio || 1;
    const [wide, high] = [canvas.clientWidth, canvas.clientHeight];
    [canvas.width, canvas.height] = [Math.round(wide * ratio), Math.round(high * ratio)];
    const pen = canvas.getContext("2d");
    pen.scale(ratio, ratio);
    [this.left, this.top, this.width, this.height] = [52, 10, wide - 64, high - 54];
    const [ink, paper] = [colour("--ink"), colour("--paper")];
    this.axes(pen, ink);
    this.line(pen, this.trials.theory, ink, [6, 4]);
    this.line(pen, this.trials.measured, ink, []);
    this.open(pen, this.trials.open, ink, paper);
    const size = Math.max(2, Math.min(4.5, 110 / Math.sqrt(this.trials.k.length)));
    this.trials.k.forEach((k, row) => this.mark(pen, row, size, ink, paper));
    for (const [row, width] of [[this.picked, 2.5], [this.cursor, 1.5]]) {
      if (row < 0) continue;
      pen.strokeStyle = ink;
      pen.lineWidth = width;
      pen.beginPath();
      pen.arc(this.x(this.trials.k[row]), this.y(this.trials.b[row]), size + 5, 0, 7);
      pen.stroke();
    }
  }

  axes(pen, ink) {
    pen.font = `12px ${colour("--sans")}`;
    pen.lineWidth = 1;
    pen.fillStyle = ink;
    const [kStep, bStep] = [niceStep(this.kEnds[1] - this.kEnds[0], this.width / 80), niceStep(this.bEnds[1] - this.bEnds[0], this.height / 50)];
    const ticks = (ends, step) => {
      const first = Math.ceil(ends[0] / step - 1e-9);
      return Array.from({ length: Math.floor(ends[1] / step) - first + 1 }, (_, n) => (first + n) * step);
    };
    const rule = (x1, y1, x2, y2, stroke) => {
      pen.strokeStyle = stroke;
      pen.beginPath();
      pen.moveTo(x1, y1);
      pen.lineTo(x2, y2);
      pen.stroke();
    };
    const [right, bottom, faint] = [this.left + this.width, this.top + this.height, colour("--fig-faint")];
    pen.textAlign = "center";
    for (const k of ticks(this.kEnds, kStep)) {
      rule(this.x(k), this.top, this.x(k), bottom, faint);
      // the last number ends at the edge of the canvas, where it would be cut
      pen.fillText(plain(k), Math.min(this.x(k), right + 12 - pen.measureText(plain(k)).width / 2), bottom + 16);
    }
    pen.fillText(`stiffness K [${this.trials.units.stiffness}]`, this.left + this.width / 2, bottom + 36);
    pen.textAlign = "right";
    for (const b of ticks(this.bEnds, bStep)) {
      rule(this.left, this.y(b), right, this.y(b), faint);
      pen.fillText(plain(b), this.left - 6, this.y(b) + 4);
    }
    pen.save();
    pen.translate(13, this.top + this.height / 2);
    pen.rotate(-Math.PI / 2);
    pen.textAlign = "center";
    pen.fillText(`damping B [${this.trials.units.damping}]`, 0, 0);
    pen.restore();
    rule(this.left, this.top, this.left, bottom, ink);
    rule(this.left, bottom, right, bottom, ink);
  }

  line(pen, points, stroke, dash) {
    if (!points) return;
    pen.strokeStyle = stroke;
    pen.lineWidth = 1.5;
    pen.setLineDash(dash);
    pen.beginPath();
    let drawn = false;
    points[0].forEach((k, n) => {
      const b = points[1][n];
      if (k === null || b === null) drawn = false;
      else if (drawn) pen.lineTo(this.x(k), this.y(b));
      else { pen.moveTo(this.x(k), this.y(b)); drawn = true; }
    });
    pen.stroke();
    pen.setLineDash([]);
  }

  /** Limits of which only a lower bound is known: open marks, which no line joins. */
  open(pen, points, ink, paper) {
    [pen.strokeStyle, pen.fillStyle, pen.lineWidth] = [ink, paper, 1.5];
    points?.[0].forEach((k, n) => {
      pen.beginPath();
      pen.rect(this.x(k) - 5, this.y(points[1][n]) - 5, 10, 10);
      pen.fill();
      pen.stroke();
    });
  }

  mark(pen, row, size, ink, paper) {
    const { k, b, v, rims } = this.trials;
    const [x, y, verdict] = [this.x(k[row]), this.y(b[row]), this.trials.verdicts[v[row]]];
    const shade = this.shades ? this.shades[row] : -1;
    pen.beginPath();
    if (verdict === "unstable") {
      const arm = size * 0.8;
      pen.strokeStyle = this.shades ? colour("--soft") : colour("--fig-vermillion");
      pen.lineWidth = rims.has(row) ? 2 : 1;
      pen.moveTo(x - arm, y - arm);
      pen.lineTo(x + arm, y + arm);
      pen.moveTo(x - arm, y + arm);
      pen.lineTo(x + arm, y - arm);
      pen.stroke();
      return;
    }
    if (verdict === "undecided") {
      pen.rect(x - size * 0.8, y - size * 0.8, size * 1.6, size * 1.6);
      pen.fillStyle = shade >= 0 ? colour(`--shade-${shade + 1}`) : paper;
      pen.fill();
      pen.strokeStyle = ink;
      pen.lineWidth = rims.has(row) ? 1 : 0.7;
      pen.stroke();
      return;
    }
    // the better a trial the larger its mark, so that shades are not told by colour alone
    pen.arc(x, y, shade < 0 ? size * 0.7 : size * (1.2 - 0.08 * shade), 0, 7);
    const filled = this.shades ? shade >= 0 : verdict === "stable";
    pen.fillStyle = !filled ? paper : this.shades ? colour(`--shade-${shade + 1}`) : colour("--fig-blue");
    pen.fill();
    if (rims.has(row) || !filled) {
      pen.strokeStyle = rims.has(row) ? ink : colour("--soft");
      pen.lineWidth = rims.has(row) ? 1 : 0.7;
      pen.stroke();
    }
  }
}
