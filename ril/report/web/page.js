"use strict";
const all = (selector, within = document) => [...within.querySelectorAll(selector)];

// Sorting: the button in a column head sorts ascending, descending, and back to the paper's order.
// Grouped rows stay together: a table sorts whole groups (bodies), or rows within each group.
function value(row, column) {
  const cell = row.cells[column];
  const text = cell.dataset.value ?? (cell.tagName === "TD" && !cell.matches(".label") ? "" : cell.textContent.trim());
  const number = Number(text.replace("−", "-").replaceAll(",", ""));
  return text === "" ? null : Number.isNaN(number) ? text : number;
}

function compare(a, b, direction) {
  if (a === null || b === null) return (a === null) - (b === null); // missing values come last
  if (typeof a === "number" && typeof b === "number") return direction * (a - b);
  return direction * String(a).localeCompare(String(b), "en", { numeric: true });
}

function reorder(parent, items, key, direction) {
  const original = (item) => Number(item.dataset.order);
  const sorted = direction
    ? items.sort((a, b) => compare(key(a), key(b), direction) || original(a) - original(b))
    : items.sort((a, b) => original(a) - original(b));
  parent.append(...sorted);
}

function sort(table, head, column) {
  const next = { none: "ascending", ascending: "descending", descending: "none" };
  const state = next[head.getAttribute("aria-sort")];
  for (const other of table.tHead.rows[0].cells) other.setAttribute("aria-sort", "none");
  head.setAttribute("aria-sort", state);
  const direction = { ascending: 1, descending: -1, none: 0 }[state];
  const bodies = [...table.tBodies];
  const whole = table.dataset.keep === "groups" || (table.dataset.keep === "rows" && column === 0);
  reorder(table, bodies, (body) => value(body.rows[0], column), whole ? direction : 0);
  for (const body of bodies) reorder(body, [...body.rows], (row) => value(row, column), whole ? 0 : direction);
  markRepeated(table);
}

// Hide a label that repeats the one above it from sight, but not from screen readers.
function markRepeated(table) {
  if (!table.matches(".results")) return;
  for (const body of table.tBodies) {
    [...body.rows].forEach((row, index) => row.cells[0].classList.toggle("again", index > 0));
  }
}

for (const table of all("table.sortable")) {
  [...table.tBodies].forEach((body, index) => { body.dataset.order = index; });
  for (const body of table.tBodies) [...body.rows].forEach((row, index) => { row.dataset.order = index; });
  [...table.tHead.rows[0].cells].forEach((head, column) => {
    const button = document.createElement("button");
    button.type = "button";
    button.append(...head.childNodes);
    head.append(button);
    head.setAttribute("aria-sort", "none");
    button.addEventListener("click", () => sort(table, head, column));
  });
  markRepeated(table);
}

// Filters: a selection hides rows with other data; a search hides rows without the text.
function filter(form) {
  const rows = all("tbody tr", document.getElementById(form.dataset.for));
  const chosen = [...new FormData(form)].filter(([, wanted]) => wanted);
  for (const row of rows) {
    row.hidden = !chosen.every(([name, wanted]) =>
      name === "text" ? row.textContent.toLowerCase().includes(wanted.toLowerCase()) : row.dataset[name] === wanted);
  }
  form.querySelector("output").textContent = `${rows.filter((row) => !row.hidden).length} of ${rows.length}`;
}

for (const form of all("form.filters")) {
  form.hidden = false;
  form.addEventListener("input", () => filter(form));
  form.addEventListener("reset", () => setTimeout(() => filter(form)));
  form.addEventListener("submit", (event) => event.preventDefault());
  filter(form);
}

for (const link of all("a[data-select]")) {
  link.addEventListener("click", () => {
    const form = document.querySelector("form[data-for='numbers-table']");
    const wanted = new URLSearchParams(link.dataset.select);
    for (const select of all("select", form)) select.value = wanted.get(select.name) ?? "";
    filter(form);
  });
}

// Copy a command; select it where the browser denies access to the clipboard.
document.addEventListener("click", async (event) => {
  const button = event.target.closest("button.copy");
  if (!button) return;
  const code = button.parentElement.querySelector("code");
  let outcome = "copied";
  try {
    await navigator.clipboard.writeText(code.textContent);
  } catch {
    getSelection().selectAllChildren(code);
    outcome = "selected";
  }
  button.textContent = outcome;
  setTimeout(() => { button.textContent = "copy"; }, 1500);
});

// Open the target of a link; in print open everything except the commands in cells.
function reveal() {
  const target = document.getElementById(decodeURIComponent(location.hash.slice(1)));
  if (target?.tagName === "DETAILS") target.open = true;
}
addEventListener("hashchange", reveal);
addEventListener("beforeprint", () => { for (const details of all("details:not(td *)")) details.open = true; });
reveal();

// Mark the current section in the contents.
const entries = new Map(all(".contents a").map((link) => [link.hash.slice(1), link]));
const seen = new IntersectionObserver((changes) => {
  for (const { target, isIntersecting } of changes) {
    if (isIntersecting) entries.get(target.id)?.setAttribute("aria-current", "true");
    else entries.get(target.id)?.removeAttribute("aria-current");
  }
}, { rootMargin: "-20% 0px -75% 0px" });
for (const id of entries.keys()) seen.observe(document.getElementById(id));
