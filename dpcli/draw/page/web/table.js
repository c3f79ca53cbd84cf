// The page of scores: sorting, searching, and the best classes of a sample.
// #sort=probability&down=1&which=wrong&search=wave&theme=dark sets its state.

const KEYS = [
  ["/", "search"],
  ["a w g", "all, wrong or right samples"],
  ["click", "a column sorts; a row shows its best classes, as Enter does"],
];

const LONG = 40;  // letters of a name, from which on it has several lines

class ScoresPage {
  constructor(header) {
    Object.assign(this, { header, sort: null, down: false, which: "all", search: "" });
    const { classes } = header, named = (at) => (at < 0 ? "" : classes[at]);
    this.rows = header.rows.map((row, place) => {
      const [[predicted, score]] = row.best, known = row.label >= 0;
      return { ...row, place, predicted, score, right: known ? predicted === row.label : null, words: `${row.name} ${named(row.label)} ${named(predicted)}`.toLowerCase() };
    });
    this.columns = this.columnsOf(named);
  }

  // Of each column its title, what a row is sorted by, and what its cell shows.
  columnsOf(named) {
    const { header } = this, labeled = this.rows.some((row) => row.label >= 0), split = this.rows.some((row) => row.split);
    const text = (value) => made("td", value, value.length > LONG ? { class: "long" } : {}), word = header.probabilities ? "probability" : "score";
    const verdict = (right) => made("td", right === null ? "–" : right ? "right" : "wrong", { class: right === null ? "" : right ? "right" : "wrong" });
    const streams = header.streams.map((stream, k) => ({
      title: stream, key: (row) => named(row.streams[k][0]),
      cell: (row) => this.scored(named(row.streams[k][0]), row.streams[k][1], row.label >= 0 && row.streams[k][0] !== row.label),
    }));
    return [
      { title: "name", key: (row) => row.name, cell: (row) => text(row.name) },
      split && { title: "split", key: (row) => row.split, cell: (row) => text(row.split) },
      labeled && { title: "label", key: (row) => named(row.label), cell: (row) => text(named(row.label) || "–") },
      { title: "predicted", key: (row) => named(row.predicted), cell: (row) => text(named(row.predicted)) },
      { title: word, key: (row) => row.score, cell: (row) => this.bar(row.score) },
      labeled && { title: "verdict", key: (row) => (row.right === null ? 2 : Number(row.right)), cell: (row) => verdict(row.right) },
      ...streams,
    ].filter(Boolean);
  }

  shown(score) { return this.header.probabilities ? `${(100 * score).toFixed(1)} %` : score.toPrecision(4); }

  bar(score) {
    const cell = made("td", "", { class: "number" }), bar = made("i");
    if (this.header.probabilities) { bar.style.width = `${Math.round(64 * score)}px`; cell.append(made("span")); cell.firstChild.append(bar); }
    cell.append(this.shown(score));
    return cell;
  }

  scored(name, score, wrong) {
    const cell = made("td", name, { class: `${wrong ? "wrong" : ""} ${name.length > LONG ? "long" : ""}`.trim() });
    cell.append(made("small", this.shown(score)));
    return cell;
  }

  start() {
    const { header } = this;
    fillHead(header);
    fillAbout(header, KEYS);
    const toggleTheme = followTheme(() => {});
    $("theme").onclick = toggleTheme;
    for (const [stream, [right, known]] of Object.entries(header.tally)) if (known) $("tally").append(this.tile(stream, right, known));
    for (const column of this.columns) {
      const head = made("th", "", { scope: "col" }), button = made("button", column.title);
      button.onclick = () => this.sortBy(column.title, this.sort === column.title ? !this.down : column.title === this.columns.find((one) => one.title === "probability" || one.title === "score").title);
      head.append(button);
      $("columns").append(head);
    }
    $("which").hidden = !this.rows.some((row) => row.right !== null);
    for (const button of document.querySelectorAll("[data-which]")) button.onclick = () => this.change({ which: button.dataset.which });
    $("search").oninput = () => this.change({ search: $("search").value.toLowerCase() });
    listenToKeys(() => ({
      "/": () => $("search").focus(), a: () => this.change({ which: "all" }), w: () => this.change({ which: "wrong" }), g: () => this.change({ which: "right" }),
      b: toggleTheme, "?": () => $("open-about").click(), Escape: () => { $("about").hidden = true; },
    }));
    window.addEventListener("hashchange", () => this.readAddress());
    this.readAddress();
    ready();
  }

  readAddress() {
    const given = addressed();
    $("search").value = given.get("search") ?? this.search;
    this.change({ sort: given.get("sort") ?? this.sort, down: given.get("down") === "1", which: given.get("which") ?? this.which, search: $("search").value.toLowerCase() });
  }

  tile(stream, right, known) {
    const tile = made("div", "", { class: "tile" });
    tile.append(made("b", `${(100 * right / known).toFixed(1)} %`), made("span", `${stream ? `${stream}: ` : ""}${right.toLocaleString("en")} of ${known.toLocaleString("en")} right`));
    return tile;
  }

  sortBy(sort, down) { this.change({ sort, down }); }

  change(values) {
    Object.assign(this, values);
    const column = this.columns.find((one) => one.title === this.sort), sign = this.down ? -1 : 1;
    const kept = this.rows.filter((row) => (this.which === "all" || row.right === (this.which === "right")) && row.words.includes(this.search));
    const compared = (a, b) => (typeof a === "number" ? a - b : a.localeCompare(b, "en", { numeric: true }));
    if (column) kept.sort((a, b) => sign * compared(column.key(a), column.key(b)) || a.place - b.place);
    for (const [k, head] of [...$("columns").children].entries()) head.setAttribute("aria-sort", this.columns[k] !== column ? "none" : this.down ? "descending" : "ascending");
    for (const button of document.querySelectorAll("[data-which]")) button.setAttribute("aria-pressed", button.dataset.which === this.which);
    $("count").textContent = `${many(kept.length, "sample")}${kept.length < this.rows.length ? ` of ${this.rows.length.toLocaleString("en")}` : ""}`;
    $("rows").replaceChildren(...kept.map((row) => this.line(row)));
  }

  line(row) {
    const line = made("tr", "", { tabindex: 0, "aria-expanded": false });
    line.append(...this.columns.map((column) => column.cell(row)));
    line.onclick = () => this.open(line, row);
    line.onkeydown = (event) => { if (event.key === "Enter") this.open(line, row); };
    return line;
  }

  // The best classes of a sample, below its line.
  open(line, row) {
    const wasOpen = line.getAttribute("aria-expanded") === "true";
    line.setAttribute("aria-expanded", !wasOpen);
    if (wasOpen) return line.nextElementSibling.remove();
    const more = made("tr", "", { class: "more" }), cell = made("td", "", { colspan: this.columns.length }), list = made("ol");
    for (const [at, score] of row.best) {
      const item = made("li", "", { class: at === row.label ? "right" : "" }), value = made("span", "", { class: "number" });
      value.append(...this.bar(score).childNodes);
      item.append(value, made("b", this.header.classes[at]));
      list.append(item);
    }
    cell.append(list);
    more.append(cell);
    line.after(more);
  }
}

window.page = new ScoresPage(JSON.parse($("header").textContent));
window.page.start();
