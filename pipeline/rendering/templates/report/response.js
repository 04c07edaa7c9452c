"use strict";
// The response of one trial: log, fitted model, band of the settling time, and the samples that are trimmed.

const PARTS = 4096; // parts of one in which coefficients are written, as in `trial_page`

/** Values of a signal from what a prediction by its past missed: what `trial_codec.code` wrote. */
function decode(coded, step) {
  const counted = [];
  for (const missed of coded.r) {
    const sum = coded.c.reduce((total, c, lag) => total + c * (counted[counted.length - 1 - lag] ?? 0), 0);
    counted.push(missed + Math.floor((sum + PARTS / 2) / PARTS));
  }
  return counted.map((value) => value * step);
}

/** Rows of a response, counted from the command edge. */
function samplesFromEdge(trial) {
  let row = 0;
  return trial.x.r.map((_, n) => { row = trial.rows ? row + trial.rows[n] : n; return row - trial.edge; });
}

class ResponsePlot {
  constructor(holder) {
    this.holder = holder;
    this.plot = null;
    this.shown = null;
    this.again = null;
    new ResizeObserver(() => { if (this.plot && holder.clientWidth !== this.plot.width) this.plot.setSize(this.size()); }).observe(holder);
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.again?.());
  }

  /** First and last sample to show: the motion, or the whole record. */
  range(trial, whole) {
    const [samples, log] = [samplesFromEdge(trial), decode(trial.x, 1)];
    const [last, reach] = [log[log.length - 1], Math.max(...log) - Math.min(...log)];
    const calm = log.findLastIndex((value) => Math.abs(value - last) > 0.02 * reach);
    const end = samples[samples.length - 1];
    return whole ? [samples[0], end] : [Math.max(samples[0], -10), Math.min(end, Math.max(60, 2 * samples[Math.max(calm, 0)]))];
  }

  zoom(whole) {
    const [min, max] = this.range(this.shown.trial, whole);
    this.plot?.setScale("x", { min, max });
  }

  size() { return { width: this.holder.clientWidth || 320, height: 320 }; }

  clear() {
    this.plot?.destroy();
    this.plot = null;
    this.shown = null;
    this.again = null;
  }

  /** Draw lines over samples: entries of `series` have a label and a look. */
  draw(data, series, label, hooks = {}) {
    const [ink, faint] = [colour("--ink"), colour("--fig-faint")];
    const axis = { stroke: ink, grid: { stroke: faint, width: 1 }, ticks: { stroke: ink, width: 1, size: 4 }, font: `12px ${colour("--sans")}`, labelFont: `12px ${colour("--sans")}` };
    const value = (_, found) => (found === null || found === undefined ? "–" : plain(Number(found.toPrecision(4))));
    this.plot = new uPlot({
      ...this.size(),
      scales: { x: { time: false } },
      axes: [
        { ...axis, size: 30, labelSize: 22, labelGap: 0, label: "samples from the command edge" },
        { ...axis, size: 48, labelSize: 20, labelGap: 0, label },
      ],
      series: [{ label: "sample", value }, ...series.map((entry) => ({ spanGaps: true, points: { show: false }, value, ...entry }))],
      legend: { live: true },
      cursor: { drag: { x: true, y: false } },
      hooks,
    }, data, this.holder);
  }

  /** Draw responses over each other, relative to their final positions where all have one. */
  compare(trials, labels, unit) {
    this.clear();
    if (!trials.length) return;
    const relative = trials.every((trial) => trial.f);
    const tables = trials.map((trial) => [samplesFromEdge(trial), decode(trial.x, trial.q).map((value) => (relative ? value / trial.f : value * 1000))]);
    const series = labels.map((label, n) => ({ label, stroke: colour(COMPARED[n][0]), dash: COMPARED[n][1], width: 1.6 }));
    this.draw(uPlot.join(tables), series, relative ? "displacement / final one" : `displacement [m${unit}]`);
    const ranges = trials.map((trial) => this.range(trial, false));
    this.plot.setScale("x", { min: Math.min(...ranges.map(([from]) => from)), max: Math.max(...ranges.map(([, to]) => to)) });
    this.again = () => this.compare(trials, labels, unit);
  }

  /** Draw `shown`: trial, delay [samples or null], band [relative], unit ("m" or "rad"). */
  show(shown) {
    this.clear();
    this.shown = shown;
    this.again = () => this.show(shown);
    const { trial, delay, band, unit } = shown;
    const log = decode(trial.x, trial.q);
    const model = trial.g ? decode(trial.g, trial.gq) : null;
    const largest = Math.max(...log.map(Math.abs));
    const factor = largest < 0.3 ? 1000 : 1;
    const scaled = (values) => values.map((value) => value * factor);
    const final = trial.f === undefined ? null : trial.f * factor;
    const data = [samplesFromEdge(trial), scaled(log)];
    const series = [{ label: "log", stroke: colour("--fig-blue"), width: 1.6 }];
    if (model) {
      data.push(scaled(model));
      series.push({ label: "model", stroke: colour("--ink"), width: 1.4, dash: [6, 4] });
    }
    const ground = (plot) => this.ground(plot, delay, final, band);
    this.draw(data, series, `displacement [${factor === 1 ? "" : "m"}${unit}]`, { drawClear: [ground] });
    this.zoom(false);
    return { largest: Math.max(...data[1]), last: data[1][data[1].length - 1], unit: `${factor === 1 ? "" : "m"}${unit}`, final };
  }

  /** Band about the final position, and the samples before the command can act. */
  ground(plot, delay, final, band) {
    const { ctx: pen, bbox } = plot;
    pen.save();
    pen.beginPath();
    pen.rect(bbox.left, bbox.top, bbox.width, bbox.height);
    pen.clip();
    if (delay) {
      const [from, to] = [0, delay].map((sample) => plot.valToPos(sample, "x", true));
      pen.fillStyle = colour("--trimmed");
      pen.fillRect(from, bbox.top, to - from, bbox.height);
    }
    if (final !== null) {
      const [upper, middle, lower] = [1 + band, 1, 1 - band].map((part) => plot.valToPos(part * final, "y", true));
      pen.fillStyle = colour("--band");
      pen.fillRect(bbox.left, Math.min(upper, lower), bbox.width, Math.max(Math.abs(lower - upper), 1));
      pen.strokeStyle = colour("--fig-green");
      pen.lineWidth = devicePixelRatio || 1;
      pen.beginPath();
      pen.moveTo(bbox.left, middle);
      pen.lineTo(bbox.left + bbox.width, middle);
      pen.stroke();
    }
    pen.restore();
  }
}
