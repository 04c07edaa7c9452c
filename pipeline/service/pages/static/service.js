"use strict";
/* Upload with progress and by drag and drop; without this script the forms send themselves. */
for (const form of document.querySelectorAll("form[enctype]")) {
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
    if (whole > most.maxRequest || files.length > most.maxFiles) { told.textContent = "These are too many at a time."; return; }
    const request = new XMLHttpRequest();
    request.open("POST", "/api/v1/logs");
    request.setRequestHeader("X-CSRF-Token", form.elements.form.value);
    request.upload.onprogress = (sent) => { bar.hidden = false; bar.value = sent.loaded / sent.total; };
    request.onerror = () => { told.textContent = "The server cannot be reached. Upload again: what it has is skipped."; };
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
}
