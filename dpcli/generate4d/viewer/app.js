// The page: state, camera, controls. The part after # in the address sets the state, such as
// #time=0.5&color=part&azimuth=40&elevation=10&radius=2&target=0,0.1,0&background=black&trails=1&turn=1&bounce=1&play=0&panel=1&controls=0&renderer=2d
// (seconds, degrees). `l` writes such an address.

const GROUNDS = { white: [255, 255, 255], gray: [118, 122, 130], black: [12, 14, 18] };
const COLORS = ["appearance", "part", "rigid", "depth"];
const FLAGS = ["trails", "turn", "bounce"];
const KEYS = [
  ["space", "play or stop"], ["← →", "one frame back, on"], ["1 2 3 4", "appearance, parts, rigid weight, depth"], ["t", "trajectories"],
  ["o", "the input picture"], ["a", "turn by itself"], ["p", "back and forth, or round and round"], ["b", "background"], ["+ −", "nearer, farther"],
  ["r", "the input's view"], ["f", "full screen"], ["l", "copy a link to this view"], ["s", "save a picture"], ["? i", "this panel"],
  ["drag, shift ← → ↑ ↓", "turn"], ["wheel, pinch", "zoom"], ["shift-drag, two fingers", "move"], ["double click, double tap", "turn around that point"],
];

class App extends Stage {
  constructor(header, scene) {
    super($("canvas"), header.camera.half, scene.timeline);
    Object.assign(this, { header, scene, hidden: new Set() });
    const { radius } = header.camera;  // of a scene in any unit, or seen through a long lens
    this.radii = [Math.min(this.radii[0], radius / 40), Math.max(this.radii[1], 50 * radius)];
    Object.assign(this.state, { color: "appearance", background: "white", turn: false, trails: false, input: true, ...this.home() });
    this.painter = this.painterOf(this.canvas);
    this.trails = new Trails($("trails"), scene);
    this.fillHead();
    this.listen();
    this.readAddress();
    this.fitCanvas();
  }

  get camera() { return { ...super.camera, near: this.header.camera.near }; }

  home() {
    const { azimuth, elevation, radius, target } = this.header.camera;
    return { azimuth, elevation, radius, target };
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
    if (COLORS.includes(given.get("color"))) values.color = given.get("color");
    for (const flag of FLAGS) if (given.has(flag)) values[flag] = given.get(flag) === "1";
    const target = (given.get("target") || "").split(",").map(Number);
    if (target.length === 3 && target.every(Number.isFinite)) values.target = target;
    if (given.has("panel")) $("panel").hidden = given.get("panel") !== "1";
    this.change(values);
  }

  // The address that shows what is shown now; `unit`: what 4 digits are enough for, where it is less than 1.
  get address() {
    const { state } = this, short = (value, unit = 1) => String(Number(value.toFixed(Math.min(4 + Math.max(0, Math.ceil(-Math.log10(unit))), 100))));
    const values = { time: short(state.time, 100 * this.timeline.tail), color: state.color, azimuth: short(state.azimuth / DEGREE),
      elevation: short(state.elevation / DEGREE), radius: short(state.radius, state.radius),
      target: state.target.map((value) => short(value, state.radius)).join(","), background: state.background };
    for (const flag of FLAGS) if (state[flag]) values[flag] = "1";
    return `${location.href.split("#")[0]}#${new URLSearchParams(values).toString().replaceAll("%2C", ",")}`;
  }

  copyLink() {
    history.replaceState(null, "", this.address);
    const copied = navigator.clipboard ? navigator.clipboard.writeText(this.address) : Promise.reject();
    copied.then(() => this.tell("link copied"), () => this.tell("the address is a link to this view"));
  }

  // The picture as it is drawn, trajectories in it, without the controls.
  savePicture() {
    this.draw();
    const copy = made("canvas", "", { width: this.canvas.width, height: this.canvas.height }), context = copy.getContext("2d");
    for (const layer of [this.canvas, this.trails.canvas]) context.drawImage(layer, 0, 0);
    copy.toBlob((blob) => {
      const link = made("a", "", { href: URL.createObjectURL(blob), download: `${this.header.title.replace(/[^\w.-]+/g, "_")}.png` });
      link.click();
      setTimeout(() => URL.revokeObjectURL(link.href), 1000);
    });
  }

  tell(text) {
    $("told").textContent = text;
    $("told").hidden = false;
    clearTimeout(this.telling);
    this.telling = setTimeout(() => { $("told").hidden = true; }, 2000);
  }

  toggleFullScreen() {
    if (document.fullscreenElement) document.exitFullscreen();
    else if (root.requestFullscreen) root.requestFullscreen().catch(() => this.tell("this browser refuses full screen here"));
    else this.tell("this browser has no full screen");
  }

  // A double click or tap: turns around the Gaussian that is seen there, or goes home where nothing is.
  pointedAt(x, y) {
    const ratio = this.canvas.width / this.canvas.clientWidth, point = this.scene.seenAt(x * ratio, y * ratio, this.camera, this.hidden);
    if (point) this.lookAt(point);
    else this.goHome();
  }

  clock(time) {
    const [frame, , later] = this.timeline.between(time), { frames } = this.header;
    return `${Math.min(frame + Math.round(later), frames - 1) + 1} / ${frames} · ${time.toFixed(2)} s`;
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
    add("button", "close").className = "close";  // a small screen's panel covers the button that opened it
    panel.firstChild.onclick = () => { panel.hidden = true; };
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
    panel.append(tableOf(KEYS));
  }

  change(values) {
    const state = Object.assign(this.state, values);
    root.toggleAttribute("data-dark", state.background !== "white");
    for (const button of document.querySelectorAll("[data-color]")) button.setAttribute("aria-pressed", button.dataset.color === state.color);
    for (const button of document.querySelectorAll("[data-flag]")) button.setAttribute("aria-pressed", state[button.dataset.flag]);
    $("bounce").textContent = state.bounce ? "⇄" : "↻";
    if (this.legendOf !== state.color) this.fillLegend(state.color);
    super.change({});
  }

  fillLegend(color) {
    const legend = $("legend"), { parts, weights } = this.header;
    this.legendOf = color;
    legend.hidden = color === "appearance";
    legend.replaceChildren();
    const ends = { rigid: ["free", "with its part"], depth: ["far", "near"] }[color];
    if (ends) {
      const ramp = made("div", "", { id: "ramp" }), words = made("div", "", { id: "ends" });
      ramp.style.background = `linear-gradient(90deg, ${weights.map((rgb) => `rgb(${rgb})`)})`;
      words.append(...ends.map((word) => made("b", word)));
      legend.append(ramp, words);
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
    this.trails.draw(state.trails, camera, this.hidden);
    this.drawInput();
  }

  // The clip's picture of the frame shown; the sheet holds all, row by row.
  drawInput() {
    const { input } = this.header, card = $("input");
    card.hidden = !input || !this.state.input || !this.sheet.complete;
    if (card.hidden) return;
    Object.assign(card, { width: input.width, height: input.height });
    const [frame, , later] = this.timeline.between(Math.min(this.state.time, this.timeline.end));
    const shown = Math.min(frame + Math.round(later), this.header.frames - 1);
    const { width, height, columns } = input, column = shown % columns, row = Math.floor(shown / columns);
    card.getContext("2d").drawImage(this.sheet, column * width, row * height, width, height, 0, 0, width, height);
  }

  listen() {
    this.listenToCanvas();
    this.listenToBar();
    $("ground").onclick = () => this.nextGround();
    $("home").onclick = () => this.goHome();
    $("about").onclick = () => { $("panel").hidden = !$("panel").hidden; };
    for (const button of document.querySelectorAll("[data-color]")) button.onclick = () => this.change({ color: button.dataset.color });
    for (const button of document.querySelectorAll("[data-flag]")) button.onclick = () => this.flip(button.dataset.flag);
    $("link").onclick = () => this.copyLink();
    $("save").onclick = () => this.savePicture();
    $("full").onclick = () => this.toggleFullScreen();
    this.sheet = new Image();
    this.sheet.onload = () => this.wake();
    if (this.header.input) this.sheet.src = this.header.input.sheet;
    window.addEventListener("hashchange", () => this.readAddress());
    listenToKeys(() => ({
      " ": () => this.toggle(), ArrowLeft: () => this.step(-1), ArrowRight: () => this.step(1),
      1: () => this.change({ color: "appearance" }), 2: () => this.change({ color: "part" }), 3: () => this.change({ color: "rigid" }),
      4: () => this.change({ color: "depth" }), t: () => this.flip("trails"), o: () => this.flip("input"), a: () => this.flip("turn"),
      p: () => this.flip("bounce"), f: () => this.toggleFullScreen(), l: () => this.copyLink(), s: () => this.savePicture(),
      b: () => this.nextGround(), i: () => $("about").click(), "?": () => $("about").click(),
      ...this.cameraKeys,
    }));
  }

  flip(flag) { this.change({ [flag]: !this.state[flag] }); }

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
