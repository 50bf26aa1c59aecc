// On a telephone, site.css shows a table with four or more columns and long rows as a list, with the head of each column.
"use strict";
document.addEventListener("DOMContentLoaded", () => {
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
