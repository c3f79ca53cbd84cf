// The page of an embedding: dots of samples in a plane for each stream; the nearest to the pointer is told in all of them.

const KEYS = [
  ["pointer", "tells the sample below it"],
  ["click", "hides or shows a class"],
];

class ScatterPage {
  constructor(header) {
    Object.assign(this, { header, hidden: new Set(), near: -1 });
    this.classOf = new Map(header.classes.map((one) => [one.label, one]));
    this.planes = header.planes.map((plane) => this.plane(plane));
  }

  start() {
    fillHead(this.header);
    fillAbout(this.header, KEYS);
    const toggleTheme = followTheme(() => this.draw());
    $("theme").onclick = toggleTheme;
    for (const one of this.header.classes) $("legend").append(this.entry(one));
    listenToKeys(() => ({ b: toggleTheme, "?": () => $("open-about").click(), Escape: () => { $("about").hidden = true; } }));
    new ResizeObserver(() => this.draw()).observe($("planes"));
    this.draw();
    ready();
  }

  plane({ title, places, figures }) {
    const figure = made("figure"), canvas = made("canvas", "", { role: "img", "aria-label": `${title}: ${places.length} samples in the plane` });
    const words = Object.entries(figures).map(([name, value]) => `${name.replaceAll("_", " ")} ${Number(value.toPrecision(4))}`).join(" · ");
    const caption = made("figcaption", title);
    caption.append(made("span", words));
    figure.append(caption, canvas);
    $("planes").append(figure);
    const axes = [0, 1].map((k) => places.map((place) => place[k])), ends = axes.map((values) => values.reduce(([a, b], v) => [Math.min(a, v), Math.max(b, v)], [Infinity, -Infinity]));
    const plane = { canvas, places, middle: ends.map(([a, b]) => (a + b) / 2), wide: Math.max(...ends.map(([a, b]) => b - a), 1e-9) };
    canvas.onpointermove = canvas.onpointerdown = (event) => this.tell(this.nearest(plane, event.offsetX, event.offsetY));
    canvas.onpointerleave = () => this.tell(-1);
    return plane;
  }

  entry({ label, name, color, shape }) {
    const button = made("button", "", { "aria-pressed": true, title: "show or hide" }), mark = made("i", "", { class: shape });
    mark.style.background = `rgb(${color})`;
    button.append(mark, made("b", name), made("span", this.header.labels.filter((one) => one === label).length.toLocaleString("en")));
    button.onclick = () => {
      if (!this.hidden.delete(label)) this.hidden.add(label);
      button.setAttribute("aria-pressed", !this.hidden.has(label));
      this.draw();
    };
    return button;
  }

  // Where a sample lies on the canvas, in CSS pixels.
  spot(plane, row) {
    const { clientWidth: width, clientHeight: height } = plane.canvas, scale = 0.9 * Math.min(width, height) / plane.wide;
    return [width / 2 + scale * (plane.places[row][0] - plane.middle[0]), height / 2 - scale * (plane.places[row][1] - plane.middle[1])];
  }

  nearest(plane, x, y) {
    let best = -1, least = 14;
    for (let row = 0; row < plane.places.length; row++) {
      if (this.hidden.has(this.header.labels[row])) continue;
      const [u, v] = this.spot(plane, row), far = Math.hypot(u - x, v - y);
      if (far < least) [best, least] = [row, far];
    }
    return best;
  }

  tell(row) {
    if (row === this.near) return;
    this.near = row;
    $("told").textContent = row < 0 ? "" : `${this.header.names[row]} · ${this.classOf.get(this.header.labels[row]).name}`;
    this.draw();
  }

  draw() {
    const ratio = Math.min(devicePixelRatio || 1, 2), size = Math.min(Math.max(120 / Math.sqrt(this.header.labels.length), 2), 5);
    for (const plane of this.planes) {
      const { canvas } = plane, pen = canvas.getContext("2d");
      canvas.width = canvas.clientWidth * ratio;
      canvas.height = canvas.clientHeight * ratio;
      pen.setTransform(ratio, 0, 0, ratio, 0, 0);
      for (let row = 0; row < plane.places.length; row++) if (!this.hidden.has(this.header.labels[row])) this.dot(pen, this.spot(plane, row), row, size, 0.85);
      if (this.near >= 0) this.dot(pen, this.spot(plane, this.near), this.near, 2 * size, 1);
    }
  }

  dot(pen, [x, y], row, size, alpha) {
    const { color, shape } = this.classOf.get(this.header.labels[row]);
    pen.fillStyle = `rgba(${color},${alpha})`;
    pen.strokeStyle = getComputedStyle(root).getPropertyValue("--stage");
    pen.beginPath();
    if (shape === "circle") pen.arc(x, y, size, 0, 2 * Math.PI);
    else for (const quarter of [0, 1, 2, 3]) {
      const angle = (quarter + (shape === "square") / 2) * Math.PI / 2, far = 1.25 * size; // as much area as the circle
      pen.lineTo(x + far * Math.cos(angle), y + far * Math.sin(angle));
    }
    pen.closePath();
    pen.fill();
    pen.stroke();
  }
}

window.page = new ScatterPage(JSON.parse($("header").textContent));
window.page.start();
