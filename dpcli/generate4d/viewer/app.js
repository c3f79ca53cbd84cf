// The page: state, camera, controls. The part after # in the address sets the state, such as
// #time=0.5&colour=part&azimuth=40&elevation=10&radius=2&background=black&play=0&panel=1&controls=0&renderer=2d
// (seconds, degrees).

const $ = (id) => document.getElementById(id), root = document.documentElement;
const GROUNDS = { white: [255, 255, 255], grey: [118, 122, 130], black: [12, 14, 18] };
const DEGREE = Math.PI / 180;

function fail(message) {
  $("error").textContent = `This page can't show the scene: ${message}`;
  $("error").hidden = false;
  root.dataset.state = "error";
}
window.addEventListener("error", (event) => fail(event.message));
window.addEventListener("unhandledrejection", (event) => fail(event.reason && event.reason.message || event.reason));

// Right-handed world, y up; azimuth 0 looks from +z, positive towards +x. Camera axes: x right, y down, z forward.
function cameraOf(state, fovy, canvas) {
  const { azimuth: a, elevation: e, radius, target } = state;
  const forward = [-Math.cos(e) * Math.sin(a), -Math.sin(e), -Math.cos(e) * Math.cos(a)], right = [Math.cos(a), 0, -Math.sin(a)];
  const down = [forward[1] * right[2] - forward[2] * right[1], forward[2] * right[0] - forward[0] * right[2],
                forward[0] * right[1] - forward[1] * right[0]];
  const rotation = [...right, ...down, ...forward], { width, height } = canvas;
  const shift = [0, 1, 2].map((k) => -(rotation[3 * k] * target[0] + rotation[3 * k + 1] * target[1] + rotation[3 * k + 2] * target[2]));
  shift[2] += radius;
  return { rotation, shift, forward, right, down, width, height, focal: 0.5 * Math.min(width, height) / Math.tan(fovy / 2) };
}

class App {
  constructor(header, scene) {
    const canvas = $("canvas");
    this.scene = scene; this.header = header; this.canvas = canvas;
    this.hidden = new Set();
    this.state = { time: scene.start, play: scene.frames > 1 && !matchMedia("(prefers-reduced-motion: reduce)").matches,
                   colour: "appearance", background: "white", speed: 1, ...this.home() };
    this.painter = this.painterOf(canvas);
    this.fillHead();
    this.listen();
    this.readAddress();
    new ResizeObserver(() => this.resize()).observe(canvas);
    this.resize();
  }

  home() {
    const { azimuth, elevation, radius } = this.header.camera;
    return { azimuth, elevation, radius, target: [0, 0, 0] };
  }

  painterOf(canvas) {
    if (!/renderer=2d/.test(location.hash)) {
      try { return new GlPainter(canvas, this.scene.count); } catch (error) {
        if (error.message !== "no WebGL 2") throw error;
      }
    }
    root.dataset.renderer = "2d";
    return new CanvasPainter(canvas);
  }

  readAddress() {
    const given = new URLSearchParams(location.hash.slice(1)), state = this.state, number = (key) => Number(given.get(key));
    if (given.has("time")) { state.time = number("time"); state.play = false; }
    if (given.has("play")) state.play = given.get("play") === "1";
    if (given.has("radius") && number("radius") > 0) state.radius = number("radius");
    for (const key of ["azimuth", "elevation"]) if (given.has(key)) state[key] = number(key) * DEGREE;
    if (GROUNDS[given.get("background")]) state.background = given.get("background");
    if (["appearance", "part", "rigid"].includes(given.get("colour"))) state.colour = given.get("colour");
    if (given.has("panel")) $("panel").hidden = given.get("panel") !== "1";
    root.toggleAttribute("data-bare", given.get("controls") === "0");
    this.change({});
  }

  fillHead() {
    const { header } = this, many = (count, word) => `${count.toLocaleString("en")} ${word}${count === 1 ? "" : "s"}`;
    const parts = header.parts.filter((part) => part.id >= 0).length;
    $("title").textContent = header.title;
    $("subtitle").textContent = [many(header.count, "Gaussian"), many(header.frames, "frame"), many(parts, "part")].join(" · ");
    $("slider").min = this.scene.start;
    $("slider").max = this.scene.start + this.scene.length;
    $("bar").hidden = header.frames < 2;
    this.fillPanel();
  }

  fillPanel() {
    const { header } = this, panel = $("panel");
    const rows = Object.entries({ ...header.metrics, "control points": header.control_points, "made by": `dpc ${header.version}` });
    const add = (tag, text, into = panel) => { const made = document.createElement(tag); made.textContent = text; into.append(made); return made; };
    add("h2", "Measured");
    const table = add("table", "");
    for (const [name, value] of rows) {
      const row = add("tr", "", table);
      add("td", name.replaceAll("_", " "), row);
      add("td", typeof value === "object" ? JSON.stringify(value) : value, row);
    }
    add("h2", "Commands");
    for (const entry of header.history) add("code", entry.command);
    add("h2", "Keys");
    add("p", "space plays · ← → step · 1 2 3 colour · b background · + − zoom · r resets · i this panel. Drag turns, wheel or pinch zooms, shift-drag or two fingers move.");
  }

  change(values) {
    const state = Object.assign(this.state, values), end = this.scene.start + this.scene.length;
    state.time = Math.min(Math.max(state.time || 0, this.scene.start), end + this.header.tail);
    state.elevation = Math.min(Math.max(state.elevation, -89.9 * DEGREE), 89.9 * DEGREE);
    state.radius = Math.min(Math.max(state.radius, 0.05), 100);
    root.toggleAttribute("data-dark", state.background !== "white");
    for (const button of document.querySelectorAll("[data-colour]")) button.setAttribute("aria-pressed", button.dataset.colour === state.colour);
    $("play").textContent = state.play ? "❚❚" : "▶";
    $("slider").value = Math.min(state.time, end);
    $("clock").textContent = `${Math.min(state.time, end).toFixed(2)} / ${end.toFixed(2)} s`;
    if (this.legendOf !== state.colour) this.fillLegend(state.colour);
    this.wake();
  }

  fillLegend(colour) {
    const legend = $("legend"), { parts, weights } = this.header;
    this.legendOf = colour;
    legend.hidden = colour === "appearance";
    legend.replaceChildren();
    if (colour === "rigid") {
      const ramp = Object.assign(document.createElement("div"), { id: "ramp" }), ends = Object.assign(document.createElement("div"), { id: "ends" });
      ramp.style.background = `linear-gradient(90deg, ${weights.map((rgb) => `rgb(${rgb})`)})`;
      ends.innerHTML = "<b>free</b><b>with its part</b>";
      legend.append(ramp, ends);
    }
    if (colour === "part") for (const part of parts) legend.append(this.partButton(part));
  }

  partButton(part) {
    const button = document.createElement("button"), mark = document.createElement("i"), count = document.createElement("span");
    mark.style.background = `rgb(${part.colour})`;
    count.textContent = part.count.toLocaleString("en");
    button.append(mark, part.id < 0 ? "none" : `part ${part.id}`, count);
    button.setAttribute("aria-pressed", !this.hidden.has(part.id + 1));
    button.title = "show or hide";
    button.onclick = () => {
      if (!this.hidden.delete(part.id + 1)) this.hidden.add(part.id + 1);
      button.setAttribute("aria-pressed", !this.hidden.has(part.id + 1));
      this.wake();
    };
    return button;
  }

  resize() {
    const { canvas } = this, ratio = Math.min(window.devicePixelRatio || 1, 2);
    canvas.width = Math.max(1, Math.round(canvas.clientWidth * ratio));
    canvas.height = Math.max(1, Math.round(canvas.clientHeight * ratio));
    this.wake();
  }

  wake() {
    if (this.awake) return;
    this.awake = true;
    requestAnimationFrame((now) => this.frame(now));
  }

  frame(now) {
    this.awake = false;
    const { state, scene } = this;
    if (state.play) {
      const period = scene.length + this.header.tail, passed = Math.min((now - (this.last ?? now)) / 1000, 0.25);
      const time = scene.start + ((state.time - scene.start + passed * state.speed * this.header.rate) % period);
      this.last = now;
      this.change({ time });
    } else this.last = null;
    const camera = cameraOf(state, this.header.camera.fovy, this.canvas);
    scene.moveTo(state.time);
    this.painter.draw(scene, scene.sorted(camera.forward, this.hidden), scene.colours(state.colour), camera, GROUNDS[state.background]);
    if (root.dataset.state !== "ready") requestAnimationFrame(() => { root.dataset.state = "ready"; });  // once it is on the screen
  }

  // Drag with one pointer turns; with shift, another button or two pointers it moves; two pointers also zoom.
  listen() {
    const { canvas } = this, pointers = new Map();
    canvas.addEventListener("pointerdown", (event) => {
      canvas.setPointerCapture(event.pointerId);
      canvas.classList.add("moving");
      pointers.set(event.pointerId, [event.clientX, event.clientY]);
    });
    canvas.addEventListener("pointermove", (event) => {
      const before = pointers.get(event.pointerId);
      if (!before) return;
      const now = [event.clientX, event.clientY], dx = now[0] - before[0], dy = now[1] - before[1];
      if (pointers.size === 2) {
        const other = [...pointers].find(([id]) => id !== event.pointerId)[1], span = (p) => Math.hypot(p[0] - other[0], p[1] - other[1]);
        this.change({ radius: this.state.radius * span(before) / Math.max(span(now), 1) });
        this.pan(dx / 2, dy / 2);
      } else if (event.shiftKey || event.buttons > 1) this.pan(dx, dy);
      else this.change({ azimuth: this.state.azimuth - dx * 0.008, elevation: this.state.elevation + dy * 0.008 });
      pointers.set(event.pointerId, now);
    });
    for (const name of ["pointerup", "pointercancel"]) canvas.addEventListener(name, (event) => {
      pointers.delete(event.pointerId);
      canvas.classList.toggle("moving", pointers.size > 0);
    });
    canvas.addEventListener("wheel", (event) => { event.preventDefault(); this.zoom(Math.exp(event.deltaY * 0.001)); }, { passive: false });
    canvas.addEventListener("dblclick", () => this.change(this.home()));
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
    $("slider").oninput = () => this.change({ time: Number($("slider").value), play: false });
    $("play").onclick = () => this.toggle();
    $("speed").onchange = () => this.change({ speed: Number($("speed").value) });
    $("ground").onclick = () => this.nextGround();
    $("home").onclick = () => this.change(this.home());
    $("about").onclick = () => { $("panel").hidden = !$("panel").hidden; };
    for (const button of document.querySelectorAll("[data-colour]")) button.onclick = () => this.change({ colour: button.dataset.colour });
    window.addEventListener("hashchange", () => this.readAddress());
    window.addEventListener("keydown", (event) => this.key(event));
  }

  zoom(factor) { this.change({ radius: this.state.radius * factor }); }
  toggle() { this.change({ play: !this.state.play && this.scene.frames > 1 }); }
  nextGround() {
    const names = Object.keys(GROUNDS);
    this.change({ background: names[(names.indexOf(this.state.background) + 1) % names.length] });
  }

  pan(dx, dy) {
    const camera = cameraOf(this.state, this.header.camera.fovy, this.canvas);
    const step = this.state.radius / camera.focal * this.canvas.width / this.canvas.clientWidth;
    this.change({ target: this.state.target.map((value, k) => value - step * (dx * camera.right[k] + dy * camera.down[k])) });
  }

  step(direction) {
    const { time } = this.scene, [a, , w] = this.scene.between(this.state.time);
    const next = direction > 0 ? a + 1 : w > 1e-6 ? a : a - 1;
    this.change({ time: time[(next + time.length) % time.length], play: false });
  }

  key(event) {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    if (["INPUT", "SELECT"].includes(event.target.tagName) || (event.target.tagName === "BUTTON" && event.key === " ")) return;
    const does = {
      " ": () => this.toggle(), ArrowLeft: () => this.step(-1), ArrowRight: () => this.step(1),
      1: () => this.change({ colour: "appearance" }), 2: () => this.change({ colour: "part" }), 3: () => this.change({ colour: "rigid" }),
      b: () => this.nextGround(), r: () => this.change(this.home()), i: () => $("about").click(),
      "+": () => this.zoom(0.9), "=": () => this.zoom(0.9), "-": () => this.zoom(1 / 0.9),
    }[event.key];
    if (does) { event.preventDefault(); does(); }
  }
}

(async () => {
  const header = JSON.parse($("header").textContent);
  const scene = new Scene(header, await unpacked($("data").textContent, header.bytes));
  $("data").remove();
  window.app = new App(header, scene);
})();
