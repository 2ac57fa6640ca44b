// Uses the report in the frame of this page as its readers do, and leaves what it finds in the body, as JSON.
const errors = [], found = {};
const frame = document.querySelector("iframe");
frame.addEventListener("load", () => {
  try { use(); } catch (error) { errors.push(error.stack); }
  document.body.textContent = JSON.stringify({ ...found, errors });
});
function use() {
  const page = frame.contentDocument, view = frame.contentWindow;
  const on = () => [...page.querySelectorAll("tr.on")].map(row => row.closest("table").id + " " + row.cells[0].textContent.trim());
  const lit = () => [...page.querySelectorAll("g.on[data-v]")].map(e => e.dataset.v);
  const said = () => page.querySelector(".chosen").hidden ? "" : page.querySelector(".chosen").firstChild.textContent;
  const click = e => e.dispatchEvent(new view.MouseEvent("click", { bubbles: true }));
  const key = (e, name) => e.dispatchEvent(new view.KeyboardEvent("keydown", { key: name, bubbles: true }));
  const point = (name, a, b) => {
    const matrix = page.querySelector(".matrix"), box = matrix.getBoundingClientRect(), d = matrix.dataset;
    const unit = box.width / matrix.viewBox.baseVal.width;
    matrix.dispatchEvent(new view.PointerEvent(name, { bubbles: true,
      clientX: box.left + (+d.left + (b + 0.5) * d.side) * unit, clientY: box.top + (+d.top + (a + 0.5) * d.side) * unit }));
    return matrix.nextElementSibling.textContent;
  };
  click(page.querySelector('g[data-v="2"] path')); found.map = [lit(), on(), said()];
  click(page.querySelector('g[data-v="2"] path')); found.again = [lit(), on(), said()];
  found.hover = point("pointermove", 0, 1); found.diagonal = point("pointermove", 1, 1);
  point("click", 1, 0); found.matrix = [lit(), on(), said()];
  const mark = page.querySelector(".cursor"), d = page.querySelector(".matrix").dataset;
  found.cursor = [mark.classList.contains("seen"), Math.round((mark.getAttribute("x") - d.left) / d.side), Math.round((mark.getAttribute("y") - d.top) / d.side)];
  click(page.querySelector(".chosen button")); found.cleared = [lit(), on(), said()];
  const first = page.querySelector("#t-images tbody tr"); first.focus();
  key(first, "ArrowDown"); found.focus = page.activeElement.cells[0].textContent.trim();
  key(page.activeElement, "Enter"); found.keyed = [lit(), said()];
  key(page.activeElement, "Enter");
  const layers = () => [...page.querySelectorAll(".layer")].map(e => view.getComputedStyle(e).display !== "none");
  found.layers = [layers()];
  for (const radio of [...page.querySelectorAll("input[name=measure]")].slice(1)) { radio.click(); found.layers.push(layers()); }
  const field = page.querySelector("#images input[type=search]");
  field.value = "view_0003"; field.dispatchEvent(new view.Event("input"));
  found.filtered = [...page.querySelectorAll("#t-images tbody tr")].filter(r => r.getBoundingClientRect().height).map(r => r.cells[0].textContent);
  found.count = field.closest(".tools").querySelector(".note").textContent;
  const panel = page.querySelector(".panels figure"); key(panel, "Enter");
  const dialog = page.querySelector("dialog");
  found.dialog = [dialog.open, dialog.querySelector("svg").getBoundingClientRect().width / panel.querySelector("svg").getBoundingClientRect().width > 2, dialog.textContent.includes(panel.querySelector("figcaption").textContent)];
  click(dialog.querySelector("button")); found.closed = dialog.open;
}
frame.contentWindow.addEventListener("error", event => errors.push(event.message));
