"use strict";
// All trials of an experiment as a table: search, filter, sort, and up to six responses over each other; all in the address.

const [PAGE_ROWS, MOST_COMPARED, FIRST_COST] = [100, 6, 4];
const COMPARED = [["--fig-blue", []], ["--fig-vermillion", [7, 3]], ["--fig-green", [2, 3]], ["--fig-purple", [9, 3, 2, 3]], ["--fig-orange", [4, 2]], ["--fig-sky", [1, 2]]];

class Runs {
  constructor(explorer) {
    const at = (name) => document.getElementById(`runs-${name}`);
    this.explorer = explorer;
    this.fields = Object.fromEntries(["search", "verdict", "outcome"].map((name) => [name, at(name)]));
    [this.table, this.count, this.more, this.plot, this.key] = ["table", "count", "more", "plot", "key"].map(at);
    this.response = new ResponsePlot(this.plot);
    this.chosen = [];
    this.sort = { column: -1, down: false };
    this.length = PAGE_ROWS;
    for (const field of Object.values(this.fields)) field.addEventListener("input", () => { this.length = PAGE_ROWS; this.change(); });
    this.more.addEventListener("click", () => { this.length += PAGE_ROWS; this.fill(); });
    at("clear").addEventListener("click", () => { this.chosen = []; this.change(); });
    this.heads();
  }

  /** Columns of the table: what stands above, and the value of a row that it is sorted by. */
  columns() {
    const { content } = this.explorer;
    const shown = () => this.explorer.shown;
    return [
      [`K [${content.units.stiffness}]`, (row) => shown().k[row]],
      [`B [${content.units.damping}]`, (row) => shown().b[row]],
      ["verdict", (row) => content.verdicts[shown().v[row]]],
      ["outcome", (row) => content.outcomes[shown().o[row]]],
      ...content.criteria.map(({ label }, n) => [label, (row) => shown().c[n][row]]),
    ];
  }

  heads() {
    const row = this.table.tHead.rows[0];
    row.append(make("th", "words", "compare"), ...this.columns().map(([label], column) => {
      const head = make("th", "", make("button", "sort", label));
      head.scope = "col";
      head.firstChild.type = "button";
      head.firstChild.addEventListener("click", () => {
        this.sort = { column, down: this.sort.column === column && !this.sort.down };
        this.change();
      });
      return head;
    }));
    row.cells[0].scope = "col";
  }

  /** Show the trials of the experiment that was opened; `wanted` is a state by `follow`. */
  show(wanted) {
    const { content } = this.explorer;
    for (const name of ["verdict", "outcome"]) {
      const used = new Set(this.explorer.shown[name[0]]);
      const names = content[`${name}s`].filter((_, n) => used.has(String(n)));
      this.fields[name].replaceChildren(new Option("any", ""), ...names.map((text) => new Option(text, text)));
    }
    this.chosen = (wanted?.rows ?? []).filter((row) => this.explorer.shown.byRow.has(row)).slice(0, MOST_COMPARED);
    for (const [name, field] of Object.entries(this.fields)) field.value = wanted?.state.get(name) ?? "";
    this.sort = { column: Number(wanted?.state.get("sort") ?? -1), down: wanted?.state.get("down") === "1" };
    this.length = PAGE_ROWS;
    this.fill();
  }

  change() {
    this.fill();
    const state = new URLSearchParams();
    for (const [name, field] of Object.entries(this.fields)) if (field.value) state.set(name, field.value);
    if (this.sort.column >= 0) state.set("sort", this.sort.column);
    if (this.sort.down) state.set("down", "1");
    const rows = this.chosen.map((row) => `-${row}`).join("");
    history.replaceState(null, "", `#runs-${this.explorer.number}${rows}${state.size ? `?${state}` : ""}`);
  }

  /** Rows that search and filters leave, in their order. */
  found() {
    const columns = this.columns();
    const words = this.fields.search.value.toLowerCase().replace(/−/g, "-").replace(/\s*=\s*/g, "=").split(/[\s,;]+/).filter(Boolean);
    // a number is that stiffness or damping and no other, with a letter the one of both
    const fits = (row, word) => {
      const number = /^(?:([kb])=)?(-?\d+(?:\.\d*)?)$/.exec(word);
      if (!number) return [2, 3].some((column) => columns[column][1](row).toLowerCase().includes(word));
      return ["k", "b"].some((letter, column) => (number[1] ?? letter) === letter && columns[column][1](row) === Number(number[2]));
    };
    const [verdict, outcome] = [this.fields.verdict.value, this.fields.outcome.value];
    const rows = this.explorer.shown.k.map((_, row) => row).filter((row) =>
      (!verdict || columns[2][1](row) === verdict) && (!outcome || columns[3][1](row) === outcome)
      && words.every((word) => fits(row, word)));
    // one damping after the other, as recorded in a lab
    rows.sort((a, b) => columns[1][1](a) - columns[1][1](b) || columns[0][1](a) - columns[0][1](b));
    const value = columns[this.sort.column]?.[1];
    if (!value) return rows;
    const sign = this.sort.down ? -1 : 1;
    return rows.sort((a, b) => {
      const [x, y] = [value(a), value(b)];
      return x === null || y === null ? (x === null) - (y === null) : sign * compareKeys(x, y);
    });
  }

  fill() {
    const rows = this.found();
    const columns = this.columns();
    [...this.table.tHead.rows[0].cells].slice(1).forEach((head, column) => {
      if (column === this.sort.column) head.setAttribute("aria-sort", this.sort.down ? "descending" : "ascending");
      else head.removeAttribute("aria-sort");
    });
    this.table.tBodies[0].replaceChildren(...rows.slice(0, this.length).map((row) => {
      const cells = [];
      let before = "";
      columns.forEach(([, value], column) => {
        const found = value(row), missing = found === null ? this.missing(row, column - FIRST_COST) : "";
        if (missing && missing === before) cells.at(-1).colSpan += 1; // a reason that neighbouring costs share is told once
        else cells.push(make("td", missing || typeof found === "string" ? "words" : "", missing || (typeof found === "number" ? plain(found) : found)));
        before = missing;
      });
      return make("tr", "", make("td", "words", this.box(row)), ...cells);
    }));
    this.count.textContent = `${rows.length} of ${this.explorer.shown.k.length} trials`;
    this.more.hidden = rows.length <= this.length;
    this.draw();
  }

  /** Why a trial has no cost. */
  missing(row, criterion) {
    const { shown, content } = this.explorer;
    const told = shown.byRow.get(row)?.costs[criterion].replace(/^none: /, "");
    const verdict = content.verdicts[shown.v[row]];
    return told ?? (verdict === "stable" ? "the reason is in a page by compare --full" : `${verdict}: no cost`);
  }

  /** The box that puts a response over the others; none where the page does not hold it. */
  box(row) {
    if (!this.explorer.shown.byRow.has(row)) return "–";
    const box = document.createElement("input");
    box.type = "checkbox";
    box.checked = this.chosen.includes(row);
    box.disabled = !box.checked && this.chosen.length >= MOST_COMPARED;
    box.dataset.row = row;
    box.setAttribute("aria-label", `compare ${this.explorer.place(row)}`);
    box.addEventListener("change", () => {
      this.chosen = box.checked ? [...this.chosen, row] : this.chosen.filter((other) => other !== row);
      this.change();
      this.table.querySelector(`[data-row="${row}"]`)?.focus();
    });
    return box;
  }

  draw() {
    const trials = this.chosen.map((row) => this.explorer.shown.byRow.get(row));
    this.plot.hidden = !trials.length;
    this.response.compare(trials, this.chosen.map((row) => this.explorer.place(row)), this.explorer.content.position);
    fill(this.key, ...this.chosen.map((row, n) => make("li", "", make("span", `swatch line run-${n}`), this.explorer.place(row))));
  }

  /** State that the address names, `#runs-0-12-45?verdict=stable`, or null. */
  static named() {
    const found = /^#runs-(\d+)((?:-\d+)*)(?:\?(.*))?$/.exec(location.hash);
    return found && { experiment: Number(found[1]), rows: found[2].split("-").slice(1).map(Number), state: new URLSearchParams(found[3] ?? "") };
  }
}
