"use strict";
/* Upload with progress and by drag and drop; without this script the forms send themselves. */
const prepareUpload = (form) => {
  const input = form.querySelector("input[type=file]"), drop = form.querySelector(".drop");
  const bar = form.querySelector("progress"), told = form.querySelector("[role=status]");
  let paths = null;
  for (const kind of ["dragover", "dragleave", "drop"])
    drop.addEventListener(kind, (event) => {
      event.preventDefault();
      drop.classList.toggle("over", kind === "dragover");
      if (kind === "drop") take(event.dataTransfer);
    });
  /* a folder is read to its depth; its files keep their paths, by which pairs are known */
  const walk = async (entry, path, found) => {
    if (entry.isFile) {
      if (!entry.name.startsWith(".")) found.push([path + entry.name, await new Promise((done, failed) => entry.file(done, failed))]);
      return;
    }
    const reader = entry.createReader();
    for (;;) {
      const some = await new Promise((done, failed) => reader.readEntries(done, failed));
      if (!some.length) return;
      for (const one of some) await walk(one, path + entry.name + "/", found);
    }
  };
  const take = async (given) => {
    const entries = [...given.items].map((item) => item.webkitGetAsEntry && item.webkitGetAsEntry()).filter(Boolean);
    const found = [], held = new DataTransfer();
    for (const entry of entries) await walk(entry, "", found);
    for (const [, file] of found) held.items.add(file);
    input.files = held.files;
    paths = found.map(([path]) => path);
    told.textContent = `${found.length} files are ready.`;
  };
  input.addEventListener("change", () => { paths = null; });
  if (bar) form.addEventListener("submit", (event) => {
    event.preventDefault();
    const files = [...input.files], most = form.dataset;
    const large = files.find((file) => file.size > most.maxFile);
    const whole = files.reduce((sum, file) => sum + file.size, 0);
    if (large) { told.textContent = `${large.name} is too large.`; return; }
    if (whole > most.maxRequest || files.length > most.maxFiles) { told.textContent = "These are too many logs for one upload."; return; }
    const request = new XMLHttpRequest();
    request.open("POST", "/api/v1/logs");
    request.setRequestHeader("X-CSRF-Token", form.elements.form.value);
    request.upload.onprogress = (sent) => { bar.hidden = false; bar.value = sent.loaded / sent.total; };
    request.onerror = () => { told.textContent = "The server cannot be reached. Upload the logs again later; those that it already has are skipped."; };
    request.onload = () => {
      const answer = JSON.parse(request.responseText);
      if (request.status === 202) location.assign(`/jobs/${answer.job}`);
      else told.textContent = [answer.where, answer.detail].filter(Boolean).join(": ");
    };
    const data = new FormData();
    data.append("profile", form.elements.profile.value);
    files.forEach((file, at) => data.append("files", file, paths ? paths[at] : file.name));
    request.send(data);
  });
};
const prepareUploads = () => document.querySelectorAll("form[enctype]").forEach(prepareUpload);
prepareUploads();

/* Fields that differ from what the server sent. */
const TEXT = "textarea, input:not([type=hidden], [type=checkbox], [type=radio], [type=file], [type=submit], [type=button])";
const differs = (field) => {
  if (field.type === "file") return field.files.length > 0;
  if (field.type === "checkbox" || field.type === "radio") return field.checked !== field.defaultChecked;
  if (field.options) {
    const chosen = [...field.options].findIndex((option) => option.defaultSelected);
    return field.selectedIndex !== Math.max(chosen, 0);
  }
  return field.value !== field.defaultValue;
};
const changed = (root, which) => [...root.querySelectorAll(which)].some(differs);
const isInUse = () => {
  const field = document.activeElement;
  return changed(document, `${TEXT}, select, input`) || Boolean(field && field.matches(`${TEXT}, select`));
};

/* A page that waits for a result is replaced in place: between the look at its forms and the new content no key is lost. */
const RELOAD = "meta[name=reload]";
let timer = 0;
const notice = () => {
  let line = document.getElementById("reload-notice");
  if (!line) {
    line = document.createElement("p");
    line.id = "reload-notice";
    line.className = "banner";
    line.setAttribute("role", "status");
    line.textContent = "A form on this page is in use. The page reloads when its text is saved or removed.";
    document.getElementById("main").prepend(line);
  }
};
const reload = async () => {
  if (isInUse()) { notice(); return wait(1); }
  let fresh = null;
  try {
    const answer = await fetch(location.href, { headers: { Accept: "text/html" }, cache: "no-store" });
    const isPage = answer.status < 500 && answer.status !== 429;
    if (isPage && !answer.redirected) fresh = new DOMParser().parseFromString(await answer.text(), "text/html");
    else if (answer.redirected && !isInUse()) return location.reload();
  } catch { /* the server is away: again later */ }
  if (!fresh || !fresh.getElementById("main")) return wait(3);
  if (isInUse()) { notice(); return wait(1); }
  const open = [...document.querySelectorAll("details")].map((part) => part.open);
  document.title = fresh.title;
  document.body.replaceWith(document.adoptNode(fresh.body));
  const parts = [...document.querySelectorAll("details")];
  if (parts.length === open.length) parts.forEach((part, at) => { part.open = open[at]; });
  prepareUploads();
  document.dispatchEvent(new Event("page-renewed"));
  const next = fresh.querySelector(RELOAD);
  if (next) wait(Number(next.content));
};
const wait = (seconds) => { clearTimeout(timer); timer = setTimeout(reload, 1000 * seconds); };
const first = document.querySelector(RELOAD);
if (first) wait(Number(first.content));

/* Another form of the page is sent, or the page is left: the browser asks before it drops text. */
let sent = null;
const unsaved = () => [...document.querySelectorAll("form[method=post]")].filter((form) => changed(form, TEXT));
const ask = (event) => {
  if (unsaved().some((form) => form !== sent)) event.preventDefault();
  sent = null;
};
/* only while there is text: a page that always listens is left more slowly */
const listen = () => (unsaved().length ? addEventListener : removeEventListener)("beforeunload", ask);
document.addEventListener("submit", (event) => { sent = event.target; });
document.addEventListener("input", listen);
addEventListener("pageshow", () => { sent = null; listen(); });
