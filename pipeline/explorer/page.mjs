// @ts-check
/** The panel of the explorer: sliders, plane, response, poles, limits. What it shows is computed in loop.mjs. */

import { boundary, flattened, leftOut, margins, passive, poles, prepare, response, walls } from "./loop.mjs";

/**
 * @typedef {{label: string, loop: any, trials?: number[][], limits?: number[][], friction?: number[][], passive_reason?: string,
 *   wall?: {stiffness: number, damping: number} | null}} Entry a loop with what was measured on it: trials as
 *   [stiffness, damping, 1 if stable], limits as [damping, stiffness], limits with friction as [damping, stiffness,
 *   stiffness without friction or null], and why its logs prove no wall to be passive
 * @typedef {{stiffness: number, damping: number}} Wall
 */

/** Name, label, unit of translation, unit of rotation, factor to SI, smallest, largest, log or linear, step. */
const NUMBERS = /** @type {[string, string, string, string, number, number, number, string][]} */ ([
  ["mass", "mass m", "kg", "kg m²", 1, 0.01, 20, "log"],
  ["damping", "damping b", "Ns/m", "Nms/rad", 1, 0.01, 200, "zero"],
  ["stiffness", "stiffness k", "N/m", "Nm/rad", 1, 1, 10000, "zero"],
  ["sampling_period_s", "sampling period T", "ms", "ms", 1e-3, 0.05, 10, "log"],
  ["delay_samples", "delay d", "samples", "samples", 1, 0, 20, "linear"],
  ["force_gain", "force gain g", "", "", 1, 0.1, 10, "log"],
  ["actuator_lag_s", "actuator lag", "ms", "ms", 1e-3, 0.01, 50, "zero"],
  ["velocity.samples", "window of the difference", "samples", "samples", 1, 1, 40, "whole"],
  ["velocity.order", "order of the filter", "", "", 1, 1, 4, "whole"],
  ["velocity.acceleration", "acceleration of the filter", "m/s²", "rad/s²", 1, 0.01, 10000, "log"],
  ["velocity.noise", "noise of the filter", "m", "rad", 1, 1e-8, 0.01, "log"],
  ["velocity.cutoff_hz", "cut-off of the filter", "Hz", "Hz", 1, 1, 1000, "log"],
  ["mode.frequency_hz", "mode: frequency", "Hz", "Hz", 1, 1, 500, "log"],
  ["mode.damping_ratio", "mode: damping ratio", "", "", 1, 0.0001, 1, "zero"],
  ["mode.mass", "mode: load mass", "kg", "kg m²", 1, 0.001, 10, "log"],
  ["mode.load_damping", "mode: load damping", "Ns/m", "Nms/rad", 1, 0.01, 100, "zero"],
  ["operator.mass", "operator: mass", "kg", "kg m²", 1, 0.001, 10, "log"],
  ["operator.damping", "operator: damping", "Ns/m", "Nms/rad", 1, 0.01, 200, "zero"],
  ["operator.stiffness", "operator: stiffness", "N/m", "Nm/rad", 1, 1, 10000, "zero"],
]);
/** What a part has that is switched on here. */
const PARTS = /** @type {Record<string, any>} */ ({
  velocity: { difference: { kind: "difference", samples: 4 }, butterworth: { kind: "butterworth", order: 2, cutoff_hz: 50 },
    kalman: { kind: "kalman", acceleration: 10, noise: 1e-5 } },
  mode: { motor: { frequency_hz: 30, damping_ratio: 0.03, sensor: "motor" }, load: { frequency_hz: 30, damping_ratio: 0.03, sensor: "load" } },
  operator: { hand: { damping: 5, stiffness: 300 } },
});
const CHOICES = [["velocity", "velocity filter", "none"], ["mode", "vibration mode, sensed at", "no mode"], ["operator", "operator", "none"]];
/** Criteria with an optimum, and how they are named. */
const CRITERIA = [["settle_2pct", "shortest settling (2 %)"], ["energy_step_w0", "least energy"], ["energy_step_w1", "least energy, weight t"],
  ["energy_step_w2", "least energy, weight t²"]];
/** Namespace of drawings; its address would look like a request in a page that makes none. */
const SVG = /** @type {string} */ (new DOMParser().parseFromString("<svg></svg>", "text/html").body.firstElementChild?.namespaceURI);
const STYLE = `text{font:12px system-ui,sans-serif;fill:#1b1d21}.axis{stroke:#595d66;fill:none}.grid{stroke:#e6e4de;fill:none}.region{fill:#0072b2;
  fill-opacity:.12}.edge{stroke:#0072b2;fill:none;stroke-width:2}.ghost{stroke:#595d66;fill:none;stroke-dasharray:5 4}.passive{fill:#008a63;fill-opacity:.25;
  stroke:#008a63}.linear{stroke:#a8558a;fill:none;stroke-dasharray:2 3}.friction{stroke:#b87503;fill:none}.good{stroke:#008a63;fill:none}.bad{stroke:#c75100;
  fill:none}.limit{fill:#1b1d21}.wall{stroke:#1b1d21;fill:#fff;stroke-width:2}.best{fill:#b87503}`;

/** @param {string} tag @param {any} [attributes] @param {(Node | string)[]} children @returns {any} an element of the page */
function make(tag, attributes = {}, ...children) {
  const element = /** @type {any} */ (/^(svg|g|path|circle|rect|text|title|clipPath)$/.test(tag) ? document.createElementNS(SVG, tag) : document.createElement(tag));
  for (const [name, value] of Object.entries(attributes)) {
    if (name.startsWith("on")) element.addEventListener(name.slice(2), value);
    else if (name === "style") element.style.cssText = value;  // a policy may forbid the attribute
    else if (value !== null && value !== false) element.setAttribute(name, value === true ? "" : String(value));
  }
  element.append(...children);
  return element;
}

/** Formats by number of digits: to make one takes longer than to use it a hundred times. */
const FORMATS = [1, 1, 2, 3, 4, 5, 6].map((digits) => new Intl.NumberFormat("en", { maximumSignificantDigits: digits, useGrouping: false }));

/** @param {number | null | undefined} value @param {number} [digits] @returns {string} a number as people write it */
function text(value, digits = 4) {
  if (value === null || value === undefined || !Number.isFinite(value)) return "–";
  const rounded = Number(value.toPrecision(digits));
  return Math.abs(rounded) >= 1e5 || (rounded && Math.abs(rounded) < 1e-3) ? rounded.toExponential() : FORMATS[digits].format(rounded);
}

const below = (value, unit = 10 ** (Math.floor(Math.log10(value)) - 2)) => Math.floor(value / unit) * unit;  // a tip is sharp
/** @param {any} loop @param {string} path @returns {number | undefined} */
const get = (loop, path) => path.split(".").reduce((owner, key) => owner?.[key], loop);

/** @param {any} loop @param {string} path @param {any} value @returns {any} a loop with another entry */
function changed(loop, path, value) {
  const [part, key] = path.split(".");
  if (path === "delay_samples") return { ...loop, delay_samples: value, jitter_samples: undefined };  // another delay is a constant one
  return key ? { ...loop, [part]: { ...loop[part], [key]: value } } : { ...loop, [part]: value };
}

/** @param {number} low @param {number} high @param {number} count @returns {number[]} round numbers between two */
function ticks(low, high, count) {
  const rough = (high - low) / count, power = 10 ** Math.floor(Math.log10(rough)), step = power * ([1, 2, 5].find((k) => k * power >= rough) ?? 10);
  return Array.from({ length: Math.floor(high / step) - Math.ceil(low / step) + 1 }, (_, i) => (Math.ceil(low / step) + i) * step);
}

/** @param {any} border @returns {number} area of a stable region without islands */
const area = ({ stiffness: K, damping: B }) => K.reduce((sum, value, i) =>
  i && Number.isFinite(value + K[i - 1]) ? sum + (value + K[i - 1]) / 2 * (B[i] - B[i - 1]) : sum, 0);

/** @param {any} value @param {(key: string) => string} key how a key is written @returns {string} a value as TOML and Python write it */
const written = (value, key) => Array.isArray(value) ? `[${value.map((item) => written(item, key)).join(", ")}]`
  : value === null || typeof value !== "object" ? JSON.stringify(value)
    : `{${Object.entries(value).filter(([, item]) => item !== undefined).map(([name, item]) => key(name) + written(item, key)).join(", ")}}`;
/** @param {any} loop @param {string[]} keys @param {string} equals @param {(key: string) => string} key @returns {string[]} entries that a loop has */
const entriesOf = (loop, keys, equals, key) =>
  keys.filter((name) => loop[name] !== undefined && loop[name] !== null).map((name) => name + equals + written(loop[name], key));

/** @param {any} loop @param {string} name @returns {string} a device file */
export function toml(loop, name) {
  const of = (/** @type {string[]} */ keys) => entriesOf(loop, keys, " = ", (key) => `${key} = `);
  const parts = of(["velocity", "actuator_lag_s", "force_gain", "mode", "operator", "friction"]);
  return [`name = ${JSON.stringify(name)}`, ...of(["motion", "sampling_period_s", "mass", "damping", "stiffness", "delay_samples", "jitter_samples"]),
    ...(parts.length ? ["", "[loop]", ...parts] : []), ""].join("\n");
}

/** @param {any} loop @param {Wall} wall @returns {string} the line of Python that gives the same numbers */
export function python(loop, wall) {
  const keys = ["mass", "damping", "sampling_period_s", "delay_samples", "stiffness", "motion", "velocity", "actuator_lag_s", "force_gain", "mode", "operator"];
  return `pipeline.Loop(${entriesOf(loop, keys, "=", (key) => `"${key}": `).join(", ")}).points(${wall.stiffness}, ${wall.damping})`;
}

/** What verdicts and energies mean. */
const MEANING = "A passive wall is stable with every passive hand, other stable walls only with some. Energies are time integrals relative to the initial energy.";

explore.panels = 0;

/** Marks of the legend, as the plane draws them; others are lines. @type {Record<string, string>} */
const MARKS = { passive: "M6 2H18V10H6Z", good: "M10 4h4v4h-4z", bad: "M10 4l4 4m0-4l-4 4", limit: "M9 6a3 3 0 1 0 6 0a3 3 0 1 0-6 0",
  best: "M12 0l2 4 4 0-3 3 1 4-4-2-4 2 1-4-3-3 4 0z", wall: "M8 6a4 4 0 1 0 8 0a4 4 0 1 0-8 0" };

/**
 * Show a panel in an element: the first entry, with those parts of the state that the address has.
 * @param {HTMLElement} root @param {Entry[]} entries
 */
export function explore(root, entries) {
  const keep = "#explore=";
  let entry = entries[0], loop = flattened(entry.loop), ghost = /** @type {any} */ (null), result = /** @type {any} */ (null);
  let wall = /** @type {Wall | null} */ (null), criterion = "", best = /** @type {Wall | null} */ (null), swept = "delay_samples";
  /** @type {Wall[]} */ let pins = []; /** @type {{x: number[], y: number[]} | null} */ let view = null;
  let asked = false, touched = false, later = /** @type {any} */ (0), said = /** @type {any} */ (0);
  const small = root.clientWidth < 560, width = small ? 390 : 620, height = small ? 340 : 430, left = 62, bottom = 42, clip = `explorer-clip-${explore.panels++}`;
  const unit = (row) => loop.motion === "rotation" ? row[3] : row[2];
  const of = () => loop.motion === "rotation" ? { K: "Nm/rad", B: "Nms/rad" } : { K: "N/m", B: "Ns/m" };

  // ------------------------------------------------------------------------------------------------------- controls
  const controls = make("div", { class: "controls" }), message = make("p", { class: "message", role: "alert" }), live = make("p", { class: "live", "aria-live": "polite" });
  const rows = NUMBERS.map((row) => {
    const [path, label, , , , low, high, scale] = row, id = `explore-${path}`;
    const slider = make("input", { type: "range", id, min: 0, max: 1000, step: 1, oninput: () => set(path, fromSlider(Number(slider.value))) });
    const field = make("input", { type: "number", step: "any", "aria-label": label, onchange: () => set(path, field.value === "" ? NaN : Number(field.value) * row[4]) });
    const name = make("label", { for: id }), units = make("span", { class: "unit" }), element = make("div", { class: "number" }, name, slider, field, units);
    const span = () => path === "velocity.cutoff_hz" ? Math.min(high, 0.499 / (loop.sampling_period_s ?? 1)) : path === "mode.mass" ? 0.98 * (loop.mass ?? 1)
      : path === "mode.load_damping" ? Math.max(loop.damping ?? 0, 2 * low) : high;
    /** @type {(place: number) => number} */
    const fromSlider = (place) => {
      const share = place / 1000;
      if (scale === "linear") return Math.round((low + share * (span() - low)) * 50) / 50 * row[4];
      if (scale === "whole") return Math.round(low + share * (span() - low));
      return scale === "zero" && !place ? 0 : Math.min(span(), Number((low * (span() / low) ** share).toPrecision(3))) * row[4];
    };
    const show = () => {
      const value = get(loop, path);
      element.hidden = path.includes(".") && value === undefined;
      if (element.hidden) return;
      const shown = (value ?? (path === "force_gain" ? 1 : 0)) / row[4], most = span();
      const share = scale === "linear" || scale === "whole" ? (shown - low) / (most - low) : shown > 0 ? Math.log(shown / low) / Math.log(most / low) : 0;
      slider.value = String(Math.round(1000 * Math.min(1, Math.max(scale === "zero" && shown > 0 ? 0.001 : 0, share))));
      if (document.activeElement !== field) field.value = String(Number(shown.toPrecision(6)));
      const words = `${text(shown)} ${unit(row)}`.trim();
      if (slider.getAttribute("aria-valuetext") === words) return;
      name.textContent = label, units.textContent = unit(row), slider.setAttribute("aria-valuetext", words), field.setAttribute("aria-label", `${label} ${unit(row)}`.trim());
    };
    controls.append(element);
    return { path, row, element, show, span };
  });
  const choices = CHOICES.map(([part, label, none]) => {
    const select = make("select", { id: `explore-${part}`, onchange: () => {
      const given = flattened(entry.loop)[/** @type {"mode"} */ (part)], filled = { ...PARTS[part][select.value] };
      if (part !== "velocity" && filled && !filled.mass) filled.mass = Number((0.2 * (loop.mass ?? 1)).toPrecision(3));
      const next = select.value === "" ? undefined : select.value === "file" ? given : part === "mode" && loop.mode ? { ...loop.mode, sensor: select.value } : filled;
      loop = changed(loop, part, next), renew();
    } });
    const show = () => {
      const value = /** @type {any} */ (loop)[part], kind = value && (value.kind ?? value.sensor ?? (part === "mode" ? "motor" : "hand"));
      const known = value && (PARTS[part][kind] ? kind : "file");
      if (select.options.length && select.value === (known || "")) return;
      select.replaceChildren(make("option", { value: "" }, none), ...Object.keys(PARTS[part]).map((key) => make("option", { value: key }, key)),
        ...(known === "file" ? [make("option", { value: "file" }, value.kind)] : []));
      select.value = known || "";
    };
    const first = rows.find(({ path }) => path.startsWith(part))?.element;
    controls.insertBefore(make("div", { class: "choice" }, make("label", { for: `explore-${part}` }, label), select), first);
    return { show };
  });
  const device = make("select", { id: "explore-device", onchange: () => begin(Number(device.value)) }, ...entries.map((e, i) => make("option", { value: i }, e.label)));
  const buttons = make("p", { class: "buttons" },
    make("button", { type: "button", onclick: () => begin(entries.indexOf(entry)) }, "Reset to device"),
    ...[["SVG", () => save("plane.svg", picture(), "image/svg+xml")], ["CSV", () => save("boundary.csv", table(), "text/csv")],
      ["TOML", () => save("device.toml", toml(loop, "explored"), "application/toml")]].map(([name, act]) => make("button", { type: "button", onclick: act }, `Save ${name}`)));

  // ------------------------------------------------------------------------------------------------- plane and panels
  const layers = Object.fromEntries(["grid", "region", "passive", "linear", "ghost", "edge", "friction", "good", "bad", "limit", "best", "wall", "axis"]
    .map((name) => [name, make("g")]));
  const plane = make("svg", { viewBox: `0 0 ${width} ${height}`, tabindex: 0, role: "application", "aria-label":
    "Plane of walls, with stiffness to the right and damping upwards. Arrow keys move the wall. Shift and arrow keys move the view. Plus and minus zoom. P pins the wall." },
  make("title", {}, "Stability of walls"),
  make("clipPath", { id: clip }, make("rect", { x: left, y: 12, width: width - left - 12, height: height - bottom - 12 })), ...Object.values(layers));
  for (const [name, layer] of Object.entries(layers)) if (!/axis|wall/.test(name)) layer.setAttribute("clip-path", `url(#${clip})`);
  const fields = [["stiffness", "K"], ["damping", "B"]].map(([name, symbol]) => {
    const field = make("input", { type: "number", step: "any", id: `explore-wall-${name}`, onchange: () => {
      const value = Number(field.value);
      if (field.value !== "" && wall) wall = { ...wall, [name]: name === "stiffness" ? Math.max(0, value) : value }, move();
    } });
    const label = make("label", { for: field.id });
    return { element: make("span", {}, label, field), show: () => {
      label.textContent = `wall ${name} ${symbol} [${of()[/** @type {"K"} */ (symbol)]}]`;
      if (wall && document.activeElement !== field) field.value = String(Number(wall[/** @type {"damping"} */ (name)].toPrecision(6)));
    } };
  });
  const step = make("svg", { viewBox: "0 0 420 230", role: "img", "aria-label": "Step response" });
  const circle = make("svg", { viewBox: "0 0 230 230", role: "img", "aria-label": "Poles in the z-plane" });
  const sweep = make("svg", { viewBox: "0 0 420 190", role: "img", "aria-label": "Largest stiffness over one parameter" });
  const summary = make("dl", { class: "what-summary" }), facts = make("table", { class: "what-walls" }), bars = make("div", { class: "bars" }), line = make("code");
  const pick = make("select", { id: "explore-criterion", onchange: () => { criterion = pick.value, best = null, renew(); } },
    make("option", { value: "" }, "none"), ...CRITERIA.map(([value, name]) => make("option", { value }, name)));
  const over = make("select", { id: "explore-sweep", onchange: () => { swept = over.value, renew(); } });
  const pin = make("button", { type: "button", onclick: () => { if (wall) pins = [...pins, wall].slice(-2), renew(); } }, "Pin this wall");
  const zoom = (factor, x = 0.5, y = 0.5) => {
    const [w, h] = axes(), at = (/** @type {number[]} */ [a, b], /** @type {number} */ share) => { const c = a + share * (b - a); return [c + (a - c) * factor, c + (b - c) * factor]; };
    view = { x: at(w, x), y: at(h, y) }, draw(), store();
  };
  const tools = make("p", { class: "buttons" }, pin, make("button", { type: "button", onclick: () => { pins = [], renew(); } }, "Remove pins"),
    make("button", { type: "button", "aria-label": "Zoom in", onclick: () => zoom(0.7) }, "+"),
    make("button", { type: "button", "aria-label": "Zoom out", onclick: () => zoom(1.4) }, "−"),
    make("button", { type: "button", onclick: () => { view = null, draw(), store(); } }, "Fit"), make("label", { for: "explore-criterion" }, "Optimum: "), pick);
  const legend = make("ul", { class: "legend" });
  root.classList.add("what-if");
  root.replaceChildren(make("div", { class: "left" }, make("p", { class: "choice" }, make("label", { for: "explore-device" }, "device"), device), controls, buttons),
    make("div", { class: "middle" }, message, summary, plane, legend, tools, live),
    make("div", { class: "right" }, make("h3", {}, "Response to a step"), step, make("h3", {}, "This wall"),
      make("p", { class: "fields" }, ...fields.map(({ element }) => element)),
      make("div", { class: "scroll", tabindex: 0, role: "region", "aria-label": "Walls" }, facts), make("p", { class: "note" }, MEANING), circle),
    make("div", { class: "lower" }, make("div", {}, make("h3", {}, "What limits me"), bars),
      make("div", {}, make("h3", {}, make("label", { for: "explore-sweep" }, "Largest stiffness over "), over), sweep),
      make("p", { class: "line" }, "The same in Python: ", line)));

  const axes = () => view ? [view.x, view.y] : fit();
  function fit() {
    const K = [...(result?.border.stiffness ?? []), ...(ghost?.border.stiffness ?? []), ...(entry.limits ?? []).map((p) => p[1])].filter(Number.isFinite);
    const B = [...(result?.border.damping ?? []), ...(ghost?.border.damping ?? []), ...(entry.limits ?? []).map((p) => p[0])].filter(Number.isFinite);
    const least = Math.max(Math.min(0, ...B), -0.3 * Math.max(...B, 1e-9));
    return [[0, 1.08 * Math.max(...K, 1e-9)], [least, 1.08 * Math.max(...B, 1e-9)]];
  }
  const place = () => {
    const [[x0, x1], [y0, y1]] = axes();
    return { x: (K) => left + (K - x0) / (x1 - x0) * (width - left - 12),
      y: (B) => height - bottom - (B - y0) / (y1 - y0) * (height - bottom - 12) };
  };
  const path = (x, y, at = place()) => {
    let d = "", pen = "M";
    for (let i = 0; i < x.length; i++) {
      if (!Number.isFinite(x[i] + y[i])) { pen = "M"; continue; }
      d += pen + at.x(x[i]).toFixed(1) + " " + at.y(y[i]).toFixed(1), pen = "L";
    }
    return d;
  };

  // --------------------------------------------------------------------------------------------------------- drawing
  /** @param {string} name @param {string} d */
  const put = (name, d) => {
    const g = layers[name], old = g.firstChild;
    if (old) old.setAttribute("d", d); else g.append(make("path", { class: name, d }));
  };
  function draw() {
    if (!result) return;
    const at = place(), { border, calm, sampled } = result, [[x0, x1], [y0, y1]] = axes();
    const box = (b) => {  // the region of each part reaches down to K = 0
      let d = "", from = 0;
      for (let i = 0; i <= b.stiffness.length; i++) {
        if (i < b.stiffness.length && Number.isFinite(b.stiffness[i])) continue;
        const K = b.stiffness.slice(from, i), B = b.damping.slice(from, i);
        if (K.length) d += path([0, ...K, 0], [B[0], ...B, B[B.length - 1]], at) + "Z";
        from = i + 1;
      }
      return d;
    };
    let islands = "";
    border.islands.forEach((one, i, all) => {  // a band a level
      const near = [all[i - 1], all[i + 1]].filter(Boolean).map((other) => Math.abs(other.damping - one.damping)).filter((gap) => gap > 0);
      const half = near.length ? Math.min(...near) / 2 : 0;
      islands += path([one.stiffness_low, one.stiffness_high, one.stiffness_high, one.stiffness_low], [-half, -half, half, half].map((h) => one.damping + h), at) + "Z";
    });
    put("region", box(border) + islands), put("edge", path(border.stiffness, border.damping, at)), put("passive", path(calm.stiffness, calm.damping, at));
    put("ghost", ghost ? path(ghost.border.stiffness, ghost.border.damping, at) : "");
    const slope = (sampled.delay + sampled.lag + 0.5) * sampled.units.period, b = -sampled.delta * sampled.units.damping;
    put("linear", path([0, x1], [b, b + slope * x1], at));
    put("friction", path((entry.friction ?? []).map((p) => p[1]), (entry.friction ?? []).map((p) => p[0]), at));
    const marks = (stable) => (entry.trials ?? []).filter((t) => t[2] === stable)
      .map(([K, B]) => `M${(at.x(K) - 2).toFixed(1)} ${(at.y(B) - 2).toFixed(1)}` + (stable ? "h4v4h-4z" : "l4 4m0-4l-4 4")).join("");
    put("good", marks(1)), put("bad", marks(0));
    put("limit", (entry.limits ?? []).map(([B, K]) => `M${(at.x(K) - 3).toFixed(1)} ${at.y(B).toFixed(1)}a3 3 0 1 0 6 0a3 3 0 1 0-6 0`).join(""));
    const star = (w) => `M${at.x(w.stiffness)} ${at.y(w.damping) - 8}l3 5 6 1-4 4 1 6-6-3-6 3 1-6-4-4 6-1z`;
    put("best", [best, entry.wall].map((w) => w ? star(w) : "").join(""));
    layers.wall.replaceChildren(...[...pins, ...(wall ? [wall] : [])].flatMap((w, i) => {
      const x = at.x(w.stiffness), y = at.y(w.damping), name = i < pins.length ? "AB"[i] : "";
      return x > left && y < height - bottom ? [make("circle", { class: "wall", cx: x, cy: y, r: 6 }), make("text", { x: x + 9, y: y - 6 }, name)] : [];
    }));
    const frame = [], grid = [];
    for (const K of ticks(x0, x1, 6)) grid.push(`M${at.x(K).toFixed(1)} 12V${height - bottom}`),
      frame.push(make("text", { x: at.x(K), y: height - bottom + 16, "text-anchor": "middle" }, text(K)));
    for (const B of ticks(y0, y1, 6)) grid.push(`M${left} ${at.y(B).toFixed(1)}H${width - 12}`),
      frame.push(make("text", { x: left - 6, y: at.y(B) + 4, "text-anchor": "end" }, text(B)));
    put("grid", grid.join(""));
    layers.axis.replaceChildren(make("path", { class: "axis", d: `M${left} 12V${height - bottom}H${width - 12}` }), ...frame,
      make("text", { x: width - 12, y: height - 6, "text-anchor": "end" }, `stiffness K [${of().K}]`), make("text", { x: left + 8, y: 24 }, `damping B [${of().B}]`));
    const shown = [["edge", "stable"], ...(calm.reason ? [] : [["passive", "passive (stable with every passive hand)"]]), ["linear", "linear condition (slow motion)"],
      ["wall", "this wall (drag it)"], ...(ghost?.same ? [] : [["ghost", "device as identified"]]), ...((entry.friction ?? []).length ? [["friction", "limit with friction"]] : []),
      ...((entry.trials ?? []).length ? [["good", "stable trial"], ["bad", "unstable trial"]] : []),
      ...((entry.limits ?? []).length ? [["limit", "measured limit"]] : []), ...(entry.wall || best ? [["best", entry.wall ? "recommended wall" : "optimum"]] : [])];
    if (legend.dataset.shown === String(shown)) return;
    legend.dataset.shown = String(shown), legend.replaceChildren(...shown.map(([name, words]) => make("li", {}, make("svg", { viewBox: "0 0 24 12", "aria-hidden": true },
        make("path", { class: name, d: MARKS[name] ?? "M2 6H22" })), words)));
  }

  /** Draw lines over one abscissa. @param {any} svg @param {any[]} series @param {string} xname @param {number[]} marks @param {boolean} log */
  function chart(svg, series, xname, marks = [], log = false) {
    const [, , w, h] = svg.getAttribute("viewBox").split(" ").map(Number), x = series.flatMap((s) => s.x), y = series.flatMap((s) => s.y).filter(Number.isFinite);
    const x0 = Math.min(...x), x1 = Math.max(...x), y0 = Math.min(0, ...y), y1 = Math.max(...y, y0 + 1e-9) * 1.05;
    const at = { x: (v) => 46 + (v - x0) / (x1 - x0) * (w - 56), y: (v) => h - 30 - (v - y0) / (y1 - y0) * (h - 40) };
    svg.replaceChildren(make("path", { class: "axis", d: `M46 10V${h - 30}H${w - 10}` }),
      ...ticks(x0, x1, 5).map((v) => make("text", { x: at.x(v), y: h - 15, "text-anchor": at.x(v) > w - 26 ? "end" : "middle" }, text(log ? 10 ** v : v, log ? 2 : 4))),
      ...ticks(y0, y1, 4).map((v) => make("text", { x: 42, y: at.y(v) + 4, "text-anchor": "end" }, text(v, 3))), make("text", { x: w - 10, y: h - 2, "text-anchor": "end" }, xname),
      ...marks.map((v) => make("path", { class: "grid", d: `M46 ${at.y(v)}H${w - 10}` })), ...series.map((s) => make("path", { class: s.name, d: path(s.x, s.y, at) })));
  }

  // ------------------------------------------------------------------------------------------------------ computation
  function compute() {
    asked = false;
    try {
      const sampled = prepare(loop);
      result = { sampled, border: boundary(sampled), calm: passive(sampled, 61, entry.passive_reason) }, message.textContent = "";
    } catch (error) {
      message.textContent = `${error instanceof Error ? error.message : error}`;
      return;
    }
    if (!ghost) ghost = { border: result.border, calm: result.calm };
    ghost.same = ghost.border === result.border || ghost.border.stiffness_max === result.border.stiffness_max;
    if (!wall) wall = entry.wall ?? { stiffness: Number((0.3 * result.border.stiffness_max).toPrecision(2)),
      damping: Number((0.6 * result.border.damping_at_stiffness_max).toPrecision(2)) };
    rows.forEach((row) => row.show()), choices.forEach((choice) => choice.show());
    draw(), showWalls(), showSummary(), store();
    clearTimeout(later), later = setTimeout(slow, 60);
  }
  const renew = () => { if (!asked) asked = true, requestAnimationFrame(compute); };
  const set = (name, value) => {
    if (!Number.isFinite(value)) return;
    const own = flattened(entry.loop);
    loop = changed(loop, name, value), renew();
    if (name === "delay_samples" && value === own.delay_samples) loop = { ...loop, jitter_samples: own.jitter_samples };
  };

  function showSummary() {
    const { border, calm } = result, against = (now, then) => ghost.same || !then ? ""
      : ` (${now >= then ? "+" : "−"}${text(Math.abs(100 * (now / then - 1)), 3)} % compared with the device)`;
    const out = leftOut(loop).map((name) => name === "jitter" ? `the jitter of the delay (replaced by its mean, ${text(loop.delay_samples)} samples)`
      : name === "velocity" ? "the adaptive velocity filter (ignored)" : name);
    summary.replaceChildren(...[["Largest stable stiffness",
      `${text(border.stiffness_max, 5)} ${of().K} at B = ${text(border.damping_at_stiffness_max)} ${of().B}${against(border.stiffness_max, ghost.border.stiffness_max)}`],
      ["Stable region", `${text(area(border))} ${of().K} · ${of().B}${against(area(border), area(ghost.border))}`],
      ["Stiffest passive wall", calm.stiffness_max
        ? `${text(below(calm.stiffness_max))} ${of().K} at B = ${text(calm.damping_at_stiffness_max)} ${of().B}` : calm.reason ?? "none, because the device has no damping"],
      ...(out.length ? [["Not included", `${out.join("; ")}, which linear theory cannot describe`]] : [])].flatMap(([name, words]) => [make("dt", {}, name), make("dd", {}, words)]));
    clearTimeout(said), said = setTimeout(() => {
      live.textContent = `Largest stable stiffness ${text(border.stiffness_max)} ${of().K}.`
        + (wall ? ` Wall of ${text(wall.stiffness)} ${of().K} and ${text(wall.damping)} ${of().B}: ${result.verdicts[0]}.` : "");
    }, 500);
  }

  function showWalls() {
    const { sampled, calm } = result, all = [.../** @type {Wall[]} */ (wall ? [wall] : []), ...pins], T = sampled.units.period * 1000;
    const found = walls(sampled, all.map((w) => w.stiffness), all.map((w) => w.damping), { longest: 4000 });
    line.textContent = wall ? python(loop, wall) : "";
    const safe = all.map((w, i) => found[i].stable ? margins(sampled, w.stiffness, w.damping) : null);
    const inside = (w) => {
      let odd = false;
      for (let i = 1; i < calm.stiffness.length; i++) {
        const [a, b, c, d] = [calm.stiffness[i - 1], calm.damping[i - 1], calm.stiffness[i], calm.damping[i]];
        if ((b > w.damping) !== (d > w.damping) && w.stiffness < a + (w.damping - b) / (d - b) * (c - a)) odd = !odd;
      }
      return odd;
    };
    fields.forEach((field) => field.show());
    result.verdicts = all.map((w, i) => !found[i].stable ? "unstable" : inside(w) ? "stable, passive" : calm.reason ? "stable" : "stable, not passive");
    /** @type {[string, (i: number) => string][]} */
    const lines = [["stiffness", (i) => `${text(all[i].stiffness)} ${of().K}`], ["damping", (i) => `${text(all[i].damping)} ${of().B}`],
      ["verdict", (i) => result.verdicts[i]], ["spectral radius", (i) => text(found[i].spectral_radius, 6)],
      ["settling (2 %)", (i) => found[i].settle_2pct === null ? "–" : `${text(found[i].settle_2pct * T)} ms`],
      ["overshoot", (i) => found[i].overshoot === null ? "–" : `${text(100 * found[i].overshoot, 3)} %`],
      ...["", ", weight t", ", weight t²"].map((by, p) => /** @type {[string, (i: number) => string]} */ ([`energy${by}`,
        (i) => { const value = /** @type {any} */ (found[i])[`energy_step_w${p}`]; return value ? `${text(value)} samples${["", "²", "³"][p]}` : "–"; }])),
      ["gain margin", (i) => text(safe[i]?.gain)], ["phase margin", (i) => safe[i]?.phase ? `${text(safe[i].phase * 180 / Math.PI, 3)}°` : "–"],
      ["delay margin", (i) => safe[i]?.delay ? `${text(safe[i].delay, 3)} samples` : "–"],
      ["bandwidth", (i) => safe[i]?.bandwidth_hz ? `${text(safe[i].bandwidth_hz, 3)} Hz` : "–"]];
    const heads = ["wall", ...all.map((_, i) => i ? "AB"[i - 1] : "this")].map((name) => make("th", { scope: "col" }, name)), parts = leftOut(loop);
    facts.replaceChildren(make("caption", {}, parts.length ? `Of the linear loop, without ${parts.join(" and ")}: logs may differ.` : ""), make("thead", {}, make("tr", {}, ...heads)),
      make("tbody", {}, ...lines.map(([name, value]) => make("tr", {}, make("th", { scope: "row" }, name), ...all.map((_, i) => make("td", {}, value(i)))))));
    const samples = Math.round(Math.min(300, Math.max(30, 1.3 * (found[0]?.settle_2pct ?? 100))));
    const runs = all.filter((w) => w.stiffness * 1 > -sampled.gamma * sampled.units.stiffness)
      .map((w) => response(sampled, w.stiffness, w.damping, samples, Math.max(1, Math.floor(300 / samples))));
    const bounded = (y) => y.map((v) => Math.abs(v) < 5 ? v : NaN);
    chart(step, runs.flatMap((run, i) => [
      ...(i ? [] : [{ name: "linear", x: run.command.flatMap((_, k) => [k * T, (k + 1) * T]).slice(0, -1), y: bounded(run.command.flatMap((u) => [u, u]).slice(0, -1)) }]),
      { name: ["edge", "good", "bad"][i], x: run.time.map((t) => 1000 * t), y: bounded(run.position) }]),
      "ms; position over its final, command (dotted) over its first value", [0.98, 1.02]);
    circle.replaceChildren(make("circle", { class: "axis", cx: 115, cy: 115, r: 100 }), make("path", { class: "grid", d: "M10 115H220M115 10V220" }),
      ...all.flatMap((w, i) => poles(sampled, w.stiffness, w.damping).map(([re, im]) =>
      make("path", { class: ["edge", "good", "bad"][i], d: `M${111 + 100 * re} ${111 - 100 * im}l8 8m0-8l-8 8` }))));
  }

  /** Do in slices what may be late: bars, sweep, optimum. */
  function slow() {
    const base = result.border.stiffness_max, mine = loop, found = /** @type {[string, number, number][]} */ ([]),
      curve = { x: /** @type {number[]} */ ([]), y: /** @type {number[]} */ ([]), areas: /** @type {number[]} */ ([]) };
    const present = NUMBERS.filter(([name]) => get(loop, name) && !/order|samples$/.test(name) || name === "delay_samples" && loop.delay_samples);
    over.replaceChildren(...NUMBERS.filter(([name]) => get(loop, name) !== undefined || !name.includes(".")).map(([value, name]) => make("option", { value }, name)));
    if (get(loop, swept) === undefined && swept.includes(".")) swept = "delay_samples";
    over.value = swept;
    const top = (other) => { try { const b = boundary(other, 40); return [b.stiffness_max, area(b)]; } catch { return [NaN, NaN]; } };
    const { row, span } = /** @type {any} */ (rows.find(({ path }) => path === swept)), high = span(), tasks = /** @type {(() => void)[]} */ (present.map(([name]) => () => {
      const value = /** @type {number} */ (get(loop, name)), [less, more] = [0.9, 1.1].map((factor) => top(changed(mine, name, value * factor))[0] / base - 1);
      if (Number.isFinite(less + more)) found.push([name, Math.round(less * 1e6) / 1e6, Math.round(more * 1e6) / 1e6]);
      if (found.length) showBars(found);
    }));
    for (let i = 0; i <= 40; i++) {
      tasks.push(() => {
        const [, , , , factor, low, , scale] = row, share = i / 40, whole = scale === "whole", here = Math.max(get(mine, swept) ?? 0, 2 * low * factor) / factor;
        const value = scale === "linear" ? low + share * (Math.min(high, 2 * here + 4) - low)
          : whole ? Math.round(low + share * (high - low)) : Math.max(low, here / 20) * (Math.min(high, here * 20) / Math.max(low, here / 20)) ** share;
        curve.x.push(scale === "linear" || whole ? value : Math.log10(value));
        const [K, wide] = top(changed(mine, swept, value * factor));
        curve.y.push(K > 5 * base ? NaN : K), curve.areas.push(wide);  // little of a range that is far above the loop's own
        if (i === 40) {
          const now = (get(mine, swept) ?? 0) / factor, x = scale === "linear" || whole ? now : Math.log10(Math.max(now, low));
          const most = Math.max(...curve.y.filter(Number.isFinite)), widest = Math.max(...curve.areas.filter((v, k) => v && curve.y[k]));
          chart(sweep, [{ name: "edge", x: curve.x, y: curve.y }, { name: "linear", x: curve.x, y: curve.areas.map((v, k) => curve.y[k] ? v / widest * most : NaN) },
            { name: "ghost", x: [x, x], y: [0, most] }],
            `${row[1]} [${unit(row) || "1"}]; dotted: area of the stable region`, [], scale !== "linear" && !whole);
        }
      });
    }
    if (criterion) tasks.push(...optimum());
    const run = () => {
      const until = performance.now() + 8;
      while (tasks.length && mine === loop && performance.now() < until) tasks.shift()?.();
      if (tasks.length && mine === loop) later = setTimeout(run, 0);
    };
    run();
  }
  /** @param {[string, number, number][]} found */
  function showBars(found) {
    const signed = (v) => `${v < 0 ? "−" : "+"}${text(Math.abs(100 * v), 2)} %`;
    const most = Math.max(...found.map(([, a, b]) => Math.max(Math.abs(a), Math.abs(b))), 1e-9);
    const best = found.map(([name, less, more]) => ({ name, way: less > more ? "less" : "more", gain: Math.max(less, more), loss: Math.min(less, more) }))
      .sort((a, b) => b.gain - b.loss - a.gain + a.loss);
    const limits = (entry.friction ?? []).filter((p) => p[2]), share = Math.max(...limits.map((p) => p[2])) / Math.max(...limits.map((p) => p[1])) - 1;
    /** @param {string} label @param {number} width @param {string} text @param {string | null} [kind] */
    const bar = (label, width, text, kind = null) => make("div", { class: "bar" }, make("span", {}, label),
      make("span", { class: "track" }, make("span", { class: kind, style: `width:${width}%` })), make("span", {}, text));
    bars.replaceChildren(make("p", {}, "Change of the largest stable stiffness for 10 % (in brackets: in the other direction):"),
      ...best.map(({ name, way, gain, loss }) =>
        bar(`10 % ${way} ${NUMBERS.find(([n]) => n === name)?.[1]}`, Math.max(0, 100 * gain / most), `${signed(gain)} (${signed(loss)})`)),
      ...(limits.length ? [bar("the device without its friction", Math.min(100, 100 * Math.abs(share) / most), signed(share), "loss")] : []));
  }
  /** @returns {(() => void)[]} slices of a search for the best wall by the chosen criterion, closer and closer */
  function optimum() {
    const { border, sampled } = result, n = 14;
    let centre = [0.5, 0.5], half = 0.49, least = Infinity, at = /** @type {Wall | null} */ (null), next = centre;
    const top = (B) => {
      const b = border.damping, i = Math.max(1, b.findIndex((v) => v >= B));
      return border.stiffness[i - 1] + (B - b[i - 1]) / (b[i] - b[i - 1]) * (border.stiffness[i] - border.stiffness[i - 1]); };
    const low = Math.min(...border.damping.filter(Number.isFinite)), high = Math.max(...border.damping.filter(Number.isFinite));
    return Array.from({ length: 6 * n }, (_, task) => () => {
      if (task % n === 0) centre = next, half *= task ? 0.35 : 1;
      const p = centre[0] + half * (2 * (task % n) / (n - 1) - 1), B = low + p * (high - low), K = top(B);
      for (let j = 0; j < n; j++) {
        const q = centre[1] + half * (2 * j / (n - 1) - 1), stiffness = q * K;
        if (!(p > 0 && p < 1 && q > 0 && q < 1 && K > 0)) continue;
        const cost = /** @type {any} */ (walls(sampled, [stiffness], [B], { longest: 1500, energies: criterion !== "settle_2pct" })[0])[criterion] ?? Infinity;
        if (cost < least) least = cost, at = { stiffness, damping: B }, next = [p, q];
      }
      if (task === 6 * n - 1) best = at, draw();
    });
  }

  // ------------------------------------------------------------------------------------------- state, exports, input
  for (const kind of ["input", "change", "click", "pointerdown", "keydown", "wheel"]) root.addEventListener(kind, () => { touched = true; }, true);
  function store() {
    if (!touched) return;  // the address of a report may name a section
    const state = { e: entries.indexOf(entry), loop, wall, pins, view, criterion, swept };
    clearTimeout(store.timer),
      store.timer = setTimeout(() => {
        try { history.replaceState(null, "", keep + encodeURIComponent(JSON.stringify(state))); } catch { /* an address that may not change */ }
      }, 300);
  }
  store.timer = /** @type {any} */ (0);
  /** @param {number} index @param {any} [state] */
  function begin(index, state) {
    entry = entries[index] ?? entries[0], loop = flattened(entry.loop), ghost = null, wall = null, pins = [], view = null, best = null;
    device.value = String(entries.indexOf(entry));
    try {
      const sampled = prepare(loop);
      ghost = { border: boundary(sampled), calm: passive(sampled, 61, entry.passive_reason) };
    } catch { /* said below */ }
    if (state) ({ loop = loop, wall = null, pins = [], view = null, criterion = "", swept = swept } = state), pick.value = criterion;
    renew();
  }
  const save = (name, content, type) => {
    const link = make("a", { href: URL.createObjectURL(new Blob([content], { type })), download: name });
    link.click(), setTimeout(() => URL.revokeObjectURL(link.href), 1000);
  };
  const picture = () => {
    const copy = /** @type {any} */ (plane.cloneNode(true));
    copy.setAttribute("xmlns", SVG), copy.insertBefore(make("style"), copy.firstChild).textContent = STYLE;
    return new XMLSerializer().serializeToString(copy);
  };
  const table = () => [`stiffness [${of().K}],damping [${of().B}]`,
    ...result.border.stiffness.map((K, i) => Number.isFinite(K) ? `${K},${result.border.damping[i]}` : ","), ""].join("\n");
  const pointed = (event) => {
    const box = plane.getBoundingClientRect(), share = [((event.clientX - box.left) / box.width * width - left) / (width - left - 12),
        (height - bottom - (event.clientY - box.top) / box.height * height) / (height - bottom - 12)];
    const [[x0, x1], [y0, y1]] = axes();
    return { share, stiffness: x0 + share[0] * (x1 - x0), damping: y0 + share[1] * (y1 - y0) };
  };
  const pan = (x, y) => { const [[a, b], [c, d]] = axes(); view = { x: [a + x, b + x], y: [c + y, d + y] }, draw(), store(); };
  let grabbed = /** @type {any} */ (null), former = wall;
  const touches = /** @type {Map<number, any>} */ (new Map());
  plane.addEventListener("pointerdown", (event) => {
    touches.set(event.pointerId, event), plane.setPointerCapture(event.pointerId), grabbed = event.shiftKey ? pointed(event) : "wall";
    if (touches.size === 1) former = wall, plane.dispatchEvent(new PointerEvent("pointermove", event));
    else wall = former, move();  // two fingers move no wall
  });
  plane.addEventListener("pointermove", (event) => {
    if (!touches.has(event.pointerId)) return;
    const before = [...touches.values()], to = pointed(event);
    touches.set(event.pointerId, event);
    if (touches.size > 1) {  // two fingers zoom, and move the view with them
      const [from, now] = [before, [...touches.values()]].map(([a, b]) => {
        const [p, q] = [pointed(a).share, pointed(b).share];
        return { x: (p[0] + q[0]) / 2, y: (p[1] + q[1]) / 2, apart: Math.hypot(a.clientX - b.clientX, a.clientY - b.clientY) };
      }), [[x0, x1], [y0, y1]] = axes();
      pan((from.x - now.x) * (x1 - x0), (from.y - now.y) * (y1 - y0)), zoom(from.apart / Math.max(now.apart, 1), now.x, now.y);
    } else if (grabbed === "wall") wall = { stiffness: Math.max(0, Number(to.stiffness.toPrecision(4))), damping: Number(to.damping.toPrecision(4)) }, move();
    else if (grabbed) pan(grabbed.stiffness - to.stiffness, grabbed.damping - to.damping);
  });
  for (const name of ["pointerup", "pointercancel"]) plane.addEventListener(name, (event) => { touches.delete(event.pointerId), grabbed = null; });
  plane.addEventListener("wheel", (event) => {
    const { share } = pointed(event);
    event.preventDefault(), zoom(event.deltaY > 0 ? 1.15 : 0.87, share[0], share[1]);
  }, { passive: false });
  plane.addEventListener("keydown", (event) => {
    const ways = /** @type {Record<string, number[]>} */ ({ ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] });
    const way = ways[event.key], [[x0, x1], [y0, y1]] = axes();
    if (way && event.shiftKey) pan(way[0] * (x1 - x0) / 10, way[1] * (y1 - y0) / 10);
    else if (way && wall) wall = { stiffness: Math.max(0, wall.stiffness + way[0] * (x1 - x0) / 100), damping: wall.damping + way[1] * (y1 - y0) / 100 }, move();
    else if (event.key === "+" || event.key === "-") zoom(event.key === "+" ? 0.7 : 1.4);
    else if (event.key.toLowerCase() === "p") pin.click();
    else return;
    event.preventDefault();
  });
  let moving = false;
  /** Show another wall of the same loop. */
  function move() {
    if (moving) return;
    moving = true, requestAnimationFrame(() => {
      moving = false;
      if (result) draw(), showWalls(), showSummary(), store();
    });
  }
  const restore = () => {
    let state;
    try { state = location.hash.startsWith(keep) ? JSON.parse(decodeURIComponent(location.hash.slice(keep.length))) : undefined; } catch { /* a broken address changes nothing */ }
    if (state || !result) begin(state?.e ?? 0, state);
  };
  addEventListener("hashchange", restore), restore();
}
