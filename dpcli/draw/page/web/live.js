// The page of a stream: points.js shows the clouds; below them lie, over one line of time, the actions that were found, the
// probability of every class, and the latency. Frames are the stream's, of which the slider has those that are kept.

const LEFT = 8, ACTIONS = 26, SURE = 34, DELAY = 26, SPACE = 8;  // CSS pixels: margin, heights of the lanes, between them
const NOTHING = "nothing happening";

class LivePage extends PointsPage {
  constructor(header) {
    super(header);
    this.live = header.live;
  }

  async start() {
    const { live } = this;
    this.table = new Uint16Array((await unpacked($("data1").textContent, live.bytes)).buffer);
    this.lanes = $("lanes");
    this.lanes.onpointerdown = (event) => { this.lanes.setPointerCapture(event.pointerId); this.seek(event); };
    this.lanes.onpointermove = (event) => { if (event.buttons) this.seek(event); };
    await super.start();
    new ResizeObserver(() => { this.backdrop = null; this.wake(); }).observe(this.lanes);
  }

  // The prediction that was the newest at a frame of the stream; -1 before the first.
  newest(frame) {
    const { frames } = this.live;
    let low = 0, high = frames.length;
    while (low < high) {
      const middle = (low + high) >> 1;
      if (frames[middle] <= frame) low = middle + 1; else high = middle;
    }
    return low - 1;
  }

  row(at) { const count = this.live.classes.length; return this.table.subarray(at * count, (at + 1) * count); }

  // The best classes of a prediction, the surest first: [class, probability].
  best(at, most = 5) {
    return [...this.row(at)].map((value, k) => [k, value / 65535]).sort((a, b) => b[1] - a[1]).slice(0, most);
  }

  label(at) {
    const [[k, share]] = this.best(at, 1);
    return share < this.live.threshold ? -1 : k;
  }

  seek(event) {
    const { left, width } = this.lanes.getBoundingClientRect(), { about } = this.clip;
    const wanted = (event.clientX - left - LEFT) / (width - 2 * LEFT) * about.frame_count;
    const place = about.frames.findIndex((frame) => frame >= wanted);
    this.change({ time: place < 0 ? about.frames.length - 1 : place, play: false });
  }

  draw() {
    super.draw();
    if (!this.clip || !this.table) return;
    const frame = this.clip.about.frames[this.frameNumber];
    this.tell(this.newest(frame));
    this.drawLanes(frame);
  }

  tell(at) {
    if (this.told === at) return;
    this.told = at;
    const { classes, colors, latency } = this.live, list = $("best"), said = $("said");
    list.replaceChildren();
    if (at < 0) { said.textContent = "the window is not full yet"; said.style.color = ""; return; }
    const label = this.label(at), [[, share]] = this.best(at, 1);
    said.textContent = label < 0 ? NOTHING : `${classes[label]} ${share.toFixed(2)}`;
    said.style.setProperty("--mark", label < 0 ? "var(--faint)" : `rgb(${colors[label]})`);
    for (const [k, value] of this.best(at)) {
      const item = made("li"), name = made("b", classes[k]), bar = made("i"), number = made("span", value.toFixed(2));
      bar.style.width = `${100 * value}%`;
      bar.style.background = `rgb(${colors[k]})`;
      item.append(name, number, bar);
      list.append(item);
    }
    list.append(made("li", `latency ${latency[at].toFixed(0)} ms`));
  }

  drawLanes(frame) {
    const { lanes } = this, ratio = Math.min(window.devicePixelRatio || 1, 2), dark = root.hasAttribute("data-dark");
    const width = Math.round(lanes.clientWidth * ratio), height = Math.round(lanes.clientHeight * ratio);
    if (!this.backdrop || this.darkness !== dark || this.backdrop.width !== width || this.backdrop.height !== height) {
      this.darkness = dark;
      this.backdrop = Object.assign(document.createElement("canvas"), { width, height });
      this.paintLanes(this.backdrop.getContext("2d"), ratio);
    }
    const pen = (Object.assign(lanes, { width, height })).getContext("2d");
    pen.drawImage(this.backdrop, 0, 0);
    pen.fillStyle = getComputedStyle(root).getPropertyValue("--ink");
    pen.fillRect(Math.round(this.x(frame + 0.5) * ratio) - ratio, 0, 2 * ratio, height);
  }

  x(frame) { return LEFT + frame / this.clip.about.frame_count * (this.lanes.clientWidth - 2 * LEFT); }

  paintLanes(pen, ratio) {
    const style = getComputedStyle(root), ink = style.getPropertyValue("--ink"), faint = style.getPropertyValue("--faint"), line = style.getPropertyValue("--line");
    pen.scale(ratio, ratio);
    pen.font = "12px system-ui, sans-serif";
    pen.textBaseline = "middle";
    let top = 16;
    const fits = (text) => pen.measureText(text).width < this.lanes.clientWidth - 2 * LEFT;
    const title = (text, short = text) => { pen.fillStyle = faint; pen.fillText(fits(text) ? text : short, LEFT, top - 9); };
    title("actions");
    for (const [start, end, name] of this.live.segments) this.paintAction(pen, top, this.x(start), this.x(end), name, line, ink);
    top += ACTIONS + SPACE + 14;
    const below = this.live.threshold ? `; below ${this.live.threshold.toFixed(2)} nothing happens` : "";
    title(`confidence, as it was said${below}`, `confidence${below}`);
    this.paintSure(pen, top, line);
    top += SURE + SPACE + 14;
    title(`latency, at most ${this.live.highest.toFixed(0)} ms`);
    this.paintDelay(pen, top, faint);
  }

  paintAction(pen, top, from, to, name, line, ink) {
    const k = this.live.classes.indexOf(name), wide = Math.max(to - from - 1, 1);
    pen.fillStyle = k < 0 ? line : `rgb(${this.live.colors[k]})`;
    pen.fillRect(from, top, wide, ACTIONS);
    if (k < 0) return;
    const [r, g, b] = this.live.colors[k];
    pen.fillStyle = 0.299 * r + 0.587 * g + 0.114 * b > 140 ? "#10141b" : "#fff";
    let text = name;
    while (text && pen.measureText(text).width > wide - 8) text = text.slice(0, -1);
    if (text.length > 2 || text === name) pen.fillText(text, from + 4, top + ACTIONS / 2);
  }

  paintSure(pen, top, line) {
    const { frames, colors, threshold } = this.live;
    pen.fillStyle = line;
    pen.fillRect(this.x(0), top + SURE, this.x(this.clip.about.frame_count) - this.x(0), 1);
    frames.forEach((frame, at) => {
      const [[k, share]] = this.best(at, 1), from = this.x(frame), to = this.x(frames[at + 1] ?? this.clip.about.frame_count);
      pen.globalAlpha = share < threshold ? 0.35 : 1;
      pen.fillStyle = `rgb(${colors[k]})`;
      pen.fillRect(from, top + SURE * (1 - share), Math.max(to - from, 1), SURE * share);
    });
    pen.globalAlpha = 1;
    if (!threshold) return;
    pen.fillStyle = getComputedStyle(root).getPropertyValue("--wrong");
    pen.fillRect(this.x(0), top + SURE * (1 - threshold), this.x(this.clip.about.frame_count) - this.x(0), 1);
  }

  paintDelay(pen, top, faint) {
    const { frames, latency, highest } = this.live, most = Math.max(highest, 1);
    pen.fillStyle = faint;
    frames.forEach((frame, at) => {
      const from = this.x(frame), to = this.x(frames[at + 1] ?? this.clip.about.frame_count), high = DELAY * latency[at] / most;
      pen.fillRect(from, top + DELAY - high, Math.max(to - from, 1), high);
    });
  }
}

window.page = new LivePage(JSON.parse($("header").textContent));
window.page.start();
