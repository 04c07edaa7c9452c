"use strict";
// Figures tell their values on pointing, and are saved as SVG and CSV. What they show is in the page, packed.

const REACH = 16; // largest distance of the pointer from a point that it means [units of the drawing]

/** Base64 of deflated JSON, as `report.pack` made it. */
function unpack(packed) {
  const bytes = Uint8Array.from(atob(packed), (character) => character.charCodeAt(0));
  return new Response(new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"))).json();
}

let figureNumbers = null;

/** What the panels of all figures show, by the id of the figure; unpacked when it is first asked for. */
function numbersOfFigures() {
  const held = document.getElementById("figure-data");
  figureNumbers ??= held ? unpack(JSON.parse(held.textContent).figures) : Promise.resolve({});
  return figureNumbers;
}

/** Offer a text as a file. */
function save(text, name, type) {
  const link = document.createElement("a");
  link.href = URL.createObjectURL(new Blob([text], { type }));
  link.download = name;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 10_000);
}

/** A drawing as a file of its own, in colours of print: what `drawing.standalone` writes. */
function standalone(svg) {
  const { width, height } = svg.viewBox.baseVal;
  const copy = svg.cloneNode(true);
  copy.setAttribute("width", width);
  copy.setAttribute("height", height);
  return new XMLSerializer().serializeToString(copy).replace(/var\(--[\w-]+,\s*([^()]*)\)/g, "$1").replaceAll("currentColor", "#000000");
}

const cell = (value) => (/[",\n]/.test(value ?? "") ? `"${String(value).replaceAll('"', '""')}"` : String(value ?? ""));

/** Trials of the experiment that a panel of costs names, from the data of the explorer; none where it is not there. */
async function trialsOf(figure, panel) {
  const content = window.reportTrials;
  if (!figure.dataset.criterion || !content) return [];
  const named = content.experiments.filter(({ name }) => panel.name === `experiment ${name}` || panel.name.startsWith(`experiment ${name},`));
  const criterion = content.criteria.findIndex(({ label }) => label === figure.dataset.criterion || label.startsWith(`${figure.dataset.criterion} [`));
  if (!named.length || criterion < 0) return [];
  const { k, b, c } = await unpack(named[named.length - 1].columns);
  return k.map((_, row) => [k[row], b[row], c[criterion][row]]).filter(([, , cost]) => cost !== null);
}

/** All that a figure shows as CSV, and with it the trials behind a map. */
async function csvOf(figure) {
  const rows = [["panel", "abscissa", "ordinate", "series", "x", "y", "value"]];
  for (const panel of (await numbersOfFigures())[figure.id] ?? []) {
    for (const { names, series } of panel.axes) {
      for (const [label, x, y, value] of series) x.forEach((_, n) => rows.push([panel.name, names[0], names[1], label, x[n], y[n], value?.[n]]));
    }
    for (const [k, b, cost] of await trialsOf(figure, panel)) {
      rows.push([panel.name, panel.axes[0].names[0], panel.axes[0].names[1], `trial: ${figure.dataset.criterion}`, k, b, cost]);
    }
  }
  return `${rows.map((row) => row.map(cell).join(",")).join("\n")}\n`;
}

const plainly = (value) => String(Number(value.toPrecision(4))).replace("-", "−");

/** A value with the symbol and the unit that the name of its axis has: "damping B [unit]" and 40 give "B = 40 unit". */
function quantity(name, value) {
  const found = /^(.*?)(?: \[(.*)\])?$/.exec(name);
  const symbol = / ([A-Zd])$/.exec(found[1])?.[1] ?? found[1];
  return `${symbol} = ${plainly(value)}${found[2] ? ` ${found[2]}` : ""}`;
}

/** The point of a panel that is nearest to a place in units of the drawing, in words; the place itself where none is. */
function pointed(panel, px, py) {
  const axes = panel.axes.find(({ box }) => px >= box[0] && px <= box[2] && py >= box[1] && py <= box[3]);
  if (!axes) return null;
  const { box, x, y, names } = axes;
  const [wide, high] = [(box[2] - box[0]) / (x[1] - x[0]), (box[3] - box[1]) / (y[1] - y[0])];
  let [best, least] = [null, REACH ** 2];
  for (const [label, xs, ys, values] of axes.series) {
    xs.forEach((value, n) => {
      const distance = (box[0] + (value - x[0]) * wide - px) ** 2 + (box[3] - (ys[n] - y[0]) * high - py) ** 2;
      // a limit is that of a trial: what lies on one place is named together
      if (best && distance === least && !best[0].split(", ").includes(label)) best[0] += `, ${label}`;
      if (distance < least) [best, least] = [[label, value, ys[n], values?.[n]], distance];
    });
  }
  const [label, atX, atY, value] = best ?? ["", x[0] + (px - box[0]) / wide, y[0] + (box[3] - py) / high];
  const third = value === undefined || value === null ? "" : `, ${quantity(names[2], value)}`;
  return `${label ? `${label}: ` : ""}${quantity(names[0], atX)}, ${quantity(names[1], atY)}${third}`;
}

const tip = document.createElement("div");
tip.className = "tip";
tip.hidden = true;
tip.setAttribute("aria-hidden", "true"); // tables and CSV say the same to those who do not point

/** Tell the value under the pointer. */
async function tellValue(event) {
  const svg = event.currentTarget;
  const panels = (await numbersOfFigures())[svg.closest("figure").id] ?? [];
  const panel = panels[[...svg.parentNode.querySelectorAll("svg")].indexOf(svg)];
  const box = svg.getBoundingClientRect();
  const factor = svg.viewBox.baseVal.width / box.width;
  const text = panel && pointed(panel, (event.clientX - box.left) * factor, (event.clientY - box.top) * factor);
  tip.hidden = !text;
  if (!text) return;
  tip.textContent = text;
  const left = Math.min(event.clientX + 14, document.documentElement.clientWidth - tip.offsetWidth - 8);
  [tip.style.left, tip.style.top] = [`${Math.max(left, 4)}px`, `${Math.max(event.clientY - tip.offsetHeight - 10, 4)}px`];
}

function addTools(figure) {
  const name = (n) => `${figure.id}${n === undefined ? "" : `-${n}`}`;
  const tools = figure.querySelector(".tools"); // on the page from the start, so that nothing moves
  const add = (text, label, act) => {
    const button = document.createElement("button");
    button.type = "button";
    button.textContent = text;
    button.setAttribute("aria-label", label);
    button.addEventListener("click", act);
    tools.append(button);
  };
  const title = figure.querySelector("figcaption strong").textContent;
  add("CSV", `values of ${title} as CSV`, async () => save(await csvOf(figure), `${name()}.csv`, "text/csv"));
  add("SVG", `drawing of ${title} as SVG`, () => {
    figure.querySelectorAll("svg").forEach((svg, n) => save(standalone(svg), `${name(n)}.svg`, "image/svg+xml"));
  });
  for (const svg of figure.querySelectorAll("svg")) {
    svg.addEventListener("pointermove", tellValue);
    svg.addEventListener("pointerleave", () => { tip.hidden = true; });
  }
}

if ("DecompressionStream" in window && document.getElementById("figure-data")) {
  document.body.append(tip);
  document.querySelectorAll("main figure[id]:has(.tools)").forEach(addTools);
}
