// The page of views: a screen and a strip of frames for each camera. #frame=3&play=0&theme=dark sets its state.

const KEYS = [
  ["space", "play or stop"],
  ["← →", "a frame back or on"],
  ["click", "go to that frame"],
  ["+ −", "larger or smaller pictures"],
];

class FilmPage extends Player {
  constructor(header) {
    super(new Timeline(header.frames.map((_, frame) => frame), header.rate, 1));
    this.header = header;
  }

  start() {
    const { header } = this;
    fillHead(header);
    fillAbout(header, KEYS);
    this.rows = header.views.map((title, view) => this.row(title, [...$(`view${view}`).children]));
    this.listenToBar();
    const toggleTheme = followTheme(() => {});
    $("theme").onclick = toggleTheme;
    let size = 1;
    const sized = (factor) => { size = Math.min(Math.max(size * factor, 0.4), 3); root.style.setProperty("--size", size); };
    listenToKeys(() => ({
      " ": () => this.toggle(), ArrowLeft: () => this.step(-1), ArrowRight: () => this.step(1), b: toggleTheme,
      "+": () => sized(1.25), "=": () => sized(1.25), "-": () => sized(0.8),
      "?": () => $("open-about").click(), Escape: () => { $("about").hidden = true; },
    }));
    window.addEventListener("hashchange", () => this.readAddress());
    this.readAddress();
  }

  readAddress() {
    const given = addressed();
    if (given.has("frame")) this.state.time = Number(given.get("frame"));
    this.change(given.has("frame") || given.has("play") ? { play: given.get("play") === "1" } : {});
  }

  row(title, pictures) {
    const row = made("section", "", { class: "camera", "aria-label": title }), strip = made("div", "", { class: "strip" });
    const screen = made("canvas", "", { class: "screen", role: "img", "aria-label": `${title}: the frame that is shown` }), [name, ...rest] = title.split(" · ");
    for (const [frame, picture] of pictures.entries()) {
      const number = this.header.frames[frame], button = made("button", "", { title: `frame ${number}` });
      button.append(picture, made("span", number));
      button.onclick = () => this.change({ time: frame, play: false });
      strip.append(button);
    }
    const head = made("h2", `camera ${name}`);
    head.append(made("span", rest.join(" · ")));
    row.append(head, screen, strip);
    $("strips").append(row);
    return { screen, strip, pictures };
  }

  get frameNumber() { return Math.min(Math.floor(this.state.time + 1e-6), this.timeline.end); }

  clock() {
    const { frames, frame_count: count, time } = this.header, frame = this.frameNumber;
    return `frame ${frames[frame]} / ${count - 1} · ${(time[frame] - time[0]).toFixed(2)} s`;
  }

  draw() {
    const frame = this.frameNumber;
    if (this.drawn === frame) return;
    this.drawn = frame;
    for (const { screen, strip, pictures } of this.rows) {
      const picture = pictures[frame], pen = screen.getContext("2d");
      screen.width = picture.naturalWidth;
      screen.height = picture.naturalHeight;
      pen.drawImage(picture, 0, 0);
      for (const [at, button] of [...strip.children].entries()) button.toggleAttribute("data-now", at === frame);
      const now = strip.children[frame];  // in sight, without moving the page
      strip.scrollLeft = now.offsetLeft - strip.offsetLeft - (strip.clientWidth - now.clientWidth) / 2;
    }
  }
}

window.page = new FilmPage(JSON.parse($("header").textContent));
window.addEventListener("load", () => window.page.start());  // all pictures are there
