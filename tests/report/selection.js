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
  click(page.querySelector('g[data-v="2"] path')); found.map = [lit(), on(), said()];
  click(page.querySelector('g[data-v="2"] path')); found.again = [lit(), on(), said()];
  click(page.querySelector('tr[data-views="0-1"]')); found.pair = [lit(), on(), said()];
  click(page.querySelector(".chosen button")); found.cleared = [lit(), on(), said()];
  const first = page.querySelector("#t-images tbody tr"); first.focus();
  key(first, "ArrowDown"); found.focus = page.activeElement.cells[0].textContent.trim();
  key(page.activeElement, "Enter"); found.keyed = [lit(), said()];
  key(page.activeElement, "Enter");
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
