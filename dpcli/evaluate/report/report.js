"use strict";
const one = (where, what) => where.querySelector(what);
const all = (where, what) => [...where.querySelectorAll(what)];

// Sorting: by the number a cell carries, else by its text; missing ones stay last in both directions.
function compare(a, b, sign) {
  const [x, y] = [a, b].map((cell) => ({ text: cell.textContent.trim(), number: cell.dataset.sort }));
  const missing = [x, y].map((own) => own.number === undefined && (own.text === "-" || own.text === ""));
  if (missing[0] || missing[1]) return missing[0] - missing[1];
  if (x.number !== undefined && y.number !== undefined) return sign * (Number(x.number) - Number(y.number));
  return sign * x.text.localeCompare(y.text, "en", { numeric: true });
}

function sortBy(table, column, direction) {
  const heads = all(table, "thead th"), body = one(table, "tbody");
  const rows = all(body, "tr");
  rows.forEach((row, place) => { row.dataset.place ??= place; });
  const sign = direction === "descending" ? -1 : 1;
  rows.sort((a, b) => compare(a.cells[column], b.cells[column], sign) || a.dataset.place - b.dataset.place);
  heads.forEach((head, place) => head.setAttribute("aria-sort", place === column ? direction : "none"));
  body.append(...rows);
}

function makeSortable(table) {
  all(table, "thead th").forEach((head, column) => {
    const button = document.createElement("button");
    button.type = "button";
    button.textContent = head.textContent;
    head.replaceChildren(button);
    head.setAttribute("aria-sort", "none");
    const first = all(table, "tbody tr").some((row) => row.cells[column]?.dataset.sort !== undefined) && column ? "descending" : "ascending";
    const other = { ascending: "descending", descending: "ascending" };
    button.addEventListener("click", () => sortBy(table, column, other[head.getAttribute("aria-sort")] ?? first));
  });
}

// Confusion matrix: words for the cell under the pointer or in focus; arrow keys move.
function makeGrid(table) {
  const says = table.closest(".wide").nextElementSibling, columns = all(table, "thead th").slice(1).map((head) => head.title);
  const rows = all(table, "tbody tr");
  const totals = rows.map((row) => [...row.cells].slice(1).reduce((sum, cell) => sum + (Number(cell.textContent) || 0), 0));
  const cellOf = (event) => event.target.closest?.("td");
  const tell = (cell) => {
    const row = rows.indexOf(cell.parentElement), count = Number(cell.textContent) || 0, total = totals[row];
    const share = total ? ` (${(100 * count / total).toFixed(1)} %)` : "";
    says.textContent = `${one(rows[row], "th").textContent}: ${count} of ${total}${share} predicted as ${columns[cell.cellIndex - 1]}`;
  };
  const moves = { ArrowUp: [-1, 0], ArrowDown: [1, 0], ArrowLeft: [0, -1], ArrowRight: [0, 1] };
  table.addEventListener("pointerover", (event) => { if (cellOf(event)) tell(cellOf(event)); });
  table.addEventListener("focusin", (event) => { if (cellOf(event)) tell(cellOf(event)); });
  table.addEventListener("keydown", (event) => {
    const step = moves[event.key], cell = cellOf(event);
    if (!step || !cell) return;
    const next = rows[rows.indexOf(cell.parentElement) + step[0]]?.cells[cell.cellIndex + step[1]];
    if (next?.tagName === "TD") { cell.tabIndex = -1; next.tabIndex = 0; next.focus(); }
    event.preventDefault();
  });
  if (rows.length) rows[0].cells[1].tabIndex = 0;
}

// Error clouds: truth, prediction and error of one frame, turned together.
const PALETTE = "<!--PALETTE-->".split(" ");
const partColor = (id) => (id === 0 ? PALETTE[0] : PALETTE[1 + (id - 1) % (PALETTE.length - 1)]);
const errorColor = (share) => `${Math.round(150 + 63 * share)},${Math.round(158 - 110 * share)},${Math.round(170 - 150 * share)}`;

function unpack(figure) {
  const count = Number(figure.dataset.points), text = atob(figure.dataset.cloud);
  const bytes = Uint8Array.from(text, (letter) => letter.charCodeAt(0));
  if (bytes.length !== 9 * count) throw new Error("a cloud's data are damaged");
  const view = new DataView(bytes.buffer);
  const axis = (k) => Float32Array.from({ length: count }, (_, i) => view.getUint16(2 * (k * count + i), true) / 65535 - 0.5);
  return { count, xyz: [axis(0), axis(1), axis(2)], values: bytes.subarray(6 * count) };
}

function makeCloud(figure) {
  const cloud = unpack(figure), canvas = one(figure, "canvas"), pen = canvas.getContext("2d");
  const titles = ["truth", "prediction", "error"];
  let yaw = 0.6, pitch = -0.35, drag = null;
  const color = (panel, i) => {
    const value = cloud.values[panel * cloud.count + i];
    return panel < 2 ? partColor(value) : errorColor(value / 255);
  };
  function draw() {
    const ratio = devicePixelRatio || 1, width = canvas.clientWidth, height = canvas.clientHeight;
    if (!width) return;
    canvas.width = width * ratio;
    canvas.height = height * ratio;
    pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    const [cy, sy, cp, sp] = [Math.cos(yaw), Math.sin(yaw), Math.cos(pitch), Math.sin(pitch)], [x, y, z] = cloud.xyz;
    const placed = Array.from({ length: cloud.count }, (_, i) => {
      const right = cy * x[i] + sy * z[i], away = -sy * x[i] + cy * z[i];
      return [right, cp * y[i] - sp * away, sp * y[i] + cp * away, i];
    }).sort((a, b) => b[2] - a[2]);
    const side = Math.min(width / 3, height) * 0.84, size = Math.max(1.6, side / 90);
    for (let panel = 0; panel < 3; panel++) {
      const middle = width * (panel + 0.5) / 3;
      for (const [right, up, away, i] of placed) {
        pen.fillStyle = `rgba(${color(panel, i)},${0.95 - 0.45 * (away + 0.6)})`;
        pen.fillRect(middle + right * side - size / 2, height / 2 - up * side - size / 2 + 6, size, size);
      }
      pen.fillStyle = getComputedStyle(canvas).color;
      pen.font = "12px system-ui, sans-serif";
      pen.textAlign = "center";
      pen.fillText(titles[panel], middle, 16);
    }
  }
  canvas.addEventListener("pointerdown", (event) => { drag = [event.clientX, event.clientY]; canvas.setPointerCapture(event.pointerId); });
  canvas.addEventListener("pointermove", (event) => {
    if (!drag) return;
    yaw += (event.clientX - drag[0]) * 0.01;
    pitch += (event.clientY - drag[1]) * 0.01;
    drag = [event.clientX, event.clientY];
    draw();
  });
  for (const end of ["pointerup", "pointercancel"]) canvas.addEventListener(end, () => { drag = null; });
  canvas.addEventListener("keydown", (event) => {
    const turn = { ArrowLeft: [-0.15, 0], ArrowRight: [0.15, 0], ArrowUp: [0, -0.15], ArrowDown: [0, 0.15] }[event.key];
    if (event.key === "Home") [yaw, pitch] = [0.6, -0.35];
    else if (turn) { yaw += turn[0]; pitch += turn[1]; }
    else return;
    event.preventDefault();
    draw();
  });
  new ResizeObserver(draw).observe(canvas);
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", draw);
  draw();
}

// `#sort=KEY:COLUMN:descending` in the address opens the page with a table sorted.
function restore() {
  const state = new URLSearchParams(location.hash.slice(1)).get("sort");
  if (!state) return;
  const [key, column, direction] = state.split(":");
  const table = all(document, "table[data-key]").find((own) => own.dataset.key === key);
  if (table) sortBy(table, Number(column), direction === "descending" ? direction : "ascending");
}

function fail(message) {
  const box = one(document, "#error");
  box.textContent = `This page could not be drawn completely: ${message}`;
  box.hidden = false;
  document.documentElement.dataset.state = "error";
}

addEventListener("error", (event) => fail(event.message));
try {
  all(document, "table[data-key]").forEach(makeSortable);
  all(document, "table.grid").forEach(makeGrid);
  all(document, "figure.cloud").forEach(makeCloud);
  restore();
  addEventListener("hashchange", restore);
  addEventListener("beforeprint", () => all(document, "details").forEach((own) => { own.open = true; }));
  document.documentElement.dataset.state = "ready";
} catch (error) {
  fail(error.message);
}
