"use strict";
// Choosing a trial: by experiment, in the plane, or by a number in a table; what is said of it comes from the report.

/** Put children and texts into an element in place of what it held; texts stay texts. */
function fill(element, ...content) {
  element.replaceChildren(...content);
  return element;
}

function make(tag, className, ...content) {
  const element = document.createElement(tag);
  if (className) element.className = className;
  return fill(element, ...content);
}

const swatch = (look, text) => make("li", "", make("span", `swatch ${look}`), text);

class Explorer {
  constructor(content) {
    const at = (id) => document.getElementById(id);
    this.content = content;
    this.unpacked = new Map();
    this.parts = Object.fromEntries(["plane-status", "plane-key", "trial-title", "trial-key", "trial-alternative", "trial-facts"].map((id) => [id, at(id)]));
    [this.experiment, this.criterion] = [at("choose-experiment"), at("choose-criterion")];
    this.response = new ResponsePlot(at("trial-plot"));
    this.plane = new Plane(at("plane"), (row) => this.tell(row), (row) => this.choose(row, true));
    this.experiment.addEventListener("change", () => this.open(Number(this.experiment.value)));
    this.criterion.addEventListener("change", () => this.paint(true));
    this.whole = at("trial-range");
    this.whole.addEventListener("click", () => this.response.zoom(true));
    addEventListener("hashchange", () => this.follow(true));
    this.runs = new Runs(this);
  }

  /** Trials of an experiment: columns, and responses by row. */
  trials(number) {
    if (!this.unpacked.has(number)) {
      const entry = this.content.experiments[number];
      this.unpacked.set(number, Promise.all([unpack(entry.columns), unpack(entry.responses)]).then(([columns, responses]) => {
        const byRow = new Map(responses.map((trial) => [trial.i, trial]));
        return { ...columns, byRow, rims: new Set(byRow.keys()), first: responses[0]?.i ?? 0, units: this.content.units, verdicts: this.content.verdicts };
      }));
    }
    return this.unpacked.get(number);
  }

  async open(number, row = -1, runs = null) {
    this.number = number;
    this.experiment.value = String(number);
    const shown = await this.trials(number);
    if (this.number !== number) return; // another one was chosen meanwhile
    this.shown = shown;
    this.plane.show(shown);
    this.paint(false);
    this.plane.picked = row >= 0 && row < shown.k.length ? row : shown.first;
    this.plane.draw();
    this.choose(this.plane.picked, false);
    this.tell(this.plane.picked);
    this.runs.show(runs);
  }

  paint(again) {
    const entry = this.content.criteria[this.criterion.value];
    this.plane.paint(entry ? this.shown.c[this.criterion.value] : null, entry?.unit === "%");
    const key = [];
    if (entry) {
      const limits = this.plane.limits.map((limit) => plain(Number(limit.toPrecision(3))));
      limits.forEach((limit, n) => key.push(swatch(`shade-${n + 1}`, n ? `to ${limit}` : `up to ${limit} ${entry.unit}`)));
      key.push(swatch(`shade-${SHADES}`, "above"), swatch("hollow", "stable, no cost"), swatch("cross", "unstable"));
    } else {
      key.push(swatch("stable", "stable"), swatch("cross vermillion", "unstable"));
    }
    if (this.shown.v.includes(String(this.content.verdicts.indexOf("undecided")))) key.push(swatch("undecided", "undecided"));
    if (this.shown.measured[0].length) key.push(swatch("line", "measured boundary"));
    if (this.shown.open?.[0].length) key.push(swatch("open", "tested range ended before an unstable trial"));
    if (this.shown.theory) key.push(swatch("line dashed", "boundary of theory"));
    fill(this.parts["plane-key"], ...key);
    if (again) {
      this.tell(this.plane.cursor >= 0 ? this.plane.cursor : this.plane.picked);
      this.choose(this.plane.picked, false);
    }
  }

  place(row) {
    const { k, b, units } = this.shown;
    return `K = ${plain(k[row])} ${units.stiffness}, B = ${plain(b[row])} ${units.damping}`;
  }

  outcome(row) {
    const [verdict, outcome] = [this.content.verdicts[this.shown.v[row]], this.content.outcomes[this.shown.o[row]]];
    return `${verdict}, ${outcome}`;
  }

  /** Colour the plane by the first criterion that some names hold, where one does. */
  colour(names) {
    const number = this.content.criteria.findIndex(({ name }) => names.includes(name));
    if (number < 0 || this.criterion.value === String(number)) return;
    this.criterion.value = String(number);
    if (this.shown) this.paint(true);
  }

  /** One line on the trial under the pointer or cursor. */
  tell(row) {
    const entry = this.content.criteria[this.criterion.value];
    const cost = entry ? this.shown.c[this.criterion.value][row] : null;
    const text = entry ? `; ${entry.label}: ${cost === null ? "none" : plain(cost)}` : "";
    this.parts["plane-status"].textContent = `${this.place(row)}: ${this.outcome(row)}${text}`;
  }

  /** Show the response of a trial and all that is said of it. */
  choose(row, remember) {
    const entry = this.content.experiments[this.number];
    const trial = this.shown.byRow.get(row);
    const parts = this.parts;
    if (remember) history.replaceState(null, "", `#trial-${this.number}-${row}`);
    parts["trial-title"].textContent = `Experiment ${entry.name}: ${this.place(row)}`;
    const facts = [["verdict and outcome", this.outcome(row)]];
    const costs = this.content.criteria.map(({ label }, n) => [label, this.shown.c[n][row]]);
    this.whole.hidden = !trial;
    if (trial) {
      const band = this.content.criteria[this.criterion.value]?.band ?? 0.02;
      const seen = this.response.show({ trial, delay: entry.delay, band, unit: this.content.position });
      fill(parts["trial-key"], ...[
        swatch("line blue", "log"),
        ...(trial.g ? [swatch("line dashed", "simulated loop with the fitted model")] : []),
        ...(seen.final === null ? [] : [swatch("band", `final position ±${100 * band} %`)]),
        ...(entry.delay ? [swatch("trimmed", `first d = ${entry.delay} samples, trimmed`)] : []),
      ]);
      const final = seen.final === null ? "" : `; final position F₀/K = ${plain(Number(seen.final.toPrecision(4)))} ${seen.unit}`;
      parts["trial-alternative"].textContent = `Largest displacement ${plain(Number(seen.largest.toPrecision(4)))} ${seen.unit}, last ${plain(Number(seen.last.toPrecision(4)))} ${seen.unit}${final}. Drag to zoom in.`;
      facts.push(["trial", trial.id], ["evidence", [trial.why, trial.evidence].filter(Boolean).join("; ")], ["fitted model", trial.model ?? "none"]);
      trial.costs.forEach((text, n) => { costs[n][1] = text; });
    } else {
      this.response.clear();
      fill(parts["trial-key"]);
      parts["trial-alternative"].textContent = "The response of this trial is not in this page, all numbers of it are. `pipeline compare --full` writes a page with all responses.";
    }
    const told = costs.map(([label, cost]) => [label, cost === null ? "none" : typeof cost === "number" ? plain(cost) : cost]);
    // a reason that several costs share is told once
    facts.push(...told.map(([label, text], n) => [label, text.length > 4 && text.startsWith("none") && text === told[n - 1]?.[1] ? "none, for the same reason" : text]));
    fill(parts["trial-facts"], ...facts.flatMap(([name, text]) => [make("dt", "", name), make("dd", "", text)]));
  }

  /** Show what the address names, a trial by `#trial-0-12` or a state of the table; return whether it names one. */
  follow(scroll) {
    const runs = Runs.named();
    if (runs && this.content.experiments[runs.experiment]) {
      this.open(runs.experiment, -1, runs).then(() => { if (scroll) document.getElementById("runs").scrollIntoView(); });
      return true;
    }
    const named = /^#trial-(\d+)-(\d+)$/.exec(location.hash);
    if (!named || !this.content.experiments[named[1]]) return false;
    this.open(Number(named[1]), Number(named[2])).then(() => {
      if (!scroll) return;
      this.parts["trial-title"].closest(".explorer").scrollIntoView();
      this.parts["trial-title"].focus({ preventScroll: true });
    });
    return true;
  }
}

/** Make the number of each cell that stands for a trial a link to it. */
function linkCells() {
  for (const cell of document.querySelectorAll("[data-trial]")) {
    const link = make("a", "trial", cell.firstChild);
    link.href = `#trial-${cell.dataset.trial}`;
    link.title = "show the response of this trial";
    link.addEventListener("click", () => explorer.colour(`${cell.closest("tr").dataset.row}/${cell.dataset.cell}`.split("/")));
    cell.prepend(link);
  }
}

let explorer = null;
if ("DecompressionStream" in window) {
  for (const part of ["explorer", "runs"]) document.getElementById(part).hidden = false;
  document.querySelector(".unscripted").hidden = true;
  linkCells();
  window.reportTrials = JSON.parse(document.getElementById("trial-data").textContent);
  explorer = new Explorer(window.reportTrials);
  if (!explorer.follow(true)) explorer.open(0);
}
