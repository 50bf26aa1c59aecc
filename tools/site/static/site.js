// On a telephone, site.css shows a table with four or more columns and long rows as a list, with the head of each column.
"use strict";
// Code in a line breaks after a dot, a slash or an underscore; an option such as --connection stays whole.
const breakable = (code) => {
  const parts = code.textContent.split(/(--[\w-]+|[._/](?=\w))/);
  code.replaceChildren(...parts.flatMap((part) => {
    if (part.startsWith("--")) return [Object.assign(document.createElement("span"), { className: "option", textContent: part })];
    return /^[._/]$/.test(part) ? [part, document.createElement("wbr")] : [part];
  }));
};

document.addEventListener("DOMContentLoaded", () => {
  for (const code of document.querySelectorAll("article :not(pre) > code"))
    if (![...code.querySelectorAll("*")].some((part) => !part.matches("span.pre"))) breakable(code);
  for (const table of document.querySelectorAll("article table")) {
    const heads = [...table.querySelectorAll("thead th")].map((head) => head.textContent);
    const longest = Math.max(...[...table.rows].map((row) => row.textContent.length));
    if (heads.length < 4 || longest < 90) continue;
    table.classList.add("stacked");
    for (const row of table.querySelectorAll("tbody tr"))
      [...row.cells].forEach((cell, i) => {
        cell.dataset.label = heads[i];
        cell.classList.toggle("empty", !cell.textContent.trim());
      });
  }
});
