// The search page: every section whose text has words of the query, best first, with the lines that have them.
// The file replaces Sphinx's own of this name; searchindex.js (tools/site/search_index.py) calls setIndex.
"use strict";

const COMMON = new Set(
  "a an and are as at by can do does for from mean means how i in is it its my of on or s the there this to use what when which with".split(" "),
);
const FOR_DEVELOPERS = /^(extending|architecture|mission_phases|reference)\.html/;  // rank a little lower
const wordsIn = (text) => text.toLowerCase().match(/[\p{L}\p{N}_]+/gu) || [];
const withParts = (words) => words.flatMap((word) => (word.includes("_") ? [word, ...word.split("_")] : [word]));
const stem = (word) => (word.length > 4 && !word.includes("_") ? word.replace(/(ing|ed|es|s|e)$/, "") : word);

const Search = {
  setIndex(sections) {
    this.sections = sections.map(([address, page, title, lines]) => ({
      address, page, title, lines,
      head: wordsIn(title === page ? title : `${title} ${page}`),
      body: withParts(wordsIn(`${address.split("#")[0].replace(/\.html$|\//g, " ")} ${lines.join(" ")}`)),
    }));
    const input = document.querySelector(".sidebar-search");
    input.value = new URLSearchParams(location.search).get("q") || "";
    input.addEventListener("input", () => this.show(input.value));
    this.show(input.value);
  },

  // Sort by the number of words that a section has, then by how rare the words are and how often they occur.
  find(query) {
    const isThere = (word) => this.sections.some(({ head, body }) => head.includes(word) || body.includes(word));
    const parts = wordsIn(query).flatMap((word) => (isThere(word) ? [word] : word.split("_")));
    const wanted = [...new Set(parts.filter((word) => word && !COMMON.has(word)).map(stem))];
    const counts = this.sections.map(({ head, body }) =>
      wanted.map((word) => {
        const among = (text) => text.reduce((sum, other) =>
          sum + (other.startsWith(word) ? (stem(other) === word ? 1 : 0.4) : 0), 0);
        return 4 * Math.min(among(head), 1) + Math.min(among(body), 6);
      }));
    const rarity = wanted.map((_, i) =>
      Math.log((counts.length + 1) / (counts.filter((count) => count[i]).length + 1)));
    return this.sections
      .map((section, n) => ({
        section, wanted,
        score: (FOR_DEVELOPERS.test(section.address) ? 0.8 : 1) * counts[n].reduce((sum, count, i) => sum + rarity[i] * (count && 3 + Math.log2(1 + count)), 0),
      }))
      .filter(({ score }) => score)
      .sort((a, b) => b.score - a.score);
  },

  show(query) {
    const results = this.find(query).slice(0, 30);
    const list = document.createElement("ul");
    list.className = "search";
    list.append(...results.map(({ section, wanted }) => this.item(section, wanted)));
    const heading = document.createElement("h1");
    heading.textContent = "Search";
    const status = document.createElement("p");
    status.textContent = !query.trim() ? "Type words into the search box."
      : results.length ? "" : "No section has these words. Try another word for it, or the list of tasks on the first page.";
    document.getElementById("search-results").replaceChildren(heading, status, list);
  },

  item({ address, page, title, lines }, wanted) {
    const item = document.createElement("li");
    const link = item.appendChild(document.createElement("a"));
    link.href = address;
    link.textContent = title === page ? page : `${page}: ${title}`;
    const has = (line) => new Set(wordsIn(line).flatMap((word) => wanted.filter((start) => word.startsWith(start)))).size;
    const best = lines.map((line, place) => ({ line, place, score: has(line) }))
      .filter(({ score }) => score)
      .sort((a, b) => b.score - a.score || a.place - b.place)
      .slice(0, 2);
    // The browser scrolls to the line itself, such as a row of a long table, if it can.
    const start = best.length ? best[0].line.split(" | ")[0].slice(0, 80).replace(/\s\S*$/, "") : "";
    if (start) link.href = `${address}:~:text=${encodeURIComponent(start).replaceAll("-", "%2D")}`;
    for (const { line } of best) item.appendChild(this.excerpt(line, wanted));
    return item;
  },

  excerpt(line, wanted) {
    const text = document.createElement("p");
    const first = Math.min(...wanted.map((start) => line.toLowerCase().indexOf(start)).filter((place) => place >= 0));
    const begin = line.length > 300 && first > 100 ? line.lastIndexOf(" ", first - 80) + 1 : 0;
    const end = begin + 300;
    if (begin) text.append("… ");
    for (const part of line.slice(begin, end).split(/([\p{L}\p{N}_]+)/u)) {
      const isFound = wanted.some((start) => part.toLowerCase().startsWith(start));
      text.append(isFound ? Object.assign(document.createElement("mark"), { textContent: part }) : part);
    }
    if (end < line.length) text.append(" …");
    return text;
  },
};
