// Sorting by the heads of the columns, and filters; without a script the table is whole and in order of its names.
"use strict";
(() => {
  const table = document.querySelector("table.runs");
  if (!table) return;
  const body = table.tBodies[0], rows = [...body.rows];
  const byId = (id) => document.getElementById(id);
  const [filter, most, lost, shown] = ["filter", "most", "lost", "shown"].map(byId);

  function choose() {
    const words = filter.value.trim().toLowerCase(), limit = most.value === "" ? 1 : Number(most.value);
    let count = 0;
    for (const row of rows) {
      const fits = row.dataset.name.includes(words) && Number(row.dataset.confidence) <= limit
        && (!lost.checked || Number(row.dataset.lost) > 0);
      row.hidden = !fits;
      count += fits;
    }
    shown.textContent = count === rows.length ? `${count} runs` : `${count} of ${rows.length} runs`;
  }

  function sort(head) {
    const up = head.getAttribute("aria-sort") !== "ascending", column = head.cellIndex;
    for (const other of table.tHead.rows[0].cells) other.removeAttribute("aria-sort");
    head.setAttribute("aria-sort", up ? "ascending" : "descending");
    const value = (row) => row.cells[column].dataset.value;
    const compare = head.dataset.sort === "number"
      ? (a, b) => Number(value(a)) - Number(value(b))
      : (a, b) => value(a).localeCompare(value(b), undefined, { numeric: true });
    body.append(...rows.sort((a, b) => (up ? 1 : -1) * compare(a, b)));
  }

  for (const head of table.tHead.rows[0].cells) {
    if (!head.dataset.sort) continue;
    const button = document.createElement("button");
    button.type = "button";
    button.textContent = head.textContent;
    head.replaceChildren(button);
    button.addEventListener("click", () => sort(head));
  }
  for (const one of [filter, most, lost]) one.addEventListener("input", choose);
  document.querySelector(".filters").hidden = false;
  choose();
})();
