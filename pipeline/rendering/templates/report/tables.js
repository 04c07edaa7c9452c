"use strict";
// Tables sort by a button in each head and, where long, filter by a text.

const LONG_TABLE = 25; // rows from which on a filter is quicker than looking

/** Number that a cell begins with, its text in lower case, or null for a missing value. */
function sortKey(cell) {
  const copy = cell.cloneNode(true);
  copy.querySelectorAll("sup, small").forEach((part) => part.remove());
  const text = copy.textContent.trim();
  if (text === "" || text === "–") return null;
  const number = /^[≥≤(]*\s*([-+]?\d+(\.\d+)?(e[-+]?\d+)?)/i.exec(text.replaceAll("−", "-"));
  return number && !cell.classList.contains("words") ? Number(number[1]) : text.toLowerCase();
}

function compareKeys(a, b) {
  if (typeof a === "number" && typeof b === "number") return a - b;
  return String(a).localeCompare(String(b), "en", { numeric: true });
}

/** Sort the rows of each block; missing values stay last in both directions. */
function sortBody(body, column, direction) {
  const rows = [...body.rows].filter((row) => !row.classList.contains("blockhead"));
  const keyed = rows.map((row) => ({ row, key: direction === "none" ? null : sortKey(row.cells[column]) }));
  const sign = direction === "descending" ? -1 : 1;
  keyed.sort((a, b) => {
    if (direction === "none") return a.row.dataset.place - b.row.dataset.place;
    if (a.key === null || b.key === null) return (a.key === null) - (b.key === null);
    return sign * compareKeys(a.key, b.key);
  });
  body.append(...keyed.map((entry) => entry.row));
}

function makeSortable(table) {
  const heads = [...table.tHead.rows[table.tHead.rows.length - 1].cells];
  const bodies = [...table.tBodies];
  for (const body of bodies) [...body.rows].forEach((row, place) => { row.dataset.place = place; });
  heads.forEach((head, column) => {
    if (!head.textContent.trim()) return;
    const button = document.createElement("button");
    button.type = "button";
    button.className = "sort";
    button.append(...head.childNodes);
    head.append(button);
    button.addEventListener("click", () => {
      const next = { ascending: "descending", descending: "none" }[head.getAttribute("aria-sort")] ?? "ascending";
      heads.forEach((other) => other.removeAttribute("aria-sort"));
      if (next !== "none") head.setAttribute("aria-sort", next);
      bodies.forEach((body) => sortBody(body, column, next));
    });
  });
}

function makeFilter(table, number) {
  const rows = [...table.tBodies].flatMap((body) => [...body.rows]).filter((row) => !row.classList.contains("blockhead"));
  if (rows.length < LONG_TABLE) return;
  const [holder, label, input, status] = ["div", "label", "input", "span"].map((tag) => document.createElement(tag));
  holder.className = "filter";
  input.type = "search";
  input.id = `filter-${number}`;
  label.htmlFor = input.id;
  label.textContent = "Show only rows with";
  status.setAttribute("role", "status");
  holder.append(label, input, status);
  (table.closest(".scroll") ?? table).before(holder);
  const texts = new Map(rows.map((row) => [row, `${row.parentNode.querySelector(".blockhead")?.textContent ?? ""} ${row.textContent}`.toLowerCase()]));
  input.addEventListener("input", () => {
    const words = input.value.toLowerCase().split(/\s+/).filter(Boolean);
    let shown = 0;
    for (const row of rows) {
      row.hidden = !words.every((word) => texts.get(row).includes(word));
      shown += !row.hidden;
    }
    for (const head of table.querySelectorAll("tr.blockhead")) {
      head.hidden = rows.every((row) => row.parentNode !== head.parentNode || row.hidden);
    }
    status.textContent = words.length ? `${shown} of ${rows.length} rows` : "";
  });
}

document.querySelectorAll("main table").forEach((table, number) => {
  if (!table.tHead) return;
  if ([...table.tBodies].some((body) => body.rows.length > 2)) makeSortable(table);
  makeFilter(table, number);
});

// the reason for a missing value stands below its table; here it appears on pointing, too
for (const mark of document.querySelectorAll("abbr[data-why]")) {
  mark.title = mark.closest(".tabled").querySelectorAll(".whys li > span")[mark.dataset.why - 1].textContent;
}
