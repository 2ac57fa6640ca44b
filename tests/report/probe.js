// Looks at the report in the frame of this page and leaves what it finds in the body, as JSON.
const errors = [];
const frame = document.querySelector("iframe");
frame.addEventListener("load", () => {
  const page = frame.contentDocument, found = {};
  found.title = page.title;
  found.width = page.documentElement.scrollWidth;
  found.charts = page.querySelectorAll("svg").length;
  found.hidden = [...page.querySelectorAll("section > .charts svg, section > .panels svg")].filter(svg => svg.getBoundingClientRect().height < 20).length;
  for (const part of page.querySelectorAll("details")) part.open = true;
  found.outside = []; found.overlaps = [];
  for (const svg of page.querySelectorAll("svg")) {
    const view = svg.viewBox.baseVal, boxes = [];
    for (const text of svg.querySelectorAll("text")) {
      const box = text.getBBox(), words = svg.getAttribute("aria-labelledby") + ": " + text.textContent;
      if (box.x < -2 || box.y < -2 || box.x + box.width > view.width + 2 || box.y + box.height > view.height + 2) found.outside.push(words);
      for (const [other, name] of boxes) {
        const across = Math.min(box.x + box.width, other.x + other.width) - Math.max(box.x, other.x);
        const down = Math.min(box.y + box.height, other.y + other.height) - Math.max(box.y, other.y);
        if (across > 1 && down > 4) found.overlaps.push(words + " / " + name);
      }
      boxes.push([box, text.textContent]);
    }
  }
  found.wide = [...page.querySelectorAll("h1, h2, p, li, figure, figcaption, .scroll, summary")]
    .filter(e => e.getBoundingClientRect().right > page.documentElement.clientWidth + 1).map(e => e.textContent.slice(0, 60));
  found.unnamed = [...page.querySelectorAll("svg")].filter(svg => !page.getElementById(svg.getAttribute("aria-labelledby").split(" ")[0])).length;
  const table = page.querySelector("#t-images"), heads = [...table.tHead.rows[0].cells];
  const column = name => heads.findIndex(head => head.textContent.startsWith(name));
  const values = k => [...table.tBodies[0].rows].map(row => row.cells[k].textContent);
  const points = column("used"), image = column("image");
  heads[points].firstElementChild.click(); found.up = values(points); found.sorted = heads[points].getAttribute("aria-sort");
  heads[points].firstElementChild.click(); found.down = values(points);
  heads[image].firstElementChild.click(); found.names = values(image); found.unsorted = heads[points].getAttribute("aria-sort");
  heads[image].firstElementChild.focus(); found.focus = page.activeElement === heads[image].firstElementChild;
  const box = table.closest(".scroll"), top = e => e.getBoundingClientRect().top;
  box.style.maxHeight = "160px"; box.scrollTop = 120; found.scrolled = box.scrollTop; found.sticky = top(heads[0]) - top(box);
  const style = getComputedStyle(page.body); found.colors = [style.color, style.backgroundColor];
  document.body.textContent = JSON.stringify({...found, errors});
});
frame.contentWindow.addEventListener("error", event => errors.push(event.message));
