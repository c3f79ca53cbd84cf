// The page: state, camera, controls. The part after # in the address sets the state, such as
// #time=0.5&color=part&azimuth=40&elevation=10&radius=2&background=black&play=0&panel=1&controls=0&renderer=2d
// (seconds, degrees).

const GROUNDS = { white: [255, 255, 255], gray: [118, 122, 130], black: [12, 14, 18] };

class App extends Stage {
  constructor(header, scene) {
    super($("canvas"), header.camera.fovy, scene.timeline);
    Object.assign(this, { header, scene, hidden: new Set() });
    Object.assign(this.state, { color: "appearance", background: "white", ...this.home() });
    this.painter = this.painterOf(this.canvas);
    this.fillHead();
    this.listen();
    this.readAddress();
    this.fitCanvas();
  }

  home() {
    const { azimuth, elevation, radius } = this.header.camera;
    return { azimuth, elevation, radius, target: [0, 0, 0] };
  }

  painterOf(canvas) {
    if (!/renderer=2d/.test(location.hash)) {
      try { return new GlPainter(canvas, this.scene.count, () => this.wake()); } catch (error) {
        if (error.message !== "no WebGL 2") throw error;
      }
    }
    root.dataset.renderer = "2d";
    return new CanvasPainter(canvas);
  }

  readAddress() {
    const given = addressed(), values = super.readAddress();
    if (GROUNDS[given.get("background")]) values.background = given.get("background");
    if (["appearance", "part", "rigid"].includes(given.get("color"))) values.color = given.get("color");
    if (given.has("panel")) $("panel").hidden = given.get("panel") !== "1";
    this.change(values);
  }

  fillHead() {
    const { header } = this;
    const parts = header.parts.filter((part) => part.id >= 0).length;
    $("title").textContent = header.title;
    $("subtitle").textContent = [many(header.count, "Gaussian"), many(header.frames, "frame"), many(parts, "part")].join(" · ");
    $("bar").hidden = header.frames < 2;
    this.fillPanel();
  }

  fillPanel() {
    const { header } = this, panel = $("panel");
    const rows = Object.entries({ ...header.metrics, "control points": header.control_points, "made by": `dpc ${header.version}` });
    const add = (tag, text, into = panel) => { const element = made(tag, text); into.append(element); return element; };
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
    add("p", "space plays · ← → step · 1 2 3 color · b background · + − zoom · r resets · i this panel. Drag turns, wheel or pinch zooms, shift-drag or two fingers move.");
  }

  change(values) {
    const state = Object.assign(this.state, values);
    root.toggleAttribute("data-dark", state.background !== "white");
    for (const button of document.querySelectorAll("[data-color]")) button.setAttribute("aria-pressed", button.dataset.color === state.color);
    if (this.legendOf !== state.color) this.fillLegend(state.color);
    super.change({});
  }

  fillLegend(color) {
    const legend = $("legend"), { parts, weights } = this.header;
    this.legendOf = color;
    legend.hidden = color === "appearance";
    legend.replaceChildren();
    if (color === "rigid") {
      const ramp = made("div", "", { id: "ramp" }), ends = made("div", "", { id: "ends" });
      ramp.style.background = `linear-gradient(90deg, ${weights.map((rgb) => `rgb(${rgb})`)})`;
      ends.innerHTML = "<b>free</b><b>with its part</b>";
      legend.append(ramp, ends);
    }
    if (color === "part") for (const part of parts) legend.append(this.partButton(part));
  }

  partButton(part) {
    const button = made("button"), mark = made("i"), count = made("span", part.count.toLocaleString("en"));
    mark.style.background = `rgb(${part.color})`;
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

  draw() {
    const { state, scene, camera } = this;
    scene.moveTo(state.time);
    this.painter.draw(scene, scene.sorted(camera.forward, this.hidden), scene.colors(state.color), camera, GROUNDS[state.background]);
  }

  listen() {
    this.listenToCanvas();
    this.listenToBar();
    $("ground").onclick = () => this.nextGround();
    $("home").onclick = () => this.goHome();
    $("about").onclick = () => { $("panel").hidden = !$("panel").hidden; };
    for (const button of document.querySelectorAll("[data-color]")) button.onclick = () => this.change({ color: button.dataset.color });
    window.addEventListener("hashchange", () => this.readAddress());
    listenToKeys(() => ({
      " ": () => this.toggle(), ArrowLeft: () => this.step(-1), ArrowRight: () => this.step(1),
      1: () => this.change({ color: "appearance" }), 2: () => this.change({ color: "part" }), 3: () => this.change({ color: "rigid" }),
      b: () => this.nextGround(), r: () => this.goHome(), i: () => $("about").click(),
      "+": () => this.zoom(0.9), "=": () => this.zoom(0.9), "-": () => this.zoom(1 / 0.9),
    }));
  }

  nextGround() {
    const names = Object.keys(GROUNDS);
    this.change({ background: names[(names.indexOf(this.state.background) + 1) % names.length] });
  }
}

(async () => {
  const header = JSON.parse($("header").textContent);
  const scene = new Scene(header, await unpacked($("data").textContent, header.bytes));
  $("data").remove();
  window.app = new App(header, scene);
})();
