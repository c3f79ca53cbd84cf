// The page of point clouds. The part after # in the address sets its state, such as
// #sequence=2&frame=3&color=part&azimuth=40&elevation=10&radius=2&play=0&theme=dark&controls=0&renderer=2d (degrees).

const LOOKS = { part: "part", color: "stored color", label: "label", height: "height", time: "time" };
const UPS = ["−y", "+y", "+z", "−z", "+x", "−x"];
const KEYS = [
  ["space", "play or stop"],
  ["← →", "a frame back or on"],
  ["[ ]", "the sequence before or after, as the page keys do"],
  ["1 … 5", "what the colors tell"],
  [", .", "smaller or larger points"],
  ["+ −", "nearer or farther, as the wheel or a pinch"],
  ["shift ← → ↑ ↓", "turn"],
  ["drag", "turn; with shift, or two fingers: move"],
  ["r", "the first view"],
  ["u", "another axis upright"],
];
const HALF = Math.tan(16 * DEGREE), GROUND = { light: [252, 252, 253], dark: [22, 26, 34] };

class PointsPage extends Stage {
  constructor(header) {
    super($("canvas"), [HALF, HALF], PointsPage.timelineOf(header.sequences[0]));
    Object.assign(this, { header, hidden: new Set(), data: [], at: 0 });
    Object.assign(this.state, { color: header.looks[0], dots: 1, azimuth: 0, elevation: 0, radius: 3, target: [0, 0, 0] });
    this.painter = this.painterOf();
    this.floor = new Floor($("floor"));
  }

  // The time of a page is the frame's place; `rate` frames pass per second.
  static timelineOf(about) { return new Timeline(about.counts.map((_, frame) => frame), about.rate, 1); }

  painterOf() {
    if (addressed().get("renderer") !== "2d") {
      try { return new GlPoints(this.canvas, () => this.wake()); } catch (error) {
        if (error.message !== "no WebGL 2") throw error;
      }
    }
    root.dataset.renderer = "2d";
    return new CanvasPoints(this.canvas);
  }

  async start() {
    const { header } = this;
    fillHead(header);
    fillAbout(header, KEYS);
    for (const look of header.looks) {
      const button = made("button", LOOKS[look], { "data-color": look, title: header.looks.indexOf(look) + 1 });
      button.onclick = () => this.change({ color: look });
      $("look").append(button);
    }
    for (const [at, { title }] of header.sequences.entries()) $("sequence").append(made("option", title, { value: at }));
    $("sequence").onchange = () => this.choose(Number($("sequence").value));
    for (const axis of UPS) $("up").append(made("option", `${axis} is up`, { value: axis }));
    $("up").value = UPS.find((axis) => this.direction(axis)[1] === 1);
    $("up").onchange = () => this.choose(this.at);
    $("home").onclick = () => this.goHome();
    $("dots").oninput = () => this.change({ dots: 2 ** Number($("dots").value) });
    this.listenToBar();
    await this.choose(Number(addressed().get("sequence")) || 0);
    this.listenToCanvas();
    this.toggleTheme = followTheme(() => this.wake());
    $("theme").onclick = () => this.toggleTheme();
    window.addEventListener("hashchange", () => this.readAddress());
    listenToKeys(() => this.keys());
    this.fitCanvas();
    this.readAddress();
  }

  keys() {
    const looks = this.header.looks.map((look, k) => [k + 1, () => this.change({ color: look })]);
    const next = () => this.choose(this.at + 1), before = () => this.choose(this.at - 1), smaller = () => this.resizeDots(-0.25), larger = () => this.resizeDots(0.25);
    return {
      ...Object.fromEntries(looks), " ": () => this.toggle(), ArrowLeft: () => this.step(-1), ArrowRight: () => this.step(1),
      "]": next, "[": before, PageDown: next, PageUp: before, ArrowDown: next, ArrowUp: before, ",": smaller, ".": larger,
      u: () => this.nextUp(), b: () => this.toggleTheme(), "?": () => $("open-about").click(), Escape: () => { $("about").hidden = true; },
      ...this.cameraKeys,
    };
  }

  resizeDots(by) {
    $("dots").value = Number($("dots").value) + by;
    $("dots").oninput();
  }

  readAddress() {
    const given = addressed(), values = super.readAddress();
    if (given.has("frame")) Object.assign(values, { time: Number(given.get("frame")), play: given.get("play") === "1" });
    if (this.header.looks.includes(given.get("color"))) values.color = given.get("color");
    this.change(values);
  }

  // Where a signed axis of the file, such as −y, points on the page as given.
  direction(axis) { return this.header.axes["xyz".indexOf(axis[1])].map((value) => (axis[0] === "−" ? -value : value) + 0); }

  nextUp() {
    $("up").selectedIndex = ($("up").selectedIndex + 1) % UPS.length;
    $("up").onchange();
  }

  // Shows another sequence; it is unpacked when it is first wanted.
  async choose(at) {
    const { sequences } = this.header, count = sequences.length, place = ((Math.round(at) % count) + count) % count, data = $(`data${place}`);
    const time = place === this.at && this.clip ? this.state.time : 0;
    this.at = place;
    this.data[place] ??= unpacked(data.textContent, sequences[place].bytes);
    data?.remove();
    const bytes = await this.data[place], turn = uprightTurn(this.direction($("up").value));
    if (this.at !== place) return;
    const clip = this.clip = new Clip(sequences[place], bytes, turn);
    this.axes = this.header.axes.map((axis) => times(turn, axis));
    this.timeline = PointsPage.timelineOf(clip.about);
    this.fitBar();
    $("sequence").value = place;
    $("scale").textContent = `one square is ${(clip.ground.square * clip.size).toPrecision(1) * 1} ${this.header.unit}`;
    this.painted = null;
    this.hidden.clear();
    this.legendOf = null;
    this.change({ time, play: this.moves && this.state.play, ...this.home() });
    this.turned = false;
  }

  home() {
    const view = { azimuth: 28 * DEGREE, elevation: 14 * DEGREE, target: [0, -0.09, 0], radius: 1 };
    this.turned = false;
    return { ...view, radius: this.clip.distance(cameraOf(view, this.half, this.canvas), view.target) };
  }

  // A picture of another size shows all again, unless the reader chose what to see.
  fitCanvas() {
    super.fitCanvas();
    if (this.clip && !this.turned) { this.change({ radius: this.home().radius }); this.turned = false; }
  }

  change(values) {
    if ("azimuth" in values || "radius" in values || "target" in values) this.turned = true;
    super.change(values);
    const { color } = this.state;
    for (const button of document.querySelectorAll("[data-color]")) button.setAttribute("aria-pressed", button.dataset.color === color);
    if (this.clip && this.legendOf !== color) this.fillLegend(color);
  }

  get frameNumber() { return Math.min(Math.floor(this.state.time + 1e-6), this.timeline.end); }

  clock() {
    const { about } = this.clip, frame = this.frameNumber, seconds = about.time ? ` · ${(about.time[frame] - about.time[0]).toFixed(2)} s` : "";
    return `frame ${about.frames[frame]} / ${about.frame_count - 1}${seconds}`;
  }

  fillLegend(color) {
    const legend = $("legend"), { header } = this, { about } = this.clip;
    this.legendOf = color;
    this.painted = null;
    legend.replaceChildren();
    $("legend-title").textContent = { part: "Parts", label: "Class", height: `Height${header.unit ? ` (${header.unit})` : ""}`, time: "Frame", color: "" }[color];
    if (color === "part") for (const part of about.parts) legend.append(this.entry(part.id < 0 ? "none" : `part ${part.id}`, part.color, part.share, part.id));
    if (color === "label") legend.append(this.entry(about.class || "unknown", about.label_color, ""));
    if (color === "height") legend.append(...this.ramp(0, (2 * this.clip.half[1] * this.clip.size).toPrecision(3) * 1));
    if (color === "time") legend.append(...this.ramp(about.frames[0], about.frames[about.frames.length - 1]));
  }

  ramp(low, high) {
    const ramp = made("div", "", { id: "ramp" }), ends = made("div", "", { id: "ends" });
    ramp.style.background = `linear-gradient(90deg, ${this.header.ramp.map((rgb) => `rgb(${rgb})`)})`;
    ends.append(made("b", low), made("b", high));
    const both = made("div");
    both.append(ramp, ends);
    return [both];
  }

  entry(text, color, share, id = null) {
    const button = made("button", "", { "aria-pressed": true }), mark = made("i");
    mark.style.background = `rgb(${color})`;
    button.append(mark, made("b", text), made("span", share));
    button.disabled = id === null;
    if (id !== null) button.title = "show or hide";
    button.onclick = () => {
      if (!this.hidden.delete(id)) this.hidden.add(id);
      button.setAttribute("aria-pressed", !this.hidden.has(id));
      this.painted = null;
      this.wake();
    };
    return button;
  }

  draw() {
    const { state, clip, camera, header } = this, dark = root.hasAttribute("data-dark"), distance = camera.shift[2];
    if (!clip) return;
    this.painted ??= clip.colors(state.color, header, this.hidden);
    this.floor.draw(clip, this.axes, camera, dark);
    this.painter.draw(clip, clip.spans(this.frameNumber, state.color), this.painted, camera, {
      reach: clip.reach * state.dots, ground: dark ? GROUND.dark : GROUND.light, depths: [distance - 1, distance + 1],
      shadow: state.elevation > 0 ? (dark ? 0.5 : 0.16) : 0,
    });
  }
}
