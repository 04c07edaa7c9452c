"use strict";
/* Upload with progress and by drag and drop; without this script the form sends itself. */
const form = document.getElementById("upload");
if (form) {
  const input = form.querySelector("input[type=file]"), drop = form.querySelector(".drop");
  const bar = form.querySelector("progress"), told = document.getElementById("told");
  for (const kind of ["dragover", "dragleave", "drop"])
    drop.addEventListener(kind, (event) => {
      event.preventDefault();
      drop.classList.toggle("over", kind === "dragover");
      if (kind === "drop") input.files = event.dataTransfer.files;
    });
  form.addEventListener("submit", (event) => {
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
    request.send(new FormData(form));
  });
}
