"use strict";
// Of the figures of costs over the plane one is shown; which one is chosen by two lists, and stands in the address.

for (const viewer of document.querySelectorAll(".viewer")) {
  const figures = [...viewer.querySelectorAll("figure")];
  const [shows, criteria] = viewer.querySelectorAll("select");
  const list = (select, name) => {
    for (const text of new Set(figures.map((figure) => figure.dataset[name]))) select.add(new Option(text, text));
  };
  const named = () => figures.find((figure) => `#${figure.id}` === location.hash);
  const show = (figure) => {
    figures.forEach((other) => { other.hidden = other !== figure; });
    [shows.value, criteria.value] = [figure.dataset.show, figure.dataset.criterion];
    for (const option of criteria.options) {
      option.disabled = !figures.some(({ dataset }) => dataset.show === shows.value && dataset.criterion === option.value);
    }
  };
  const choose = () => {
    const ofShow = figures.filter(({ dataset }) => dataset.show === shows.value);
    const figure = ofShow.find(({ dataset }) => dataset.criterion === criteria.value) ?? ofShow[0];
    show(figure);
    history.replaceState(null, "", `#${figure.id}`);
  };
  list(shows, "show");
  list(criteria, "criterion");
  viewer.querySelector(".controls").hidden = false;
  viewer.querySelector("details")?.replaceWith(...viewer.querySelectorAll("details > figure"));
  show(named() ?? figures[0]);
  [shows, criteria].forEach((select) => select.addEventListener("change", choose));
  addEventListener("hashchange", () => {
    if (!named()) return;
    show(named());
    named().scrollIntoView();
  });
}
