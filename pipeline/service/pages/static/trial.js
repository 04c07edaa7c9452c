"use strict";
/* Panels of a drawing as plots: drag to zoom, double click for all, arrow keys move the cursor; all panels together. */
const LOOKS = [["--fig-blue", []], ["--ink", [6, 4]], ["--fig-vermillion", []], ["--fig-green", [2, 3]], ["--soft", [1, 3]]];
const colour = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
const value = (_, found) => (found === null || found === undefined ? "–" : String(Number(found.toPrecision(5))));
let plots = [];
const drawPlots = () => {
  const held = document.getElementById("plot-data"), figure = document.querySelector("figure.plots");
  plots.forEach((plot) => plot.destroy());
  plots = [];
  if (!held || !figure || typeof uPlot === "undefined") return;
  for (const [at, panel] of JSON.parse(held.textContent).entries()) {
    const { names, series, x } = panel.axes[0], svg = figure.querySelectorAll("svg")[at];
    let holder = svg.nextElementSibling;
    if (!holder || !holder.classList.contains("plot")) {
      holder = document.createElement("div");
      holder.className = "plot";
      svg.after(holder);
    }
    const axis = { stroke: colour("--ink"), grid: { stroke: colour("--line"), width: 1 } };
    const lines = series.map(([label], n) => ({ label: label || panel.name, stroke: colour(LOOKS[n % LOOKS.length][0]), dash: LOOKS[n % LOOKS.length][1], width: 1.5, spanGaps: true, points: { show: false }, value }));
    const plot = new uPlot({
      width: holder.clientWidth || 320, height: 260, title: panel.name,
      scales: { x: { time: false, min: x[0], max: x[1] } },
      cursor: { sync: { key: "trial", scales: ["x", null] }, drag: { x: true, y: false } },
      axes: [{ ...axis, label: names[0], size: 34, labelSize: 20 }, { ...axis, label: names[1], size: 56, labelSize: 20 }],
      series: [{ label: names[0].replace(/ \[.*/, ""), value }, ...lines],
    }, uPlot.join(series.map(([, abscissa, ordinate]) => [abscissa, ordinate])), holder);
    holder.tabIndex = 0;
    holder.setAttribute("role", "application");
    holder.setAttribute("aria-label", `${panel.name}: arrow keys move the cursor, plus and minus zoom, 0 shows all`);
    holder.onkeydown = (event) => act(event, plot);
    plots.push(plot);
  }
  figure.classList.add("drawn");
};
/** Move the cursor by a sample (with shift by ten), or zoom about it. */
const act = (event, plot) => {
  const all = plot.data[0], last = all.length - 1, at = plot.cursor.idx ?? 0;
  const step = { ArrowLeft: -1, ArrowRight: 1 }[event.key], zoom = { "+": 0.5, "-": 2 }[event.key];
  if (step) {
    const next = Math.min(Math.max(at + step * (event.shiftKey ? 10 : 1), 0), last);
    plot.setCursor({ left: plot.valToPos(all[next], "x"), top: 10 }, true, true);
  } else if (zoom || event.key === "0") {
    const { min, max } = plot.scales.x, half = zoom ? (zoom * (max - min)) / 2 : 0;
    const range = zoom ? { min: Math.max(all[at] - half, all[0]), max: Math.min(all[at] + half, all[last]) } : { min: all[0], max: all[last] };
    plots.forEach((each) => each.setScale("x", range));
  } else return;
  event.preventDefault();
};
addEventListener("resize", () => plots.forEach((plot) => plot.setSize({ width: plot.root.parentElement.clientWidth, height: 260 })));
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", drawPlots);
document.addEventListener("page-renewed", drawPlots);
drawPlots();
