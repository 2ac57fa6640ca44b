"use strict";
const unfold = sections => { for (const section of sections) for (const e of section.querySelectorAll(":scope > .whole")) e.open = true; };
const asked = () => unfold([...document.querySelectorAll("section")].filter(section => "#" + section.id === location.hash));
const all = document.querySelector(".all");
all.hidden = !document.querySelector("main details");
all.onclick = () => {
  const open = all.textContent === "open all";
  for (const e of document.querySelectorAll("main details")) e.open = open;
  all.textContent = open ? "close all" : "open all";
};
addEventListener("hashchange", asked); addEventListener("beforeprint", () => unfold(document.querySelectorAll("section"))); asked();
// The page is whole without this: tables that sort and filter, one selection in map, tables and panels, and residual
// maps in large.
const make = (name, set, ...children) => { const e = Object.assign(document.createElement(name), set); e.append(...children); return e; };
const bar = document.querySelector(".chosen");
let chosen = [];

const say = views => {
  const row = document.querySelector(`tr[data-views="${views.join("-")}"]`), title = document.querySelector(`[data-v="${views[0]}"] title`);
  if (views.length === 1) return title ? title.textContent : row.cells[0].textContent;
  return `${row.cells[0].textContent}: ${row.cells[1].textContent} matches`;
};
const same = views => views.length === chosen.length && views.every((v, i) => v === chosen[i]);

function choose(views, from) {
  chosen = same(views) ? [] : views;
  for (const e of document.querySelectorAll(".on")) e.classList.remove("on");
  for (const e of document.querySelectorAll("[data-v]"))
    if (chosen.includes(+e.dataset.v)) (e.closest("figure .panel") ? e.closest("figure") : e).classList.add("on");
  for (const row of document.querySelectorAll("tr[data-views]")) {
    const own = row.dataset.views.split("-").map(Number);
    if (!chosen.length || !(own.length === 1 ? chosen.includes(own[0]) : chosen.every(v => own.includes(v)))) continue;
    row.classList.add("on");
    const box = row.closest(".scroll");
    if (box && !box.contains(from) && !box.querySelector(".on ~ .on")) box.scrollTop = row.offsetTop - box.clientHeight / 2;
  }
  bar.hidden = !chosen.length;
  bar.replaceChildren(...(chosen.length ? [say(chosen), make("button", { type: "button", textContent: "clear", onclick: () => choose([]) })] : []));
}

for (const e of document.querySelectorAll("svg [data-v]")) e.addEventListener("click", event => choose([+e.dataset.v], event.target));

for (const table of document.querySelectorAll("table")) {
  const heads = [...table.tHead.rows[0].cells], body = table.tBodies[0], rows = [...body.rows];
  heads.forEach((head, column) => head.firstElementChild.addEventListener("click", () => {
    const down = head.getAttribute("aria-sort") === "ascending";
    heads.forEach(other => other.setAttribute("aria-sort", "none"));
    head.setAttribute("aria-sort", down ? "descending" : "ascending");
    const key = row => row.cells[column].dataset.key ?? row.cells[column].textContent;
    const compare = (a, b) => a !== "" && b !== "" && !isNaN(a) && !isNaN(b) ? a - b : a.localeCompare(b, undefined, { numeric: true });
    body.append(...[...body.rows].sort((a, b) => compare(key(a), key(b)) * (down ? -1 : 1)));
  }));
  if (rows.length && rows[0].dataset.views) {
    table.classList.add("live");
    rows.forEach((row, k) => {
      const views = row.dataset.views.split("-").map(Number);
      row.tabIndex = k ? -1 : 0;
      row.addEventListener("click", () => choose(views, row));
      row.addEventListener("keydown", event => {
        const step = { ArrowDown: "nextElementSibling", ArrowUp: "previousElementSibling" }[event.key];
        if (event.key === "Enter" || event.key === " ") choose(views, row);
        else if (!step) return;
        let other = step && row[step];
        while (other && other.hidden) other = other[step];
        if (other) { row.tabIndex = -1; other.tabIndex = 0; other.focus(); }
        event.preventDefault();
      });
    });
  }
  if (rows.length > 8) {
    const count = make("span", { className: "note", ariaLive: "polite" });
    const field = make("input", { type: "search", oninput: () => {
      const words = field.value.toLowerCase().split(/\s+/);
      let shown = 0;
      for (const row of rows) shown += !(row.hidden = !words.every(word => row.textContent.toLowerCase().includes(word)));
      count.textContent = field.value ? `${shown} of ${rows.length} rows` : "";
    } });
    table.closest(".scroll").before(make("div", { className: "tools" }, make("label", {}, "Filter rows ", field), count));
  }
}

const dialog = document.body.appendChild(make("dialog"));
dialog.addEventListener("click", () => dialog.close());
for (const panel of document.querySelectorAll(".panels figure")) {
  const open = () => {
    const copy = panel.querySelector("svg").cloneNode(true);
    copy.removeAttribute("aria-labelledby");
    copy.setAttribute("aria-label", panel.querySelector("title").textContent);
    for (const e of copy.querySelectorAll("[id]")) e.removeAttribute("id");
    const close = make("button", { type: "button", textContent: "close" });
    dialog.replaceChildren(copy, make("p", { className: "tools" }, panel.querySelector("figcaption").textContent, close));
    dialog.showModal();
  };
  panel.tabIndex = 0;
  panel.setAttribute("role", "button");
  panel.addEventListener("click", open);
  panel.addEventListener("keydown", event => { if (event.key === "Enter" || event.key === " ") { event.preventDefault(); open(); } });
}

for (const e of document.querySelectorAll(".swipe")) {
  const seam = percent => e.style.setProperty("--seam", percent + "%");
  const flip = () => seam(parseFloat(e.style.getPropertyValue("--seam")) === 0 ? 100 : 0);
  e.onpointermove = move => { const box = e.getBoundingClientRect(); seam(Math.max(0, Math.min(100, 100 * (move.clientX - box.left) / box.width))); };
  e.onclick = flip;
  e.onkeydown = key => { if (key.key === " " || key.key === "Enter") { key.preventDefault(); flip(); } };
}
