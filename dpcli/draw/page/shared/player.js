// Time: which frames are near a moment, playing round and round or back and forth, the bar with play, slider, clock and speed.

class Timeline {
  // times: of the frames, rising. rate: how much time passes per second. tail: how long the last frame is shown.
  constructor(times, rate, tail) {
    Object.assign(this, { times, rate, tail, start: times[0], end: times[times.length - 1] });
  }

  // The frames around a time, and the weight of the later one.
  between(time) {
    const { times } = this, last = times.length - 1, b = times.findIndex((value) => value > time);
    if (b === 0) return [0, 0, 0];
    if (b < 0) return [last, last, 0];
    return [b - 1, b, (time - times[b - 1]) / (times[b] - times[b - 1])];
  }

  after(time, seconds) {
    return this.start + ((time - this.start + seconds * this.rate) % (this.end - this.start + this.tail));
  }

  // The time reached back and forth, and the direction (1, -1) that playing has then.
  bounced(time, seconds, direction) {
    const next = time + direction * seconds * this.rate;
    if (next > this.end) return [Math.max(2 * this.end - next, this.start), -1];
    if (next < this.start) return [Math.min(2 * this.start - next, this.end), 1];
    return [next, direction];
  }

  stepped(time, direction) {
    const { times } = this, [a, , w] = this.between(time);
    const next = direction > 0 ? a + 1 : w > 1e-6 ? a : a - 1;
    return times[(next + times.length) % times.length];
  }
}

const CALM = matchMedia("(prefers-reduced-motion: reduce)").matches;

// Holds `state` (time, play, speed, bounce); those who extend it draw in `draw` and may say more in `change`.
class Player {
  constructor(timeline) {
    this.timeline = timeline;
    this.way = 1;
    this.state = { time: timeline.start, play: this.moves && !CALM, speed: 1, bounce: false };
  }

  get moves() { return this.timeline.times.length > 1; }

  listenToBar() {
    $("slider").oninput = () => this.change({ time: Number($("slider").value), play: false });
    $("play").onclick = () => this.toggle();
    $("speed").onchange = () => this.change({ speed: Number($("speed").value) });
    this.fitBar();
  }

  fitBar() {
    $("slider").min = this.timeline.start;
    $("slider").max = this.timeline.end;
    $("bar").toggleAttribute("data-still", !this.moves);
  }

  change(values) {
    const state = Object.assign(this.state, values), { start, end, tail } = this.timeline;
    state.time = Math.min(Math.max(state.time || 0, start), end + tail);
    $("play").textContent = state.play ? "❚❚" : "▶";
    $("slider").value = Math.min(state.time, end);
    $("clock").textContent = this.clock(Math.min(state.time, end));
    this.wake();
  }

  clock(time) { return `${time.toFixed(2)} / ${this.timeline.end.toFixed(2)} s`; }
  toggle() { this.change({ play: !this.state.play && this.moves }); }
  step(direction) { this.change({ time: this.timeline.stepped(this.state.time, direction), play: false }); }

  wake() {
    if (this.awake) return;
    this.awake = true;
    requestAnimationFrame((now) => this.frame(now));
  }

  frame(now) {
    this.awake = false;
    const passed = Math.min((now - (this.last ?? now)) / 1000, 0.25);
    this.last = this.busy ? now : null;
    if (this.busy) this.advance(passed);
    this.draw();
    ready();
  }

  // Whether something moves by itself.
  get busy() { return this.state.play; }

  advance(seconds) {
    const { state, timeline } = this, passed = seconds * state.speed;
    if (!state.play) return;
    if (!state.bounce) return this.change({ time: timeline.after(state.time, passed) });
    const [time, direction] = timeline.bounced(Math.min(state.time, timeline.end), passed, this.way);
    this.way = direction;
    this.change({ time });
  }
}
