// What every page has: finding elements, saying what went wrong, unpacking its data, light and dark.

const $ = (id) => document.getElementById(id), root = document.documentElement;
const DEGREE = Math.PI / 180;

function fail(message) {
  $("error").textContent = `This page can't show the ${root.dataset.shows}: ${message}`;
  $("error").hidden = false;
  root.dataset.state = "error";
}

// Says for a while, or until "" is said, what the reader should know.
function warn(message) {
  $("error").textContent = message;
  $("error").hidden = !message;
}
window.addEventListener("error", (event) => fail(event.message));
window.addEventListener("unhandledrejection", (event) => fail(event.reason && event.reason.message || event.reason));

// The page is drawn: tests and pictures of the page wait for this.
function ready() {
  if (root.dataset.state === "loading") requestAnimationFrame(() => { root.dataset.state = "ready"; });
}

async function unpacked(text, bytes) {
  if (!window.DecompressionStream) throw new Error("this browser is older than May 2023; open the page in a newer one");
  const letters = atob(text.trim()), packed = new Uint8Array(letters.length);
  for (let i = 0; i < packed.length; i++) packed[i] = letters.charCodeAt(i);  // `Uint8Array.from` takes 20 times as long
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate"));
  const whole = new Uint8Array(await new Response(stream).arrayBuffer());
  if (whole.length !== bytes) throw new Error(`the page is damaged: ${whole.length} bytes of data, expected ${bytes}`);
  return whole;
}

// Frames are stored as differences to the frame before, modulo the type's range; typed arrays wrap by themselves.
function summed(values, frame) {
  for (let i = frame; i < values.length; i++) values[i] += values[i - frame];
  return values;
}

// An element with text, which is never read as HTML, and optional attributes.
function made(tag, text = "", attributes = {}) {
  const element = document.createElement(tag);
  element.textContent = text;
  for (const [name, value] of Object.entries(attributes)) element.setAttribute(name, value);
  return element;
}

const many = (count, word) => `${count.toLocaleString("en")} ${word}${count === 1 ? "" : "s"}`;
const mixed = (one, two, share) => one.map((value, k) => value + share * (two[k] - value));

// The color at 0..1 of evenly spaced stops.
function ramped(stops, value) {
  const place = Math.min(Math.max(value, 0), 1) * (stops.length - 1), k = Math.min(Math.floor(place), stops.length - 2);
  return mixed(stops[k], stops[k + 1], place - k);
}

// Values after # in the address, such as #frame=3&color=part.
const addressed = () => new URLSearchParams(location.hash.slice(1));

// Light or dark as the system is, until the reader chooses; `changed` is called after each change.
function followTheme(changed) {
  const system = matchMedia("(prefers-color-scheme: dark)");
  let chosen = addressed().get("theme");
  const show = () => { root.toggleAttribute("data-dark", chosen ? chosen === "dark" : system.matches); changed(); };
  system.addEventListener("change", show);
  show();
  return () => { chosen = root.hasAttribute("data-dark") ? "light" : "dark"; show(); };
}

// Keys do what `table` says whatever has the focus ("Shift+ArrowUp" with shift); only fields of text keep theirs, sliders and menus their arrows, boxes their space.
function listenToKeys(table) {
  window.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    if (keepsKey(event.target, event.key)) return;
    const does = table()[(event.shiftKey && event.key.startsWith("Arrow") ? "Shift+" : "") + event.key];
    if (does) { event.preventDefault(); does(); }
  });
  window.addEventListener("keyup", (event) => {  // Firefox presses a button when its space is let go
    if (event.key === " " && event.target.tagName === "BUTTON" && table()[" "]) event.preventDefault();
  });
}

function keepsKey({ tagName, type, isContentEditable }, key) {
  if (type === "range" || tagName === "SELECT") return key.startsWith("Arrow");
  if (type === "checkbox") return key === " ";
  return ["INPUT", "TEXTAREA"].includes(tagName) || isContentEditable;
}

function tableOf(rows) {
  const table = made("table");
  for (const [name, value] of rows) {
    const row = made("tr");
    row.append(made("th", name, { scope: "row" }), made("td", value));
    table.append(row);
  }
  return table;
}

// The panel about the file: keys [key, what it does], facts, the commands that made it; `?` and the button open and close it.
function fillAbout(header, keys) {
  const panel = $("about"), close = made("button", "close", { class: "close" });
  close.onclick = () => { panel.hidden = true; };
  panel.append(close, made("h2", "Keys"), tableOf([...keys, ["b", "light or dark"], ["?", "this panel"]]), made("h2", "This file"), tableOf(header.facts));
  if (header.history.length) panel.append(made("h2", "Commands that made it"));
  for (const entry of header.history) panel.append(made("code", entry.command));
  $("open-about").onclick = () => { panel.hidden = !panel.hidden; };
}

function fillHead(header) {
  $("title").textContent = header.title;
  $("subtitle").textContent = header.subtitle;
  $("note").textContent = header.notes.join(" ");
  $("note").hidden = !header.notes.length;
}
